"""Tables of final scores, of costs during learning, and of normalised scores."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from statistics import mean
from typing import Any

import numpy as np

from safe_rl.reporting.experiments import Experiment, cost_keys_of
from safe_rl.reporting.recorded import Run
from safe_rl.reporting.tables import Record, Table, each_cost, interval, mark_best, spread
from safe_rl.runs.outcome import FINAL_EPOCHS, final_rows, final_width
from safe_rl.scores import benchmark, measures
from safe_rl.scores.benchmark import Normalised
from safe_rl.scores.comparisons import interquartile_mean

_SYMBOLS = dict(
    zip(Normalised._fields, (r"$\bar J_r$", r"$\bar M_c$", r"$\bar \rho_c$"), strict=True)
)


def final_record(experiment: Experiment, cost_keys: Sequence[str]) -> dict[str, Any]:
    """Final J_r, J_c and ρ_c of an experiment: mean and standard deviation over its seeds."""
    runs, lengths, limits = experiment.finished, experiment.lengths, experiment.limits
    excesses = {f"excess_{k}": float(np.mean([run.excess(k) for run in runs])) for k in limits}
    return {
        "environment": experiment.environment,
        "algorithm": experiment.algorithm,
        "seeds": len(runs),
        "steps": lengths[-1],
        "fewest_steps": lengths[0],
        "most_steps": lengths[-1] if lengths[1:] else None,
        "hours": float(np.mean([run.hours for run in runs])),
        **_over_seeds([run.final(cost_keys) | _critic_bias(run) for run in runs]),
        **{f"limit_{key}": limit for key, limit in limits.items()},
        **excesses,
        "satisfies": all(excess <= 0 for excess in excesses.values()),
        **_published(experiment),
    }


def _critic_bias(run: Run) -> dict[str, float]:
    """Mean bias of every cost critic over the last epochs; positive if it predicts too much."""
    names = [name for name in run.table if name.startswith("critic_bias_")]
    known = {name: np.array(run.table[name])[final_rows(run.table)] for name in names}
    return {k: float(np.nanmean(v)) for k, v in known.items() if np.isfinite(v).any()}


def _over_seeds(values: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean and standard deviation of figures over the seeds that have them."""
    record = {}
    for name in dict.fromkeys(name for one in values for name in one):
        known = np.array([one[name] for one in values if name in one])
        record[name] = float(known.mean())
        record[f"{name}_std"] = float(known.std(ddof=1)) if known.size > 1 else math.nan
    return record


def _published(experiment: Experiment) -> dict[str, Any]:
    """Published values for the same environment, which no transform changes, and algorithm."""
    changed = any(run.config.get("transforms") for run in experiment.runs)
    if changed or experiment.is_continued or not experiment.has_published_limit:
        return {}
    paper = experiment.reference if experiment.base == "ppo" else None
    later = benchmark.REIMPLEMENTATIONS.get(experiment.benchmark or "", {}).get(experiment.base)
    fields = {f"paper_{name}": value for name, value in (paper._asdict() if paper else {}).items()}
    return fields | dict(zip(("later_return", "later_cost"), later or (), strict=False))


def final_table(experiments: Sequence[Experiment]) -> Table:
    """Final scores on one environment, with published values beside them."""
    environment, keys = experiments[0].environment, cost_keys_of(experiments)
    records = [final_record(experiment, keys) for experiment in experiments]
    fields = {"mean": "episode_{}", "mean_std": "episode_{}_std", "limit": "limit_{}"}
    fields |= {"rate": "{}_rate", "rate_std": "{}_rate_std", "excess": "excess_{}"}
    rows = [dict(row) for row in each_cost(records, keys, **fields, bias="critic_bias_{}")]
    others = {e.algorithm: e.limits_of_other_measures for e in experiments}
    for row in rows:
        if row.get("key") in others[row["algorithm"]]:
            row["measure"] = row["limit"] + row["excess"]
    has = {name for row in [*rows, *records] for name in row}
    columns = {
        "algorithm": "{algorithm}",
        "seeds": "{seeds:d}",
        "steps": "{fewest_steps:,}| to {most_steps:,}",
        "$J_r$": spread("episode_return", 2),
        **({"cost": "{cost}"} if len(keys) > 1 else {}),
        "$J_c$": spread("mean", 1),
        **({"limited measure": "{measure:.1f}"} if "measure" in has else {}),
        "$d$": "{limit:g}",
        r"$\rho_c$": spread("rate", 4),
        **({"critics' bias": "{bias:+.1f}"} if "bias" in has else {}),
    }
    if "paper_episode_return" in has:
        steps = benchmark.PUBLISHED_STEPS[str(experiments[0].benchmark)]
        title = f"paper, {steps / 1e6:g}M steps"
        columns[title] = "{paper_episode_return:g} / {paper_episode_cost:g} / {paper_cost_rate:g}"
    if "later_return" in has:
        title = f"later work, {benchmark.REIMPLEMENTATION_STEPS / 1e6:g}M steps"
        columns[title] = "{later_return:g} / {later_cost:g}"
    marks = _final_marks(records, {e.algorithm: (e.lengths, e.limits) for e in experiments})
    return Table(f"final_{environment}", environment, columns, records, "", rows, marks)


def _final_marks(
    records: Sequence[Record], rivals: Mapping[str, Any]
) -> dict[str, Callable[[Record], str]]:
    """Column -> marks of costs over their limits, and of the best scores that keep them.

    Only experiments with equal ``rivals`` (lengths of training, limits) are compared.
    """

    def best(name: str, of: Callable[..., float]) -> Callable[[Record], str]:
        mark = mark_best(records, name, of, lambda r: r["satisfies"], rivals)
        # single costs are not ranked
        return lambda row: mark(row) if name == "episode_return" or row.get("key") == "cost" else ""

    def over(row: Record) -> str:
        return "bad" if row.get("excess", 0.0) > 0 else ""

    return {
        "$J_r$": best("episode_return", max),
        r"$\rho_c$": best("cost_rate", min),
        "$J_c$": lambda row: "" if "measure" in row else over(row),
        "limited measure": lambda row: over(row) if "measure" in row else "",
    }


def learning_table(experiments: Sequence[Experiment]) -> Table | None:
    """Costs during learning on one environment; None if no experiment has a limit."""
    experiments = [e for e in experiments if e.limits]
    if not experiments:
        return None
    environment = experiments[0].environment
    keys = [k for k in cost_keys_of(experiments) if any(k in e.limits for e in experiments)]
    records = [
        {
            "environment": environment,
            "algorithm": e.algorithm,
            "seeds": len(e.finished),
            "hours": mean(run.hours for run in e.finished),
            **_over_seeds([_learning_figures(run) for run in e.finished]),
        }
        for e in experiments
    ]
    columns = {
        **{"algorithm": "{algorithm}", "seeds": "{seeds:d}"},
        **({"cost": "{cost}"} if len(keys) > 1 else {}),
        "regret": spread("regret", 1),
        "epochs over": "{over:.0%}",
        "longest streak": "{streak:.0f}",
        "hours": "{hours:.2f}",
    }
    fields = {"regret": "regret_{}", "regret_std": "regret_{}_std"}
    rows = each_cost(records, keys, **fields, over="share_over_{}", streak="streak_{}")
    return Table(f"learning_{environment}", environment, columns, records, "", rows)


def _learning_figures(run: Run) -> dict[str, float]:
    figures: dict[str, float] = {}
    if not run.column("episode_return").size:
        return figures
    width = final_width(run.column("steps"))
    for key, limit in run.limits.items():
        judged = costs = run.column(f"episode_{key}")
        if run.limits_another_measure(key):
            violation = run.column(f"violation_{key}")
            judged = np.where(np.isfinite(violation), limit + violation, costs)
        spans = measures.joined(judged, width // FINAL_EPOCHS)
        figures |= {f"{name}_{key}": v for name, v in measures.learning_cost(spans, limit).items()}
    return figures


def complete_slates(
    experiments: Sequence[Experiment], needed: int
) -> Iterator[tuple[str, list[list[Experiment]]]]:
    """Slates that one algorithm or more has complete, and the environments that all share.

    Yields the name of a slate, and for each algorithm with at least ``needed`` finished runs per
    environment its experiments, one per environment, with a limit on ``cost``. Runs that started
    from another run's networks do not count.
    """
    own: dict[str, dict[str, Experiment]] = {}
    for e in experiments:
        if e.benchmark in benchmark.REFERENCE and not e.is_continued:
            found = own.setdefault(e.algorithm, {})
            if "cost" in e.limits and e.finished:
                found[str(e.benchmark)] = e
    shared = tuple(n for n in benchmark.REFERENCE if all(n in found for found in own.values()))
    slates = {name: (slate, needed) for name, slate in benchmark.SLATES.items()}
    shown = []
    for name, (slate, least) in {**slates, "shared": (shared, 1)}.items():
        members = [
            [found[env] for env in slate]
            for found in own.values()
            if all(env in found and len(found[env].finished) >= least for env in slate)
        ]
        if slate and members and slate not in shown:
            shown.append(slate)
            yield name, members


def normalised_scores(experiments: Sequence[Experiment]) -> dict[str, list[np.ndarray]]:
    """Normalised final scores of one algorithm: score -> values per environment, one of a run."""
    strata: dict[str, list[np.ndarray]] = {name: [] for name in Normalised._fields}
    for e in experiments:
        assert e.reference is not None
        finals = [run.final(["cost"]) for run in e.finished]
        returns, rates = ([f[name] for f in finals] for name in ("episode_return", "cost_rate"))
        # J_c, or the other measure that the run compares with the limit
        limit = e.limits["cost"]
        judged = limit + np.array([run.excess("cost") for run in e.finished])
        scores = measures.normalise(returns, judged, rates, limit=limit, reference=e.reference)
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
    if paper and all(e.has_published_limit for e in experiments):
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

    def best(name: str, of: Any) -> Any:
        is_able = lambda r: r["violation"] <= measures.NOISE_OF_ZERO  # noqa: E731
        return mark_best(records, name, of, is_able, rivals)

    marks = {
        _SYMBOLS["episode_return"]: best("episode_return", max),
        _SYMBOLS["violation"]: lambda r: "bad" if r["violation"] > measures.NOISE_OF_ZERO else "",
        _SYMBOLS["cost_rate"]: best("cost_rate", min),
    }
    title = {"shared": "What all algorithms were trained on"}.get(slate, slate)
    return Table(f"slate_{slate}", title, columns, records, note, marks=marks)
