"""What runs have left in their folders: evaluations, videos, commands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.recorded import Run
from safe_rl.reporting.tables import Column, Record, Table, clean, each_cost, interval

__all__ = [
    *("certificate_table", "duration", "evaluation_table", "run_table", "variant_table", "videos"),
]

_WHERE = (Column("environment"), Column("algorithm"))
_SEED = Column("seed", ("{:d}", "seed"))


def run_table(experiments: Sequence[Experiment]) -> Table:
    """Every run with its final scores, its folder and the command that does it again."""
    records = [
        {
            "environment": experiment.environment,
            "algorithm": experiment.algorithm,
            "seed": run.seed,
            "steps": run.steps,
            "state": _state(run),
            "hours": run.hours,
            "time": duration(run.hours),
            **run.final(["cost"]),
            "folder": clean(run.directory),
            "code": run.code,
            "command": run.command or "not recorded",
        }
        for experiment in experiments
        for run in experiment.runs
    ]
    columns = [
        *_WHERE,
        _SEED,
        Column("steps", ("{:,}", "steps")),
        Column("state"),
        Column("time", ("{:}", "time")),
        Column("steps/s", ("{:,.0f}", "steps_per_second")),
        Column("$J_r$", ("{:.2f}", "episode_return")),
        Column("$J_c$", ("{:.1f}", "episode_cost")),
        Column(r"$\rho_c$", ("{:.4f}", "cost_rate")),
        *([Column("code")] if any(r["code"] for r in records) else []),
        Column("command"),
    ]
    return Table("runs", "Runs", columns, records)


def _state(run: Run) -> str:
    # of its own end, whether or not an unfinished run is to count as a finished one
    meant = run.config["frames"]
    return "finished" if run.steps >= meant else f"{run.steps / meant:.0%}"


def variant_table(experiments: Sequence[Experiment]) -> Table:
    """Settings that experiments of one algorithm differ in and that their names leave out."""
    settings = {e.algorithm: e.settings for e in experiments if e.settings}
    records = [{"algorithm": name, "settings": text} for name, text in settings.items()]
    columns = [Column("algorithm"), Column("all of it", ("{}", "settings"))]
    return Table("variants", "What differs between runs of one algorithm", columns, records)


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
        for evaluation in run.evaluations
    ]
    names = dict.fromkeys(name for record in records for name in record)
    limited = [name.removeprefix("limit_") for name in names if name.startswith("limit_")]
    keys = list(dict.fromkeys([*(["cost"] if "episode_cost" in names else []), *limited]))
    columns = [
        *_WHERE,
        _SEED,
        Column("checkpoint"),
        Column("episodes", ("{:d}", "episodes")),
        Column("what", ("{}", "manner")),
        Column("$J_r$", *interval("episode_return", 2)),
        *([Column("cost", ("{}", "named"))] if len(keys) > 1 else []),
        Column("$J_c$", *interval("mean", 1), mark=_is_over),
        Column("$d$", ("{:g}", "limit")),
        # of many episodes a few are not none
        Column("P($C$ > $d$)", ("{:.1%}", "over")),
        Column("CVaR", ("{:.1%}: {:.1f}", "cvar_alpha", "cvar"), interval("cvar", 1)[1]),
    ]
    fields = {"limit": "limit_{}", "over": "over_limit_{}"}
    for end in ("", "_low", "_high"):
        fields |= {f"mean{end}": f"episode_{{}}{end}", f"cvar{end}": f"cvar_{{}}{end}"}
    shown = each_cost(keys, fields)
    return Table("evaluations", "Evaluations", columns, records, shown_as=shown)


def certificate_table(experiments: Sequence[Experiment]) -> Table:
    """Which runs have a checkpoint that is certified to keep the limits."""
    records = [
        _certificate_record(experiment, run, run.certificate)
        for experiment in experiments
        for run in experiment.runs
        if run.certificate is not None
    ]
    found = dict.fromkeys(name for record in records for name in record)
    names = [name.removeprefix("bound_") for name in found if name.startswith("bound_")]
    columns = [
        *_WHERE,
        _SEED,
        Column("certified", ("{}", "certified"), (" at {}", "surely"), mark=_is_missing),
        Column("at", ("{:,} steps", "checkpoint")),
        Column("$J_r$", ("{:.2f}", "certified_return")),
        Column("bound on", ("{}", "named")),
        Column("is", ("{:.3g}", "bound")),
        Column("limit", ("{:g}", "most")),
        Column("episodes", ("{:d}", "episodes")),
    ]
    shown = each_cost(names, {"bound": "bound_{}", "most": "most_{}"})
    return Table("certificates", "Certificates", columns, records, shown_as=shown)


def _certificate_record(
    experiment: Experiment, run: Run, certificate: Mapping[str, Any]
) -> dict[str, Any]:
    bounds = certificate["bounds"].items()
    return {
        "environment": experiment.environment,
        "algorithm": experiment.algorithm,
        "seed": run.seed,
        "certified": "no" if certificate["checkpoint"] is None else "yes",
        "surely": f"{100 * certificate['level']:.12g}%",  # not rounded up to 100
        **{name: value for name, value in certificate.items() if name != "bounds"},
        **{f"bound_{name}": bound for name, (bound, _) in bounds},
        **{f"most_{name}": most for name, (_, most) in bounds},
    }


def _is_missing(record: Record) -> str:
    return "bad" if record["certified"] == "no" else ""


def _evaluation_record(
    experiment: Experiment, run: Run, evaluation: Mapping[str, Any]
) -> dict[str, Any]:
    manner = [evaluation["name"]] if evaluation["name"] else []
    manner += ["mean actions" if evaluation["deterministic"] else "sampled actions"]
    manner += [f"{key}={value}" for key, value in evaluation["env"].items()]
    manner.append(f"{evaluation['layouts_trained_on']:.0%} known layouts")
    record = {
        "environment": experiment.environment,
        "algorithm": experiment.algorithm,
        "seed": run.seed,
        **{key: evaluation[key] for key in ("checkpoint", "steps", "episodes", "cvar_alpha")},
        "manner": clean(", ".join(manner)),
        "other_measures": experiment.limits_of_other_measures,
    }
    record |= {f"limit_{key}": limit for key, limit in evaluation["cost_limits"].items()}
    for name, estimate in evaluation["estimates"].items():
        for part, value in estimate.items():
            record[name if part == "value" else f"{name}_{part}"] = value
    return record


def _is_over(row: Record) -> str:
    # of another measure than the mean these episodes do not say whether it keeps the limit
    if row.get("of") in row["other_measures"]:
        return ""
    return "bad" if row.get("mean", 0.0) > row.get("limit", inf) else ""


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
