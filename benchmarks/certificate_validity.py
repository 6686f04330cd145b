"""How often the test gives certificates, and how often these are wrong, in a simulation.

    python benchmarks/certificate_validity.py --repetitions 500 --means 25 --write FILE.csv

Policies with known mean costs are tested by `safe_rl.scores.certificate.first_certified`, three
candidates of a run on the same layouts. If the mean is exactly the limit, 25, every certificate is
wrong, and at most 5 % of the runs may get one. If the mean is below the limit, the share of runs
with a certificate is the power of the test. Realistic costs are resampled from `episode_costs.csv`
and scaled to the mean. This file has 1,000 episodes of the policy `certified/PointGoal1`
(`safe-rl evaluate certified/PointGoal1 episodes=1000 seed=982451653`, commit df5f814, mean 23.0).
`--costs` names another CSV file, with a column per policy and a row per episode.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from safe_rl.scores.certificate import Claim, first_certified

LIMIT, HIGHEST, TESTS, BATCH = 25.0, 1000.0, 3, 100
COSTS = Path(__file__).with_name("episode_costs.csv")

Draw = Callable[[np.random.Generator, int], np.ndarray]


def lognormal(rng: np.random.Generator, number: int) -> np.ndarray:
    return rng.lognormal(0.0, 0.9, number)


def zero_inflated(rng: np.random.Generator, number: int) -> np.ndarray:
    return (rng.random(number) < 0.3) * rng.gamma(0.8, 1.0, number)


def pareto(rng: np.random.Generator, number: int) -> np.ndarray:
    return rng.pareto(1.5, number)


def measured(path: Path) -> dict[str, Draw]:
    """Draws with replacement from the episodes of policies."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    return {
        name: lambda rng, number, costs=costs: rng.choice(costs, number)
        for name, costs in columns.items()
    }


def scaled(draw: Draw, mean: float) -> Draw:
    """The distribution, scaled and cut at the highest cost so that its mean is as given."""
    sample = draw(np.random.default_rng(0), 1_000_000)
    low, high = 0.0, 10 * HIGHEST / max(sample.mean(), 1e-9)
    for _ in range(60):
        factor = (low + high) / 2
        reached = (factor * sample).clip(max=HIGHEST).mean()
        low, high = (factor, high) if reached < mean else (low, factor)
    return lambda rng, number: (high * draw(rng, number)).clip(max=HIGHEST)


def with_catastrophes(draw: Draw, mean: float, one_in: int) -> Draw:
    """One layout in `one_in` has the highest cost; the mean is as given."""
    usual = scaled(draw, (mean - HIGHEST / one_in) / (1 - 1 / one_in))
    return lambda rng, number: np.where(
        rng.random(number) < 1 / one_in, HIGHEST, usual(rng, number)
    )


def distributions(mean: float, own: dict[str, Draw]) -> Iterator[tuple[str, Draw]]:
    shapes = {**own, "lognormal": lognormal, "zero-inflated": zero_inflated, "Pareto 1.5": pareto}
    for name, draw in shapes.items():
        yield name, scaled(draw, mean)
    base = next(iter(own.values()))
    for one_in in (200, 500, 1000):
        if mean > HIGHEST / one_in:
            yield f"1 in {one_in} costs 1000", with_catastrophes(base, mean, one_in)


def is_certified(draw: Draw, number: int, rng: np.random.Generator) -> tuple[bool, int]:
    """Whether one of three equal candidates is certified, and on how many episodes in all.

    They have the same layouts, and so the same catastrophes. A third of their other episodes have
    equal costs too.
    """
    shared = draw(rng, number)
    used: list[int] = []

    def collect(candidate: int) -> Iterator[dict[str, np.ndarray]]:
        own = draw(rng, number)
        alike = (shared >= HIGHEST) | ((own < HIGHEST) & (rng.random(number) < 1 / 3))
        costs = np.where(alike, shared, np.where(own >= HIGHEST, shared, own))
        for start in range(0, number, BATCH):
            used.append(BATCH)
            yield {"cost": costs[start : start + BATCH]}

    claim = Claim({"cost": LIMIT}, highest={"cost": HIGHEST})
    verdict = first_certified(range(TESTS), collect, [claim] * TESTS, TESTS, number)
    return verdict.certified is not None, sum(used)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=1000)
    parser.add_argument("--episodes", type=int, default=3000)
    parser.add_argument("--means", type=float, nargs="+", default=[25, 22, 20, 18])
    parser.add_argument("--costs", type=Path, default=COSTS)
    parser.add_argument("--write", type=Path, help="a CSV file for the table")
    options = parser.parse_args()
    own, rows = measured(options.costs), []
    print("mean", "costs", "certified", "episodes", sep="\t")
    for mean in options.means:
        for name, draw in distributions(mean, own):
            rng = np.random.default_rng(1)
            found = [is_certified(draw, options.episodes, rng) for _ in range(options.repetitions)]
            row = {"mean": mean, "costs": name}
            row["certified"] = round(float(np.mean([certified for certified, _ in found])), 4)
            row["episodes"] = int(np.median([used for _, used in found]))
            rows.append(row)
            print(*row.values(), sep="\t", flush=True)
    if options.write:
        with options.write.open("w", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]))
            table.writeheader()
            table.writerows(rows)


if __name__ == "__main__":
    main()
