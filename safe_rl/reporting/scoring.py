"""Final scores of experiments, what learning them has cost, and which are better than which."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from statistics import mean
from typing import Any

import numpy as np

from safe_rl.reporting.experiments import Experiment, cost_keys_of
from safe_rl.reporting.recorded import Run
from safe_rl.reporting.tables import (
    Column,
    Record,
    Table,
    clean,
    each_cost,
    mark_best,
    power_of_ten,
    spread,
)
from safe_rl.runs.curves import moving_mean
from safe_rl.runs.outcome import FINAL_EPOCHS, final_width
from safe_rl.scores.measures import (
    Agent,
    compare,
    first_good_epoch,
    joined,
    longest_streak,
    regret,
    share_of_epochs_over,
)
from safe_rl.scores.published import (
    PUBLISHED_STEPS,
    REFERENCE,
    REIMPLEMENTATION_STEPS,
    REIMPLEMENTATIONS,
)

__all__ = ["dominance_table", "final_record", "final_table", "learning_table", "stem"]

# of a cost: field of a row -> that of a record
_FIGURES = {
    **{"mean": "episode_{}", "mean_std": "episode_{}_std", "limit": "limit_{}"},
    **{"rate": "{}_rate", "rate_std": "{}_rate_std", "excess": "excess_{}"},
}
_COURSE = {
    **{"regret": "regret_{}", "regret_std": "regret_{}_std"},
    **{"share_over": "share_over_{}", "streak": "streak_{}"},
}
IDENTITY = (Column("algorithm"), Column("seeds", ("{:d}", "seeds")))


def final_record(experiment: Experiment, cost_keys: Sequence[str]) -> dict[str, Any]:
    """Final J_r, J_c and ρ_c of an experiment: mean and standard deviation over its seeds."""
    runs, lengths = experiment.finished, experiment.lengths
    record: dict[str, Any] = {
        "environment": experiment.environment,
        "algorithm": experiment.algorithm,
        "family": experiment.family or experiment.algorithm,
        "seeds": len(runs),
        "steps": lengths[-1],
        "fewest_steps": lengths[0],
        "most_steps": lengths[-1] if lengths[1:] else None,
        "hours": float(np.mean([run.hours for run in runs])),
    }
    record |= _over_seeds([run.final(cost_keys) for run in runs])
    limits = experiment.limits
    record |= {f"limit_{key}": limit for key, limit in limits.items()}
    excesses = {k: float(np.mean([run.excess(k) for run in runs])) for k in limits}
    record |= {f"excess_{key}": excess for key, excess in excesses.items()}
    record["satisfies"] = all(excess <= 0 for excess in excesses.values())
    return record | _published(experiment)


def _over_seeds(values: Sequence[Mapping[str, float | None]]) -> dict[str, float]:
    """Mean and standard deviation of figures over the seeds that have them."""
    record = {}
    for name in dict.fromkeys(name for one in values for name in one):
        known = np.array([one[name] for one in values if one.get(name) is not None], dtype=float)
        if known.size:
            record[name] = float(known.mean())
            record[f"{name}_std"] = float(known.std(ddof=1)) if known.size > 1 else float("nan")
    return record


def _published(experiment: Experiment) -> dict[str, Any]:
    """Values printed elsewhere for the same environment and algorithm."""
    if not (experiment.benchmark and experiment.has_published_limit) or experiment.is_continued:
        return {}
    algorithm = experiment.runs[0].algorithm
    fields: dict[str, Any] = {}
    reference = REFERENCE.get(experiment.benchmark)
    if algorithm == "ppo" and reference is not None:
        fields |= {f"paper_{name}": value for name, value in reference._asdict().items()}
    later = REIMPLEMENTATIONS.get(experiment.benchmark, {}).get(algorithm)
    if later is not None:
        fields |= {"later_return": later[0], "later_cost": later[1]}
    return fields


def final_table(experiments: Sequence[Experiment]) -> Table:
    """Final scores on one environment, with what others have published beside them."""
    environment = experiments[0].environment
    cost_keys = cost_keys_of(experiments)
    records = [final_record(experiment, cost_keys) for experiment in experiments]
    columns = [
        *IDENTITY,
        Column("steps", ("{:,}", "fewest_steps"), (" to {:,}", "most_steps")),
        Column("$J_r$", *spread("episode_return", 2), mark=_best(records, "episode_return", max)),
        *_which(cost_keys),
        Column("$J_c$", *spread("mean", 1), mark=_is_over),
        Column("$d$", ("{:g}", "limit")),
        Column(r"$\rho_c$", *spread("rate", 4), mark=_best(records, "cost_rate", min)),
    ]
    if any("paper_episode_return" in record for record in records):
        steps = power_of_ten(PUBLISHED_STEPS[experiments[0].benchmark or ""])
        names = ("paper_episode_return", "paper_episode_cost", "paper_cost_rate")
        title = rf"paper, {steps} steps: $J_r$ / $J_c$ / $\rho_c$"
        columns.append(Column(title, ("{:g} / {:g} / {:g}", *names)))
    if any("later_return" in record for record in records):
        title = f"later work, {power_of_ten(REIMPLEMENTATION_STEPS)} steps: $J_r$ / $J_c$"
        columns.append(Column(title, ("{:g} / {:g}", "later_return", "later_cost")))
    notes = [
        _measure_note(record, key)
        for record, experiment in zip(records, experiments, strict=True)
        for key in experiment.limits_of_other_measures
    ]
    shown = each_cost(cost_keys, _FIGURES)
    return Table(stem("final", environment), environment, columns, records, " ".join(notes), shown)


def _which(cost_keys: Sequence[str]) -> list[Column]:
    """The column that says of which cost a row is, where there are several."""
    return [Column("cost", ("{}", "named"))] if len(cost_keys) > 1 else []


def stem(kind: str, environment: str) -> str:
    """Name of an environment's file."""
    return f"{kind}_{re.sub(r'[^A-Za-z0-9]+', '_', environment).strip('_')[:80]}"


def _is_over(row: Record) -> str:
    return "bad" if row.get("excess", 0.0) > 0 else ""


def _best(
    records: Sequence[Record], name: str, best: Callable[..., float]
) -> Callable[[Record], str]:
    """Mark of the best among those that satisfy the same constraints after equally many steps."""
    mark = mark_best(records, name, best, is_able=lambda r: r["satisfies"], rivals=rivals)
    # what single costs cost is not ranked
    return lambda row: mark(row) if name == "episode_return" or row["of"] == "cost" else ""


def rivals(record: Record) -> Hashable:
    """What is equal in experiments that can be ranked: the length of training, and the limits."""
    limits = {key: value for key, value in record.items() if key.startswith("limit_")}
    return record["fewest_steps"], record["steps"], frozenset(limits.items())


def _measure_note(record: Record, key: str) -> str:
    """Says that a limit is on something else than the mean that the table shows."""
    excess = record[f"excess_{key}"]
    verdict = f"{abs(excess):.1f} {'over' if excess > 0 else 'below'} $d$"
    return (
        f"{record['algorithm']}: the limit of {clean(key, 40)} is on another measure than the mean "
        f"$J_c$; over the last epochs that measure was {verdict}, and this is what is judged."
    )


def learning_table(experiments: Sequence[Experiment], good: float = 0.5) -> Table | None:
    """What learning has cost on one environment, and when policies became good.

    Args:
        experiments: All on the environment.
        good: Share of a return, the published PPO's or the best here, from which on one is good.

    Returns:
        The table, or None if nothing on it has a limit.
    """
    experiments = [e for e in experiments if e.limits]
    if not experiments:
        return None
    environment, keys = experiments[0].environment, cost_keys_of(experiments)
    keys = [key for key in keys if any(key in e.limits for e in experiments)]
    least, definition = _good(experiments, good)
    records = []
    for experiment in experiments:
        figures = [_learning_figures(run, least) for run in experiment.finished]
        reached = sum(one["good_steps"] is not None for one in figures)
        records.append(
            {
                "environment": environment,
                "algorithm": experiment.algorithm,
                "seeds": len(figures),
                "hours": mean(run.hours for run in experiment.finished),
                "seeds_good": None if least is None else reached,
                **_over_seeds(figures),
            }
        )
    columns = [
        *IDENTITY,
        *_which(keys),
        Column("regret", *spread("regret", 1)),
        Column("epochs over", ("{:.0%}", "share_over")),
        Column("longest streak", ("{:.0f}", "streak")),
        Column("steps until good", ("{:,.0f}", "good_steps")),
        Column("hours until good", ("{:.2f}", "good_hours")),
        Column("hours in all", ("{:.2f}", "hours")),
        Column("good seeds", ("{:d} of {:d}", "seeds_good", "seeds")),
    ]
    shown = each_cost(keys, _COURSE)
    return Table(stem("learning", environment), environment, columns, records, definition, shown)


def _good(experiments: Sequence[Experiment], share: float) -> tuple[float | None, str]:
    """The least return of a good policy on an environment, and the definition in words.

    None if the best final return is not above 0: a share of it would be more than all of it.
    """
    reference, whose = experiments[0].reference, "the published PPO's"
    if reference is not None:
        whole = reference.episode_return
    else:
        whose = "the final return of the best here"
        finals = [[run.final([])["episode_return"] for run in e.finished] for e in experiments]
        known = [value for value in map(mean, finals) if math.isfinite(value)]
        whole = max(known, default=0.0)
    if whole <= 0:
        return None, f"Good: not defined, as {whose} is not above 0, and has no share."
    return share * whole, (
        f"Good: $J_r$ at least {share * whole:.4g}, {share:.0%} of {whose}, and every $J_c$ within "
        "its limit, over as many epochs as final figures; steps and hours are means over the seeds "
        "that came to it."
    )


def _learning_figures(run: Run, least_return: float | None) -> dict[str, float | None]:
    returns = run.column("episode_return")
    figures: dict[str, float | None] = {"good_steps": None, "good_hours": None}
    if not returns.size:
        return figures
    worst, width = np.full(returns.shape, -np.inf), final_width(run.column("steps"))
    for key, limit in run.limits.items():
        violation = run.column(f"violation_{key}")
        costs = run.column(f"episode_{key}")
        judged = np.where(np.isfinite(violation), limit + violation, costs)
        judged = judged if run.limits_another_measure(key) else costs
        spans = joined(judged, width // FINAL_EPOCHS)
        figures[f"regret_{key}"] = regret(spans, limit)
        figures[f"share_over_{key}"] = share_of_epochs_over(spans, limit)
        figures[f"streak_{key}"] = longest_streak(spans, limit)
        worst = np.maximum(worst, moving_mean(judged, width) - limit)
    least = math.inf if least_return is None else least_return
    epoch = first_good_epoch(moving_mean(returns, width), worst, least, 0.0)
    if epoch is not None:
        figures["good_steps"] = float(run.column("steps")[epoch])
        figures["good_hours"] = float(run.column("time_total")[epoch]) / 3600
    return figures


def dominance_table(records: Iterable[Record]) -> Table:
    """Which algorithm is better than which on each environment.

    What has finished no episode neither keeps its limits nor breaks them, and is not ranked.
    """
    records, relations = [record for record in records if _is_measured(record)], []
    for environment in dict.fromkeys(record["environment"] for record in records):
        agents = {
            r["algorithm"]: Agent(
                r["episode_return"], r.get("cost_rate", 0.0), r["satisfies"], rivals(r)
            )
            for r in records
            if r["environment"] == environment
        }
        for better, worse, reason in compare(agents):
            relations.append(
                {
                    "environment": environment, "better": better, "worse": worse,
                    "reason": reason, "why": _REASONS[reason],
                }
            )  # fmt: skip
    names = ("environment", "better", "worse", "why")
    return Table("dominance", "Which is better", [Column(name) for name in names], relations)


def _is_measured(record: Record) -> bool:
    judged = [value for name, value in record.items() if name.startswith("excess_")]
    return all(map(math.isfinite, [record["episode_return"], *judged]))


_REASONS = {"satisfies": "keeps its limits, the other does not", "dominates": "≻ dominates"}
