"""What runs have left in their folders: evaluations, certificates, videos, commands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.recorded import Run
from safe_rl.reporting.tables import Record, Table, clean, each_cost, interval

__all__ = ["certificate_table", "duration", "evaluation_table", "run_table", "videos"]

_WHERE = {"environment": "{environment}", "algorithm": "{algorithm}", "seed": "{seed:d}"}


def _each_run(
    experiments: Sequence[Experiment],
) -> Iterator[tuple[dict[str, Any], Experiment, Run]]:
    for e in experiments:
        place = {"environment": e.environment, "algorithm": e.algorithm}
        yield from (({**place, "seed": run.seed}, e, run) for run in e.runs)


def run_table(experiments: Sequence[Experiment]) -> Table:
    """Every run with its final scores, its folder and the command that does it again."""
    records = [
        {
            **where,
            "steps": run.steps,
            "state": run.state,
            "hours": run.hours,
            "time": duration(run.hours),
            **run.final(["cost"]),
            "folder": clean(run.directory),
            "code": run.code,
            "command": run.command or "not recorded",
        }
        for where, _, run in _each_run(experiments)
    ]
    columns = {
        **_WHERE,
        "steps": "{steps:,}",
        "state": "{state}",
        "time": "{time:}",
        "steps/s": "{steps_per_second:,.0f}",
        "$J_r$": "{episode_return:.2f}",
        "$J_c$": "{episode_cost:.1f}",
        r"$\rho_c$": "{cost_rate:.4f}",
        **({"code": "{code}"} if any(r["code"] for r in records) else {}),
        "command": "{command}",
    }
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
        where | _evaluation_record(experiment, evaluation)
        for where, experiment, run in _each_run(experiments)
        for evaluation in run.evaluations
    ]
    names = dict.fromkeys(name for record in records for name in record)
    limited = [name.removeprefix("limit_") for name in names if name.startswith("limit_")]
    keys = list(dict.fromkeys([*(["cost"] if "episode_cost" in names else []), *limited]))
    columns = {
        **_WHERE,
        "checkpoint": "{checkpoint}",
        "episodes": "{episodes:d}",
        "what": "{manner}",
        "$J_r$": interval("episode_return", 2),
        **({"cost": "{cost}"} if len(keys) > 1 else {}),
        "$J_c$": interval("mean", 1),
        "$d$": "{limit:g}",
        # of many episodes a few are not none
        "P($C$ > $d$)": "{over:.1%}",
        "CVaR": "{cvar_alpha:.1%}: " + interval("cvar", 1),
    }
    fields = {"limit": "limit_{}", "over": "over_limit_{}"}
    for end in ("", "_low", "_high"):
        fields |= {f"mean{end}": f"episode_{{}}{end}", f"cvar{end}": f"cvar_{{}}{end}"}
    rows = each_cost(records, keys, **fields)
    marks = {"$J_c$": _is_over}
    return Table("evaluations", "Evaluations", columns, records, shown=rows, marks=marks)


def _evaluation_record(experiment: Experiment, evaluation: Mapping[str, Any]) -> dict[str, Any]:
    manner = [evaluation["name"]] if evaluation["name"] else []
    manner += ["mean actions" if evaluation["deterministic"] else "sampled actions"]
    manner += [f"{key}={value}" for key, value in evaluation["env"].items()]
    manner.append(f"{evaluation['layouts_trained_on']:.0%} known layouts")
    record = {
        **{key: evaluation[key] for key in ("checkpoint", "steps", "episodes", "cvar_alpha")},
        "manner": clean(", ".join(manner)),
        "other_measures": experiment.limits_of_other_measures,
        **{f"limit_{key}": limit for key, limit in evaluation["cost_limits"].items()},
    }
    for name, estimate in evaluation["estimates"].items():
        for part, value in estimate.items():
            record[name if part == "value" else f"{name}_{part}"] = value
    return record


def _is_over(row: Record) -> str:
    # of another measure than the mean these episodes do not say whether it keeps the limit
    if row.get("key") in row["other_measures"]:
        return ""
    return "bad" if row.get("mean", 0.0) > row.get("limit", inf) else ""


def certificate_table(experiments: Sequence[Experiment]) -> Table:
    """Which runs have a checkpoint that is certified to keep the limits."""
    records = []
    for where, _, run in _each_run(experiments):
        if (found := run.certificate) is not None:
            record = {**where, "certified": "no" if found["checkpoint"] is None else "yes"}
            record["surely"] = f"{100 * found['level']:.12g}%"  # not rounded up to 100
            record |= {name: value for name, value in found.items() if name != "bounds"}
            bounds = found["bounds"].items()
            record |= {f"bound_{name}": bound for name, (bound, _) in bounds}
            records.append(record | {f"most_{name}": most for name, (_, most) in bounds})
    names = dict.fromkeys(name for record in records for name in record)
    keys = [name.removeprefix("bound_") for name in names if name.startswith("bound_")]
    columns = {
        **_WHERE,
        "certified": "{certified}| at {surely}",
        "at": "{checkpoint:,} steps",
        "$J_r$": "{certified_return:.2f}",
        "bound on": "{cost}",
        "is": "{bound:.3g}",
        "limit": "{most:g}",
        "episodes": "{episodes:d}",
    }
    rows = each_cost(records, keys, bound="bound_{}", most="most_{}")
    marks = {"certified": lambda row: "bad" if row["certified"] == "no" else ""}
    return Table("certificates", "Certificates", columns, records, shown=rows, marks=marks)


def videos(experiments: Sequence[Experiment]) -> Iterator[tuple[str, Path]]:
    """One video of every experiment that has any: caption and file."""
    for experiment in experiments:
        found = [(run, path) for run in experiment.runs for path in run.videos]
        if found:
            run, path = found[0]
            # of an evaluation with a name, as of another environment, its name
            words = [experiment.environment, experiment.algorithm, f"seed {run.seed}"]
            words += filter(None, [path.stem.removeprefix("evaluation").lstrip("_")])
            yield ", ".join(words), path
