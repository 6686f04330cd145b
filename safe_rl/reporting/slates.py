"""Normalised scores over slates of environments (paper section 5.1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.tables import Table, interval, mark_best
from safe_rl.scores.benchmark import PUBLISHED, PUBLISHED_STEPS, REFERENCE, SLATES, Normalised
from safe_rl.scores.comparisons import interquartile_mean
from safe_rl.scores.measures import (
    NOISE_OF_ZERO,
    normalised_cost_rate,
    normalised_return,
    normalised_violation,
)

__all__ = ["SYMBOLS", "Aggregate", "aggregate", "complete_slates", "slate_table"]

SYMBOLS = dict(
    zip(Normalised._fields, (r"$\bar J_r$", r"$\bar M_c$", r"$\bar \rho_c$"), strict=True)
)
"""Score -> its symbol."""


@dataclass(frozen=True)
class Aggregate:
    """One algorithm's normalised scores over a set of environments.

    Attributes:
        experiments: One per environment, each with finished runs and a limit on ``cost``.
        strata: Score -> its values per environment, one of each run.
    """

    experiments: tuple[Experiment, ...]
    strata: dict[str, list[np.ndarray]]

    @property
    def algorithm(self) -> str:
        """Its name, as experiments have it."""
        return self.experiments[0].algorithm

    @property
    def conditions(self) -> tuple[Any, ...]:
        """What has to be equal in two that are compared: environment steps, and limits."""
        steps = tuple(steps for e in self.experiments for steps in e.lengths)
        return steps, tuple(e.limits["cost"] for e in self.experiments)

    @property
    def mean(self) -> Normalised:
        """Averages over environments of averages over seeds."""
        return Normalised(
            *(float(np.mean([runs.mean() for runs in self.strata[n]])) for n in Normalised._fields)
        )

    @property
    def num_runs(self) -> int:
        """Runs that went into it."""
        return sum(map(len, self.strata["episode_return"]))


def aggregate(experiments: Sequence[Experiment]) -> Aggregate:
    """Normalise the final scores of one algorithm's experiments, one per environment."""
    strata: dict[str, list[np.ndarray]] = {name: [] for name in Normalised._fields}
    for e in experiments:
        assert e.reference is not None
        finals = [run.final(["cost"]) for run in e.finished]
        values = {name: np.array([final[name] for final in finals]) for name in finals[0]}
        # J_c, or what the run compares with the limit in its place
        judged = e.limits["cost"] + np.array([run.excess("cost") for run in e.finished])
        strata["episode_return"].append(normalised_return(values["episode_return"], e.reference))
        strata["violation"].append(normalised_violation(judged, e.limits["cost"], e.reference))
        strata["cost_rate"].append(normalised_cost_rate(values["cost_rate"], e.reference))
    return Aggregate(tuple(experiments), strata)


def complete_slates(
    experiments: Sequence[Experiment], needed: int
) -> Iterator[tuple[str, tuple[str, ...], list[Aggregate]]]:
    """Slates that are complete for an algorithm or more, and what all have in common.

    Yields title, environments, and an aggregate of each algorithm with as many finished runs per
    environment as are needed. Runs that started from another run's networks do not count.
    """
    begun = [e for e in experiments if e.reference is not None and not e.is_continued]
    usable = [e for e in begun if "cost" in e.limits and e.finished]
    algorithms = dict.fromkeys(e.algorithm for e in begun)
    own = {a: {e.benchmark: e for e in usable if e.algorithm == a} for a in algorithms}
    shared = tuple(n for n in REFERENCE if own and all(n in found for found in own.values()))
    slates = {
        name: [
            [found[env] for env in slate]
            for found in own.values()
            if all(env in found and len(found[env].finished) >= needed for env in slate)
        ]
        for name, slate in SLATES.items()
    }
    if shared and shared not in [SLATES[name] for name, members in slates.items() if members]:
        slates["shared"] = [[found[env] for env in shared] for found in own.values()]
    for name, members in slates.items():
        if members:
            yield name, SLATES.get(name, shared), list(map(aggregate, members))


def slate_table(slate: str, environments: Sequence[str], aggregates: Sequence[Aggregate]) -> Table:
    """One of the paper's Tables 1 and 2, the published values beside ours."""
    conditions = {one.algorithm: one.conditions for one in aggregates}
    records, mixed = [], []
    for one in aggregates:
        record: dict[str, Any] = {"slate": slate, "algorithm": one.algorithm, "runs": one.num_runs}
        steps = one.conditions[0]
        record["fewest_steps"] = min(steps)
        record["most_steps"] = max(steps) if max(steps) > min(steps) else None
        record |= one.mean._asdict()
        if one.num_runs > 1:
            for name in SYMBOLS:
                names = (f"iqm_{name}", f"iqm_{name}_low", f"iqm_{name}_high")
                record |= zip(names, interquartile_mean(one.strata[name]), strict=True)
        if all(e.has_published_limit for e in one.experiments):
            paper = PUBLISHED.get(slate, {}).get(one.experiments[0].base)
            record |= {f"paper_{n}": v for n, v in (paper._asdict() if paper else {}).items()}
        records.append(record)
        own = [e.settings for e in one.experiments]
        keys = [k for k in dict.fromkeys(chain(*own)) if len({s.get(k) for s in own}) > 1]
        mixed += [f"{one.algorithm} ({', '.join(keys)})"] if keys else []
    columns = {"algorithm": "{algorithm}", "runs": "{runs:d}"}
    columns["steps"] = "{fewest_steps:,}| to {most_steps:,}"
    columns |= {symbol: f"{{{name}:.3f}}" for name, symbol in SYMBOLS.items()}
    if any("iqm_violation" in record for record in records):
        columns |= {f"IQM {s}": interval(f"iqm_{name}", 3) for name, s in SYMBOLS.items()}
    notes = [f"On {', '.join(environments)}."]
    if slate in PUBLISHED:
        columns |= {f"paper {s}": f"{{paper_{name}:.3f}}" for name, s in SYMBOLS.items()}
        after = sorted({PUBLISHED_STEPS[environment] for environment in SLATES[slate]})
        notes.append(f"Paper: after {' (Doggo: '.join(f'{n:,}' for n in after)}")
        notes[-1] += " steps)." if len(after) > 1 else " steps."
    notes += [f"Settings differ between environments: {', '.join(mixed)}."] if mixed else []

    def best(name: str, of: Any) -> Any:
        is_able = lambda r: r["violation"] <= NOISE_OF_ZERO  # noqa: E731
        return mark_best(records, name, of, is_able, lambda r: conditions[r["algorithm"]])

    marks = {
        SYMBOLS["episode_return"]: best("episode_return", max),
        SYMBOLS["violation"]: lambda r: "bad" if r["violation"] > NOISE_OF_ZERO else "",
        SYMBOLS["cost_rate"]: best("cost_rate", min),
    }
    title = {"shared": "What all algorithms were trained on"}.get(slate, slate)
    return Table(f"slate_{slate}", title, columns, records, " ".join(notes), marks=marks)
