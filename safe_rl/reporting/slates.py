"""Tables of normalised scores: averages over sets of environments, as in the paper's tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.tables import Record, Table, interval, mark_best
from safe_rl.scores import benchmark
from safe_rl.scores.benchmark import Normalised
from safe_rl.scores.comparisons import interquartile_mean

_SYMBOLS = dict(
    zip(Normalised._fields, (r"$\bar J_r$", r"$\bar M_c$", r"$\bar \rho_c$"), strict=True)
)


def complete_slates(
    experiments: Sequence[Experiment], needed: int
) -> Iterator[tuple[str, list[list[Experiment]]]]:
    """Slates that one algorithm or more has complete, and the environments that all share.

    Yields the name of a slate, and for each algorithm with at least ``needed`` finished runs per
    environment its experiments, one per environment, with a limit on ``cost``. Only plain
    experiments count.
    """
    by_algorithm: dict[str, dict[str, Experiment]] = {}
    for e in experiments:
        if e.benchmark in benchmark.REFERENCE and e.is_plain:
            cell = by_algorithm.setdefault(e.algorithm, {})
            if "cost" in e.limits and e.finished:
                cell[str(e.benchmark)] = e
    cells = by_algorithm.values()
    shared = tuple(name for name in benchmark.REFERENCE if all(name in cell for cell in cells))
    slates = {name: (slate, needed) for name, slate in benchmark.SLATES.items()}
    shown = []
    for name, (slate, least) in {**slates, "shared": (shared, 1)}.items():
        members = [
            [cell[env] for env in slate]
            for cell in cells
            if all(env in cell and len(cell[env].finished) >= least for env in slate)
        ]
        if slate and members and slate not in shown:
            shown.append(slate)
            yield name, members


def normalised_scores(experiments: Sequence[Experiment]) -> dict[str, list[np.ndarray]]:
    """Normalised final scores of one algorithm: score -> values per environment, one of a run."""
    strata: dict[str, list[np.ndarray]] = {name: [] for name in Normalised._fields}
    for e in experiments:
        assert e.reference is not None
        finals = [run.figures(["cost"]) for run in e.finished]
        returns, rates = ([f[name] for f in finals] for name in ("episode_return", "cost_rate"))
        # J_c, or the other measure that the run compares with the limit
        limit = e.limits["cost"]
        measures = limit + np.array([run.excess("cost") for run in e.finished])
        scores = benchmark.normalise(returns, measures, rates, limit=limit, reference=e.reference)
        for name, values in zip(strata, scores, strict=True):
            strata[name].append(values)
    return strata


def _record(slate: str, experiments: Sequence[Experiment]) -> dict[str, Any]:
    """Averages over environments of averages over seeds, and interquartile means of all runs."""
    strata = normalised_scores(experiments)
    steps = {steps for e in experiments for steps in e.lengths}
    record: dict[str, Any] = {
        "slate": slate,
        "algorithm": experiments[0].algorithm,
        "runs": sum(map(len, strata["violation"])),
        "fewest_steps": min(steps),
        "most_steps": max(steps) if len(steps) > 1 else None,
        **{name: float(np.mean([runs.mean() for runs in s])) for name, s in strata.items()},
    }
    if record["runs"] > 1:
        for name in strata:
            names = (f"iqm_{name}", f"iqm_{name}_low", f"iqm_{name}_high")
            record |= zip(names, interquartile_mean(strata[name]), strict=True)
    paper = benchmark.PUBLISHED.get(slate, {}).get(experiments[0].base)
    is_whole = len(experiments) == len(benchmark.SLATES.get(slate, ()))
    if paper and is_whole and all(e.is_published_problem for e in experiments):
        record |= {f"paper_{name}": value for name, value in paper._asdict().items()}
    return record


def slate_table(slate: str, members: Sequence[Sequence[Experiment]]) -> Table:
    """A slate of `complete_slates` as in the paper's Tables 1 and 2, with published values."""
    records = [_record(slate, experiments) for experiments in members]
    # only algorithms for which these are equal are compared
    rivals = {m[0].algorithm: [(e.lengths, e.limits["cost"]) for e in m] for m in members}
    columns = {"algorithm": "{algorithm}", "runs": "{runs:d}"}
    columns["steps"] = "{fewest_steps:,}| to {most_steps:,}"
    columns |= {symbol: f"{{{name}:.3f}}" for name, symbol in _SYMBOLS.items()}
    if any("iqm_violation" in record for record in records):
        columns |= {f"IQM {s}": interval(f"iqm_{name}", 3) for name, s in _SYMBOLS.items()}
    note = f"On {', '.join(str(e.benchmark) for e in members[0])}."
    if slate in benchmark.PUBLISHED:
        columns |= {f"paper {s}": f"{{paper_{name}:.3f}}" for name, s in _SYMBOLS.items()}
        after = sorted({benchmark.PUBLISHED_STEPS[e] for e in benchmark.SLATES[slate]})
        note += f" Paper: after {' (Doggo: '.join(f'{n:,}' for n in after)} steps"
        note += ")." if len(after) > 1 else "."

    def is_able(record: Record) -> bool:
        return record["violation"] <= benchmark.NOISE_OF_ZERO

    marks = {
        _SYMBOLS["episode_return"]: mark_best(records, "episode_return", max, is_able, rivals),
        _SYMBOLS["violation"]: lambda r: "bad" if r["violation"] > benchmark.NOISE_OF_ZERO else "",
        _SYMBOLS["cost_rate"]: mark_best(records, "cost_rate", min, is_able, rivals),
    }
    title = {"shared": "What all algorithms were trained on"}.get(slate, slate)
    return Table(f"slate_{slate}", title, columns, records, note, marks=marks)


def paper_table(experiments: Sequence[Experiment]) -> Table:
    """The paper's Tables 1 and 2, as far as there are runs, with the published values beside ours.

    A row is an algorithm of the paper on a slate: averages over those of its environments on which
    it has finished runs. An algorithm dominates another one on the same environments if both keep
    the constraint and it has no lower return and no higher cost rate, and one of them is better.
    """
    by_algorithm: dict[str, list[Experiment]] = {}
    for e in experiments:
        is_ours = e.base in benchmark.ALGORITHMS and e.is_published_problem
        if is_ours and e.reference is not None and e.finished:
            by_algorithm.setdefault(e.algorithm, []).append(e)
    records: list[dict[str, Any]] = []
    for slate in ("SG18", "SG12", "SG6", "SG1", "SG2", "SGPoint", "SGCar", "SGDoggo"):
        names = benchmark.SLATES[slate]
        for candidates in by_algorithm.values():
            members = [e for e in candidates if e.benchmark in names]
            if members:
                there = {str(e.benchmark) for e in members}
                records.append({**_record(slate, members), "there": there, "all": len(names)})
    rows = [
        {**r, "environments": len(r["there"]), "dominated": ", ".join(_dominating(r, records))}
        for r in records
    ]
    columns = {
        **{"slate": "{slate}", "algorithm": "{algorithm}"},
        **{"environments": "{environments:d}| of {all:d}", "runs": "{runs:d}"},
        "steps": "{fewest_steps:,}| to {most_steps:,}",
        **{symbol: f"{{{name}:.3f}}" for name, symbol in _SYMBOLS.items()},
        **{f"paper {symbol}": f"{{paper_{name}:.3f}}" for name, symbol in _SYMBOLS.items()},
        "dominated by": "{dominated}",
    }
    kept = [{k: v for k, v in row.items() if k != "there"} for row in rows]
    note = (
        "Averages over the environments that there are; the paper's, over all of a slate after "
        "10,000,000 steps (Doggo: 100,000,000), stand only beside complete rows."
    )
    return Table("paper", "The paper's Tables 1 and 2", columns, kept, note)


def _dominating(record: Record, records: Sequence[Record]) -> list[str]:
    alike = ("slate", "there", "fewest_steps", "most_steps")

    def figures(scores: Record) -> tuple[float, float]:
        return scores["episode_return"], -scores["cost_rate"]

    return [
        other["algorithm"]
        for other in records
        if all(other[name] == record[name] for name in alike)
        and max(other["violation"], record["violation"]) <= benchmark.NOISE_OF_ZERO
        and figures(other) != figures(record)
        and all(a >= b for a, b in zip(figures(other), figures(record), strict=True))
    ]
