"""Tables of final scores, of costs during learning, and of what the folders of runs hold."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf, nan
from typing import Any

import numpy as np

from safe_rl.reporting.archive import Run
from safe_rl.reporting.experiments import Experiment, cost_keys_of
from safe_rl.reporting.tables import Record, Table, clean, each_cost, interval, mark_best, spread
from safe_rl.runs.table import final_rows
from safe_rl.scores import benchmark
from safe_rl.scores.bounds import rounded_up


def final_record(experiment: Experiment, cost_keys: Sequence[str]) -> dict[str, Any]:
    """Final J_r, J_c and ρ_c of an experiment: mean and standard deviation over its seeds."""
    runs, lengths, limits = experiment.finished, experiment.lengths, experiment.limits
    excesses = {f"excess_{k}": float(np.mean([run.excess(k) for run in runs])) for k in limits}
    # NaN if no episode has finished
    worst = None if any(map(math.isnan, excesses.values())) else max(excesses.values(), default=0.0)
    return {
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
        "satisfies": None if worst is None else worst <= 0,
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
    for name in dict.fromkeys(name for of_seed in values for name in of_seed):
        known = np.array([of_seed[name] for of_seed in values if name in of_seed])
        record[name] = float(known.mean())
        record[f"{name}_std"] = float(known.std(ddof=1)) if known.size > 1 else math.nan
    return record


def _published(experiment: Experiment) -> dict[str, Any]:
    """Published values for the same problem and algorithm."""
    if not experiment.is_published_problem:
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
        **({"cost": "{cost}"} if len(keys) > 1 else {}),
        # first what a limit is on: a phone shows two or three columns
        "$J_c$": spread("mean", 1),
        **({"limited measure": "{measure:.1f}"} if "measure" in has else {}),
        "$d$": "{limit:g}",
        "$J_r$": spread("episode_return", 2),
        r"$\rho_c$": spread("rate", 4),
        "seeds": "{seeds:d}",
        "steps": "{fewest_steps:,}| to {most_steps:,}",
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

    def over(row: Record) -> str:
        return "bad" if row.get("excess", 0.0) > 0 else ""

    rates = mark_best(records, "cost_rate", min, lambda r: r["satisfies"], rivals)
    return {
        "$J_r$": mark_best(records, "episode_return", max, lambda r: r["satisfies"], rivals),
        # single costs are not ranked
        r"$\rho_c$": lambda row: rates(row) if row.get("key") == "cost" else "",
        "$J_c$": lambda row: "" if "measure" in row else over(row),
        "limited measure": lambda row: over(row) if "measure" in row else "",
    }


_WHERE = {"environment": "{environment}", "algorithm": "{algorithm}", "seed": "{seed:d}"}


def _each_run(experiments: Sequence[Experiment]) -> Iterator[tuple[dict[str, Any], Run]]:
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
            "code": run.code_text,
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
    runs = _each_run(experiments)
    records = [{**where, **record} for where, run in runs for record in run.evaluation_records]
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
    runs = _each_run(experiments)
    records = [{**where, **run.certificate_record} for where, run in runs if run.certificate_record]
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
