"""Tables of final scores, and of normalised ones as in the paper's Tables 1 and 2."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from safe_rl.reporting.archive import ReportedRun
from safe_rl.reporting.experiments import Experiment, cost_keys_of
from safe_rl.reporting.tables import Record, Table, each_cost, interval, mark_best, spread
from safe_rl.runs.table import final_rows
from safe_rl.scores import benchmark
from safe_rl.scores.benchmark import Normalised
from safe_rl.scores.comparisons import interquartile_mean

_STEPS = "{fewest_steps:,}| to {most_steps:,}"
_SYMBOLS = dict(
    zip(Normalised._fields, (r"$\bar J_r$", r"$\bar M_c$", r"$\bar \rho_c$"), strict=True)
)
_SCORES = {symbol: f"{{{name}:.3f}}" for name, symbol in _SYMBOLS.items()}
_PAPER = {f"paper {symbol}": f"{{paper_{name}:.3f}}" for name, symbol in _SYMBOLS.items()}


def final_record(experiment: Experiment, cost_keys: Sequence[str]) -> dict[str, Any]:
    """Final J_r, J_c and ρ_c of an experiment: mean and standard deviation over its seeds."""
    runs, lengths, limits = experiment.finished, experiment.lengths, experiment.limits
    excesses = {f"excess_{k}": float(np.mean([run.excess(k) for run in runs])) for k in limits}
    is_known = not any(map(math.isnan, excesses.values()))  # NaN if no episode has finished
    record: dict[str, Any] = {
        "environment": experiment.environment,
        "algorithm": experiment.algorithm,
        "seeds": len(runs),
        "steps": lengths[-1],
        "fewest_steps": lengths[0],
        "most_steps": lengths[-1] if lengths[1:] else None,
        "hours": float(np.mean([run.hours for run in runs])),
        **_over_seeds([run.figures(list(cost_keys)) | _critic_bias(run) for run in runs]),
        **{f"limit_{key}": limit for key, limit in limits.items()},
        **excesses,
        "satisfies": all(excess <= 0 for excess in excesses.values()) if is_known else None,
    }
    if experiment.is_published_problem:
        name = experiment.benchmark or ""
        if experiment.base == "ppo" and (paper := benchmark.REFERENCE.get(name)):
            record |= {f"paper_{field}": value for field, value in paper._asdict().items()}
        if later := benchmark.REIMPLEMENTATIONS.get(name, {}).get(experiment.base):
            record |= zip(("later_return", "later_cost"), later, strict=True)
    return record


def _critic_bias(run: ReportedRun) -> dict[str, float]:
    """Mean bias of every cost critic over the last epochs; positive if it predicts too much."""
    names = [name for name in run.table if name.startswith("critic_bias_")]
    known = {name: np.array(run.table[name])[final_rows(run.table)] for name in names}
    return {k: float(np.nanmean(v)) for k, v in known.items() if np.isfinite(v).any()}


def _over_seeds(values: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean and standard deviation of figures over the seeds that have them."""
    record = {}
    for name in dict.fromkeys(name for of_seed in values for name in of_seed):
        known = np.array([of_seed[name] for of_seed in values if name in of_seed])
        record[name] = float(known.mean())
        record[f"{name}_std"] = float(known.std(ddof=1)) if known.size > 1 else math.nan
    return record


def final_table(experiments: Sequence[Experiment]) -> Table:
    """Final scores on one environment, with published values beside them."""
    environment, keys = experiments[0].environment, cost_keys_of(experiments)
    records = [final_record(experiment, keys) for experiment in experiments]
    fields = {"mean": "episode_{}", "mean_std": "episode_{}_std", "limit": "limit_{}"}
    fields |= {"rate": "{}_rate", "rate_std": "{}_rate_std", "excess": "excess_{}"}
    rows = each_cost(records, keys, **fields, bias="critic_bias_{}")
    others = {e.algorithm: e.limits_of_other_measures for e in experiments}
    for row in rows:
        if row.get("key") in others[row["algorithm"]]:
            row["measure"] = row["limit"] + row["excess"]
    has = {name for row in rows for name in row}
    columns = {
        "algorithm": "{algorithm}",
        **({"cost": "{cost}"} if len(keys) > 1 else {}),
        # first what a limit is on: a phone shows two or three columns
        "$J_c$": spread("mean", 1),
        **({"limited measure": "{measure:.1f}"} if "measure" in has else {}),
        "$d$": "{limit:g}",
        "$J_r$": spread("episode_return", 2),
        r"$\rho_c$": spread("rate", 4),
        "seeds": "{seeds:d}",
        "steps": _STEPS,
        **({"critics' bias": "{bias:+.1f}"} if "bias" in has else {}),
    }
    if "paper_episode_return" in has:
        steps = benchmark.PUBLISHED_STEPS[str(experiments[0].benchmark)]
        title = f"paper, {steps / 1e6:g}M steps"
        columns[title] = "{paper_episode_return:g} / {paper_episode_cost:g} / {paper_cost_rate:g}"
    if "later_return" in has:
        title = f"later work, {benchmark.REIMPLEMENTATION_STEPS / 1e6:g}M steps"
        columns[title] = "{later_return:g} / {later_cost:g}"

    def over(row: Record) -> str:
        return "bad" if row.get("excess", 0.0) > 0 else ""

    # only experiments with equally long training and equal limits are compared
    rivals = {e.algorithm: (e.lengths, e.limits) for e in experiments}
    best_rate = mark_best(records, "cost_rate", min, lambda r: r["satisfies"], rivals)
    marks = {
        "$J_r$": mark_best(records, "episode_return", max, lambda r: r["satisfies"], rivals),
        # single costs are not ranked
        r"$\rho_c$": lambda row: best_rate(row) if row.get("key") == "cost" else "",
        "$J_c$": lambda row: "" if "measure" in row else over(row),
        "limited measure": lambda row: over(row) if "measure" in row else "",
    }
    return Table(f"final_{environment}", environment, columns, records, "", rows, marks)


def complete_slates(
    experiments: Sequence[Experiment], needed: int
) -> Iterator[tuple[str, list[list[Experiment]]]]:
    """Slates that one algorithm or more has complete, and the environments that all share.

    Yields the name of a slate, and for each algorithm with at least ``needed`` finished runs per
    environment its experiments, one per environment. Only plain experiments count, whose limit is
    on the mean ``cost`` and below the published cost of PPO: the difference is the unit.
    """
    by_algorithm: dict[str, dict[str, Experiment]] = {}
    for e in experiments:
        limit = e.limits.get("cost", math.inf)
        reference = benchmark.REFERENCE.get(str(e.benchmark))
        if reference is None or limit >= reference.episode_cost or e.limits_of_other_measures:
            continue
        if e.is_plain:
            cell = by_algorithm.setdefault(e.algorithm, {})
            if e.finished:
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


def _normalised_scores(experiments: Sequence[Experiment]) -> dict[str, list[np.ndarray]]:
    """Normalised final scores of one algorithm: score -> values per environment, one of a run."""
    strata: dict[str, list[np.ndarray]] = {name: [] for name in Normalised._fields}
    for e in experiments:
        finals = [run.figures(["cost"]) for run in e.finished]
        given = [[f[name] for f in finals] for name in benchmark.Scores._fields]
        reference = benchmark.REFERENCE[str(e.benchmark)]
        scores = benchmark.normalise(*given, limit=e.limits["cost"], reference=reference)
        for name, values in zip(strata, scores, strict=True):
            strata[name].append(values)
    return strata


def _slate_record(slate: str, experiments: Sequence[Experiment]) -> dict[str, Any]:
    """Averages over environments of averages over seeds, and interquartile means of all runs."""
    strata = _normalised_scores(experiments)
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


def _keeps(record: Record) -> bool:
    """Whether an algorithm keeps the constraint on a slate."""
    return bool(record["violation"] <= benchmark.NOISE_OF_ZERO)


def slate_table(slate: str, members: Sequence[Sequence[Experiment]]) -> Table:
    """A slate of `complete_slates` as in the paper's Tables 1 and 2, with published values."""
    records = [_slate_record(slate, experiments) for experiments in members]
    columns = {"algorithm": "{algorithm}", "runs": "{runs:d}", "steps": _STEPS, **_SCORES}
    if any("iqm_violation" in record for record in records):
        columns |= {f"IQM {s}": interval(f"iqm_{name}", 3) for name, s in _SYMBOLS.items()}
    note = f"On {', '.join(str(e.benchmark) for e in members[0])}."
    if slate in benchmark.PUBLISHED:
        columns |= _PAPER
        after = sorted({benchmark.PUBLISHED_STEPS[e] for e in benchmark.SLATES[slate]})
        note += f" Paper: after {' (Doggo: '.join(f'{n:,}' for n in after)} steps"
        note += ")." if len(after) > 1 else "."
    # only algorithms for which these are equal are compared
    rivals = {m[0].algorithm: [(e.lengths, e.limits["cost"]) for e in m] for m in members}
    marks = {
        _SYMBOLS["episode_return"]: mark_best(records, "episode_return", max, _keeps, rivals),
        _SYMBOLS["violation"]: lambda r: "bad" if r["violation"] > benchmark.NOISE_OF_ZERO else "",
        _SYMBOLS["cost_rate"]: mark_best(records, "cost_rate", min, _keeps, rivals),
    }
    title = "What all algorithms were trained on" if slate == "shared" else slate
    return Table(f"slate_{slate}", title, columns, records, note, marks=marks)


def paper_table(experiments: Sequence[Experiment]) -> Table:
    """The paper's Tables 1 and 2, as far as there are runs, with the published values beside ours.

    A row is an algorithm of the paper on a slate: averages over those of its environments on which
    it has finished runs. An algorithm dominates another one on the same environments after equally
    many steps if both keep the constraint and it has no lower return and no higher cost rate, and
    one of them is better.
    """
    ours = [e for e in experiments if e.is_of_paper]
    records: list[dict[str, Any]] = []
    for slate in ("SG18", "SG12", "SG6", "SG1", "SG2", "SGPoint", "SGCar", "SGDoggo"):
        names, rows = benchmark.SLATES[slate], []
        for algorithm in dict.fromkeys(e.algorithm for e in ours):
            members = [e for e in ours if e.algorithm == algorithm and e.benchmark in names]
            if members:
                record, there = _slate_record(slate, members), {e.benchmark for e in members}
                rows.append((record, (there, record["fewest_steps"], record["most_steps"])))
        for record, trained in rows:
            peers = [other for other, as_other in rows if as_other == trained and _keeps(other)]
            better = [p["algorithm"] for p in peers if _keeps(record) and _is_better(p, record)]
            counts = {"all": len(names), "environments": len(trained[0])}
            records.append({**record, **counts, "dominated": ", ".join(better)})
    columns = {
        **{"slate": "{slate}", "algorithm": "{algorithm}"},
        **{"environments": "{environments:d}| of {all:d}", "runs": "{runs:d}", "steps": _STEPS},
        **_SCORES,
        **_PAPER,
        "dominated by": "{dominated}",
    }
    note = (
        "Averages over the environments that there are; the paper's, over all of a slate after "
        "10,000,000 steps (Doggo: 100,000,000), stand only beside complete rows."
    )
    return Table("paper", "The paper's Tables 1 and 2", columns, records, note)


def _is_better(one: Record, other: Record) -> bool:
    """Whether no score of one is worse than the other's, and one of them is better."""
    gains = (one["episode_return"] - other["episode_return"], other["cost_rate"] - one["cost_rate"])
    return min(gains) >= 0 < max(gains)
