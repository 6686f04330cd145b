"""What runs have left in their folders: evaluations, videos, commands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf
from pathlib import Path
from typing import Any

from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.runs import Run
from safe_rl.reporting.tables import (
    MISSING,
    Column,
    Table,
    limit_text,
    number,
    plain,
    with_interval,
)

__all__ = ["duration", "evaluation_table", "run_table", "videos"]


def run_table(experiments: Sequence[Experiment]) -> Table:
    """Every run with its final scores, its folder and the command that does it again."""
    records = [
        {
            "environment": experiment.environment,
            "algorithm": experiment.algorithm,
            "seed": run.seed,
            "steps": run.steps,
            "state": "finished" if run.is_finished else f"{run.steps / run.frames:.0%}",
            "hours": run.hours,
            **run.final(["cost"]),
            "folder": str(run.directory),
            "command": run.command or "not recorded",
        }
        for experiment in experiments
        for run in experiment.runs
    ]
    columns = [
        Column("environment", plain("environment"), is_number=False),
        Column("algorithm", plain("algorithm"), is_number=False),
        Column("seed", plain("seed")),
        Column("steps", lambda r: f"{r['steps']:,}"),
        Column("", plain("state"), is_number=False),
        Column("time", lambda r: duration(r["hours"])),
        Column("steps/s", lambda r: f"{r['steps_per_second']:,.0f}"),
        Column("$J_r$", number("episode_return", 2)),
        Column("$J_c$", number("episode_cost", 1)),
        Column(r"$\rho_c$", number("cost_rate", 4)),
        Column("command", plain("command"), is_number=False),
    ]
    return Table("runs", "Runs", columns, records)


def duration(hours: float) -> str:
    """A time as people say it.

    Examples:
        >>> duration(0.21), duration(2.5)
        ('13 min', '2.5 h')
    """
    return f"{60 * hours:.0f} min" if hours < 1 else f"{hours:,.1f} h"


def evaluation_table(experiments: Sequence[Experiment]) -> Table:
    """What ``python -m safe_rl.evaluate`` has found of the runs."""
    records = [
        _evaluation_record(experiment, run, evaluation)
        for experiment in experiments
        for run in experiment.runs
        for evaluation in run.evaluations()
    ]
    names = dict.fromkeys(name for record in records for name in record)
    limited = [name.removeprefix("limit_") for name in names if name.startswith("limit_")]
    keys = list(dict.fromkeys(["cost", *limited]))
    columns = [
        Column("environment", plain("environment"), is_number=False),
        Column("algorithm", plain("algorithm"), is_number=False),
        Column("seed", plain("seed")),
        Column("checkpoint", plain("checkpoint"), is_number=False),
        Column("episodes", plain("episodes")),
        Column("what", plain("manner"), is_number=False),
        Column("$J_r$", with_interval("episode_return", 2)),
    ]
    for key in keys:
        columns += _cost_columns(key, "" if len(keys) == 1 else f" [{key}]")
    note = (
        "Whole episodes of the trained policy, with 95 % intervals over episodes. Over limit: the "
        "share of episodes that cost more than $d$. CVaR: mean cost of the costliest episodes, of "
        "how many is said before it."
    )
    return Table("evaluations", "Evaluations", columns, records, note)


def _evaluation_record(
    experiment: Experiment, run: Run, evaluation: dict[str, Any]
) -> dict[str, Any]:
    manner = ["mean actions" if evaluation["deterministic"] else "sampled actions"]
    manner += [f"{key}={value}" for key, value in evaluation["env"].items()]
    manner.append(f"{evaluation['layouts_trained_on']:.0%} known layouts")
    record = {
        "environment": experiment.environment,
        "algorithm": experiment.algorithm,
        "seed": run.seed,
        "checkpoint": evaluation["checkpoint"],
        "steps": evaluation["steps"],
        "episodes": evaluation["episodes"],
        "manner": ", ".join(manner),
        "cvar_alpha": evaluation["cvar_alpha"],
        "other_measures": " ".join(experiment.limits_of_other_measures),
    }
    record |= {f"limit_{key}": limit for key, limit in evaluation["cost_limits"].items()}
    for name, estimate in evaluation["estimates"].items():
        for part, value in estimate.items():
            record[name if part == "value" else f"{name}_{part}"] = value
    return record


def _cost_columns(key: str, suffix: str) -> list[Column]:
    """J_c, d, share of episodes over it and CVaR of one cost."""

    def is_over(record: Any) -> str:
        # of another measure than the mean these episodes do not say whether it keeps the limit
        if key in record["other_measures"].split():
            return ""
        return "bad" if record.get(f"episode_{key}", 0.0) > record.get(f"limit_{key}", inf) else ""

    def cvar(record: Any) -> str:
        shown = with_interval(f"cvar_{key}", 1)(record)
        return shown if shown == MISSING else f"{record['cvar_alpha']:.0%}: {shown}"

    return [
        Column(f"$J_c${suffix}", with_interval(f"episode_{key}", 1), is_over),
        Column(f"$d${suffix}", limit_text(key)),
        Column(f"over limit{suffix}", _share(f"over_limit_{key}")),
        Column(f"CVaR of the cost{suffix}", cvar),
    ]


def _share(name: str) -> Any:
    def text(record: Any) -> str:
        value = record.get(name)
        return MISSING if value is None else f"{value:.0%}"

    return text


def videos(experiments: Sequence[Experiment]) -> Iterator[tuple[str, Path]]:
    """One video of every experiment that has any: caption and file."""
    for experiment in experiments:
        found = [(run, path) for run in experiment.runs for path in run.videos]
        if found:
            run, path = found[0]
            yield f"{experiment.environment}, {experiment.algorithm}, seed {run.seed}", path
