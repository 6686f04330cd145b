"""Final scores of experiments, and what learning them has cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from statistics import mean
from typing import Any

import numpy as np

from safe_rl.reporting.experiments import Experiment, cost_keys_of
from safe_rl.reporting.recorded import Run
from safe_rl.reporting.tables import Record, Table, each_cost, mark_best, short_number, spread
from safe_rl.runs.outcome import FINAL_EPOCHS, final_rows, final_width
from safe_rl.scores.benchmark import PUBLISHED_STEPS, REIMPLEMENTATION_STEPS, REIMPLEMENTATIONS
from safe_rl.scores.measures import joined, longest_streak, regret, share_of_epochs_over

__all__ = ["final_record", "final_table", "learning_table"]


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
    """By how much cost critics predicted too much over the last epochs, of each cost with one."""
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
    """Values printed elsewhere for the same environment and algorithm."""
    if not (experiment.benchmark and experiment.has_published_limit) or experiment.is_continued:
        return {}
    later = REIMPLEMENTATIONS.get(experiment.benchmark, {}).get(experiment.base)
    fields: dict[str, Any] = {}
    if experiment.base == "ppo" and experiment.reference is not None:
        fields |= {f"paper_{k}": v for k, v in experiment.reference._asdict().items()}
    return fields | ({"later_return": later[0], "later_cost": later[1]} if later else {})


def final_table(experiments: Sequence[Experiment]) -> Table:
    """Final scores on one environment, with what others have published beside them."""
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
        title = f"paper, {short_number(PUBLISHED_STEPS[experiments[0].benchmark or ''])} steps"
        columns[title] = "{paper_episode_return:g} / {paper_episode_cost:g} / {paper_cost_rate:g}"
    if "later_return" in has:
        title = f"later work, {short_number(REIMPLEMENTATION_STEPS)} steps"
        columns[title] = "{later_return:g} / {later_cost:g}"
    marks = _final_marks(records)
    return Table(f"final_{environment}", environment, columns, records, "", rows, marks)


def _final_marks(records: Sequence[Record]) -> dict[str, Callable[[Record], str]]:
    """What is over its limit, and the best of what is not, column by column."""

    def best(name: str, of: Callable[..., float]) -> Callable[[Record], str]:
        mark = mark_best(records, name, of, lambda r: r["satisfies"], _rivals)
        # single costs are not ranked
        return lambda row: mark(row) if name == "episode_return" or row["key"] == "cost" else ""

    def over(row: Record) -> str:
        return "bad" if row.get("excess", 0.0) > 0 else ""

    return {
        "$J_r$": best("episode_return", max),
        r"$\rho_c$": best("cost_rate", min),
        "$J_c$": lambda row: "" if "measure" in row else over(row),
        "limited measure": lambda row: over(row) if "measure" in row else "",
    }


def _rivals(record: Record) -> Hashable:
    """What is equal in experiments that can be ranked: the length of training, and the limits."""
    limits = {key: value for key, value in record.items() if key.startswith("limit_")}
    return record["fewest_steps"], record["steps"], frozenset(limits.items())


def learning_table(experiments: Sequence[Experiment]) -> Table | None:
    """What learning has cost on one environment, if anything on it has a limit."""
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
        spans = joined(judged, width // FINAL_EPOCHS)
        figures[f"regret_{key}"] = regret(spans, limit)
        figures[f"share_over_{key}"] = share_of_epochs_over(spans, limit)
        figures[f"streak_{key}"] = longest_streak(spans, limit)
    return figures
