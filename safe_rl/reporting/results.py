"""Final scores of experiments, and which are better than which (paper section 5.1)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.tables import (
    MISSING,
    Column,
    Table,
    limit_text,
    mark_best,
    number,
    plain,
    power_of_ten,
)
from safe_rl.scores.dominance import Agent, compare
from safe_rl.scores.published import (
    PUBLISHED_STEPS,
    REFERENCE,
    REIMPLEMENTATION_STEPS,
    REIMPLEMENTATIONS,
)

__all__ = ["cost_keys_of", "dominance_table", "final_record", "final_table"]

Records = list[dict[str, Any]]


def cost_keys_of(experiments: Iterable[Experiment]) -> list[str]:
    """The aggregate cost, and every cost key that one of the experiments limits."""
    limited = [key for experiment in experiments for key in experiment.limits]
    return list(dict.fromkeys(["cost", *limited]))


def final_record(experiment: Experiment, cost_keys: Sequence[str]) -> dict[str, Any]:
    """Final J_r, J_c and ρ_c of an experiment: mean and standard deviation over its seeds."""
    runs = experiment.finished
    finals = [run.final([key for key in cost_keys if f"{key}_rate" in run.table]) for run in runs]
    record: dict[str, Any] = {
        "environment": experiment.environment,
        "algorithm": experiment.algorithm,
        "seeds": len(runs),
        "steps": max(run.steps for run in runs),
        "hours": float(np.mean([run.hours for run in runs])),
    }
    for name in finals[0]:
        values = np.array([final[name] for final in finals])
        record[name] = float(values.mean())
        record[f"{name}_std"] = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
    limits = experiment.limits
    record |= {f"limit_{key}": limit for key, limit in limits.items()}
    excesses = {f"excess_{key}": _mean(run.excess(key) for run in runs) for key in limits}
    record |= excesses
    record["satisfies"] = all(excess <= 0 for excess in excesses.values())
    record["other_measures"] = " ".join(experiment.limits_of_other_measures)
    return record | _published(experiment)


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def _published(experiment: Experiment) -> dict[str, Any]:
    """Values printed elsewhere for the same environment and algorithm."""
    if experiment.benchmark is None or not experiment.has_published_limit:
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


def final_table(environment: str, records: Records, cost_keys: Sequence[str]) -> Table:
    """Final scores on one environment, with what others have published beside them."""

    def is_over(key: str) -> Any:
        return lambda r: "bad" if r.get(f"excess_{key}", 0.0) > 0 else ""

    columns = [
        Column("algorithm", plain("algorithm"), is_number=False),
        Column("seeds", plain("seeds")),
        Column("steps", lambda r: f"{r['steps']:,}"),
        Column(
            "$J_r$",
            number("episode_return", 2, "episode_return_std"),
            _best(records, "episode_return", max),
        ),
    ]
    for key in cost_keys:
        suffix = "" if len(cost_keys) == 1 else f" [{key}]"
        cost, rate = f"episode_{key}", f"{key}_rate"
        columns += [
            Column(f"$J_c${suffix}", number(cost, 1, f"{cost}_std"), is_over(key)),
            Column(f"$d${suffix}", limit_text(key)),
            Column(
                rf"$\rho_c${suffix}",
                number(rate, 4, f"{rate}_std"),
                _best(records, rate, min) if key == "cost" else lambda record: "",
            ),
        ]
    if any("paper_episode_return" in record for record in records):
        paper = f"paper, {power_of_ten(PUBLISHED_STEPS[environment])} steps"
        columns.append(Column(rf"{paper}: $J_r$ / $J_c$ / $\rho_c$", _paper))
    if any("later_return" in record for record in records):
        later = f"later work, {power_of_ten(REIMPLEMENTATION_STEPS)} steps"
        columns.append(Column(f"{later}: $J_r$ / $J_c$", _later))
    stem = "".join(c if c.isalnum() else "_" for c in environment).strip("_")
    notes = [_measure_note(record, key) for record in records for key in _other_measures(record)]
    return Table(f"final_{stem}", environment, columns, records, " ".join(notes))


def _other_measures(record: Any) -> list[str]:
    return record["other_measures"].split()


def _measure_note(record: Any, key: str) -> str:
    """Says that a limit is on something else than the mean that the table shows."""
    excess = record[f"excess_{key}"]
    verdict = f"{abs(excess):.1f} {'over' if excess > 0 else 'below'} $d$"
    return (
        f"{record['algorithm']}: the limit of {key} is on another measure than the mean $J_c$; "
        f"over the last five epochs that measure was {verdict}, and this is what is judged."
    )


def _best(records: Records, name: str, best: Any) -> Any:
    """Mark of the best among those that satisfy their constraints."""
    return mark_best(
        records, name, best,
        is_able=lambda r: r["satisfies"], steps=lambda r: r["steps"],
    )  # fmt: skip


def _paper(record: Any) -> str:
    if "paper_episode_return" not in record:
        return MISSING
    values = (record[f"paper_{name}"] for name in ("episode_return", "episode_cost", "cost_rate"))
    return " / ".join(f"{value:g}" for value in values)


def _later(record: Any) -> str:
    if "later_return" not in record:
        return MISSING
    return f"{record['later_return']:g} / {record['later_cost']:g}"


def dominance_table(records: Records) -> Table:
    """Which algorithm is better than which on each environment."""
    relations: Records = []
    for environment in dict.fromkeys(record["environment"] for record in records):
        agents = {
            record["algorithm"]: Agent(
                record["episode_return"],
                record["cost_rate"],
                record["satisfies"],
                record["steps"],
            )
            for record in records
            if record["environment"] == environment
        }
        for better, worse, reason in compare(agents):
            relations.append(
                {"environment": environment, "better": better, "worse": worse, "reason": reason}
            )
    reasons = {"satisfies": "keeps its limits, the other does not", "dominates": "≻ dominates"}
    return Table(
        "dominance",
        "Which is better",
        [
            Column("environment", plain("environment"), is_number=False),
            Column("better", plain("better"), is_number=False),
            Column("worse", plain("worse"), is_number=False),
            Column("why", lambda r: reasons[r["reason"]], is_number=False),
        ],
        relations,
        "By means over seeds (section 5.1 of the paper). What keeps its limits is better than what "
        "does not, after however many steps. Not ranked: two that both violate theirs, and two "
        "that both keep theirs, but after different numbers of steps or each better in one "
        "respect.",
    )
