"""Tables of what the folders of runs hold: their ends, certificates and evaluations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf, nan
from typing import Any

from safe_rl.reporting.archive import ReportedRun
from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.tables import (
    Record,
    Table,
    clean,
    each_cost,
    interval,
    read_certificate,
    read_code,
    read_evaluation,
)
from safe_rl.scores.bounds import rounded_up

_WHERE = {"environment": "{environment}", "algorithm": "{algorithm}", "seed": "{seed:d}"}


def _each_run(experiments: Sequence[Experiment]) -> Iterator[tuple[dict[str, Any], ReportedRun]]:
    for e in experiments:
        place = {"environment": e.environment, "algorithm": e.algorithm}
        yield from (({**place, "seed": run.seed}, run) for run in e.runs)


def _names(records: Sequence[Record], start: str) -> list[str]:
    """The names of all fields with a prefix, without it."""
    fields = dict.fromkeys(name for record in records for name in record)
    return [name.removeprefix(start) for name in fields if name.startswith(start)]


def run_table(experiments: Sequence[Experiment]) -> Table:
    """Every run with its final scores, its folder and the command that repeats it."""
    records = [
        {
            **where,
            "steps": run.steps,
            "state": "finished" if run.steps >= frames else f"{run.steps / frames:.0%}",
            "hours": run.hours,
            "time": duration(run.hours),
            **run.figures(["cost"]),
            "folder": clean(run.directory),
            "code": read_code(run.notes["code"]) if "code" in run.notes else None,
            "command": run.repeating or "not recorded",
        }
        for where, run in _each_run(experiments)
        for frames in [run.settings["frames"]]
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
    """A duration in minutes or hours.

    Examples:
        >>> duration(0.21), duration(2.5)
        ('13 min', '2.5 h')
    """
    return f"{60 * hours:.0f} min" if hours < 1 else f"{hours:,.1f} h"


def evaluation_table(experiments: Sequence[Experiment]) -> Table:
    """The results of ``safe-rl evaluate`` of all runs."""
    records = [
        {**where, **read_evaluation(evaluation)}
        for where, run in _each_run(experiments)
        for evaluation in run.notes.get("evaluations", ())
    ]
    others = {(e.environment, e.algorithm): e.limits_of_other_measures for e in experiments}
    total = ["cost"] if any("episode_cost" in record for record in records) else []
    keys = list(dict.fromkeys([*total, *_names(records, "limit_")]))
    columns = {
        **_WHERE,
        "checkpoint": "{checkpoint}",
        "episodes": "{episodes:d}",
        "what": "{manner}",
        "$J_r$": interval("episode_return", 2),
        **({"cost": "{cost}"} if len(keys) > 1 else {}),
        "$J_c$": interval("mean", 1),
        "$d$": "{limit:g}",
        # with a decimal: a few of many episodes are not shown as 0 %
        "P($C$ > $d$)": "{over:.1%}",
        "CVaR": "{cvar_alpha:.1%}: " + interval("cvar", 1),
    }
    fields = {"limit": "limit_{}", "over": "over_limit_{}"}
    for end in ("", "_low", "_high"):
        fields |= {f"mean{end}": f"episode_{{}}{end}", f"cvar{end}": f"cvar_{{}}{end}"}

    def over(row: Record) -> str:
        # a limit on another measure than the mean is not judged by these episodes' mean
        is_mean_limited = row.get("key") not in others[row["environment"], row["algorithm"]]
        return "bad" if is_mean_limited and row.get("mean", 0.0) > row.get("limit", inf) else ""

    rows = each_cost(records, keys, **fields)
    return Table("evaluations", "Evaluations", columns, records, shown=rows, marks={"$J_c$": over})


def certificate_table(experiments: Sequence[Experiment]) -> Table:
    """The certificates of all runs that have one."""
    records = [
        {**where, **read_certificate(run.notes["certificate"])}
        for where, run in _each_run(experiments)
        if "certificate" in run.notes
    ]
    columns = {
        **_WHERE,
        "certified": "{certified}| at {surely}",
        "at": "{checkpoint:,} steps",
        "$J_r$": "{certified_return:.2f}",
        "bound on": "{cost}",
        "is": "{bound:.4g}",
        "limit": "{most:g}",
        "episodes": "{episodes:d}",
        "test": "{test}, {actions} actions",
    }
    rows = each_cost(records, _names(records, "bound_"), bound="bound_{}", most="most_{}")
    rows = [{**row, "bound": rounded_up(row.get("bound", nan), 4)} for row in rows]
    marks = {"certified": lambda row: "bad" if row["certified"] == "no" else ""}
    note = ""
    if any(record["test"] == "Student" for record in records):
        note = "Student: a bound that is too low if rare episodes cost far more than the others."
    return Table("certificates", "Certificates", columns, records, note, rows, marks)
