"""Final scores of experiments, what learning them has cost, and which are better than which."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from statistics import mean
from typing import Any

import numpy as np

from safe_rl.reporting.experiments import Experiment, cost_keys_of
from safe_rl.reporting.recorded import Run
from safe_rl.reporting.tables import Record, Table, each_cost, mark_best, short_number, spread
from safe_rl.runs.curves import moving_mean
from safe_rl.runs.outcome import FINAL_EPOCHS, final_rows, final_width
from safe_rl.scores.benchmark import PUBLISHED_STEPS, REIMPLEMENTATION_STEPS, REIMPLEMENTATIONS
from safe_rl.scores.measures import (
    Agent,
    compare,
    first_good_epoch,
    joined,
    longest_streak,
    regret,
    share_of_epochs_over,
)

__all__ = ["better_tables", "final_record", "final_table", "learning_table", "matrix", "signs_of"]


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


def _over_seeds(values: Sequence[Mapping[str, float | None]]) -> dict[str, float]:
    """Mean and standard deviation of figures over the seeds that have them."""
    record = {}
    for name in dict.fromkeys(name for one in values for name in one):
        known = np.array([one[name] for one in values if one.get(name) is not None], dtype=float)
        if known.size:
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
    shown = {"cost": len(keys) > 1, "limited measure": any("measure" in row for row in rows)}
    shown["critics' bias"] = any("bias" in row for row in rows)
    columns = {
        "algorithm": "{algorithm}",
        "seeds": "{seeds:d}",
        "steps": "{fewest_steps:,}| to {most_steps:,}",
        "$J_r$": spread("episode_return", 2),
        "cost": "{cost}",
        "$J_c$": spread("mean", 1),
        "limited measure": "{measure:.1f}",
        "$d$": "{limit:g}",
        r"$\rho_c$": spread("rate", 4),
        "critics' bias": "{bias:+.1f}",
    }
    columns = {title: text for title, text in columns.items() if shown.get(title, True)}
    if any("paper_episode_return" in record for record in records):
        title = f"paper, {short_number(PUBLISHED_STEPS[experiments[0].benchmark or ''])} steps"
        columns[title] = "{paper_episode_return:g} / {paper_episode_cost:g} / {paper_cost_rate:g}"
    if any("later_return" in record for record in records):
        title = f"later work, {short_number(REIMPLEMENTATION_STEPS)} steps"
        columns[title] = "{later_return:g} / {later_cost:g}"

    def best(name: str, of: Callable[..., float]) -> Callable[[Record], str]:
        mark = mark_best(records, name, of, lambda r: r["satisfies"], _rivals)
        # what single costs cost is not ranked
        return lambda row: mark(row) if name == "episode_return" or row["key"] == "cost" else ""

    def over(row: Record) -> str:
        return "bad" if row.get("excess", 0.0) > 0 else ""

    marks = {
        "$J_r$": best("episode_return", max),
        r"$\rho_c$": best("cost_rate", min),
        "$J_c$": lambda row: "" if "measure" in row else over(row),
        "limited measure": lambda row: over(row) if "measure" in row else "",
    }
    return Table(_stem("final", environment), environment, columns, records, "", rows, marks)


def _stem(kind: str, environment: str) -> str:
    return f"{kind}_{re.sub(r'[^A-Za-z0-9]+', '_', environment).strip('_')[:80]}"


def _rivals(record: Record) -> Hashable:
    """What is equal in experiments that can be ranked: the length of training, and the limits."""
    limits = {key: value for key, value in record.items() if key.startswith("limit_")}
    return record["fewest_steps"], record["steps"], frozenset(limits.items())


def learning_table(experiments: Sequence[Experiment], good: float = 0.5) -> Table | None:
    """What learning has cost on one environment, if anything on it has a limit.

    A policy is good from a share of a return on: the published PPO's, or the best here.
    """
    experiments = [e for e in experiments if e.limits]
    if not experiments:
        return None
    environment, keys = experiments[0].environment, cost_keys_of(experiments)
    keys = [key for key in keys if any(key in e.limits for e in experiments)]
    least, definition = _good(experiments, good)
    records = []
    for e in experiments:
        figures = [_learning_figures(run, least) for run in e.finished]
        reached = sum(one["good_steps"] is not None for one in figures)
        record = {"environment": environment, "algorithm": e.algorithm, "seeds": len(figures)}
        record["hours"] = mean(run.hours for run in e.finished)
        record["seeds_good"] = None if least is None else reached
        records.append(record | _over_seeds(figures))
    columns = {
        **{"algorithm": "{algorithm}", "seeds": "{seeds:d}"},
        **({"cost": "{cost}"} if len(keys) > 1 else {}),
        "regret": spread("regret", 1),
        "epochs over": "{over:.0%}",
        "longest streak": "{streak:.0f}",
        "steps until good": "{good_steps:,.0f}",
        "hours until good": "{good_hours:.2f}",
        "hours in all": "{hours:.2f}",
        "good seeds": "{seeds_good:d} of {seeds:d}",
    }
    fields = {"regret": "regret_{}", "regret_std": "regret_{}_std"}
    rows = each_cost(records, keys, **fields, over="share_over_{}", streak="streak_{}")
    return Table(_stem("learning", environment), environment, columns, records, definition, rows)


def _good(experiments: Sequence[Experiment], share: float) -> tuple[float | None, str]:
    """The least return of a good policy on an environment, and the definition in words."""
    reference, whose = experiments[0].reference, "the published PPO's"
    if reference is not None:
        whole = reference.episode_return
    else:
        whose = "the final return of the best here"
        finals = [[run.final([])["episode_return"] for run in e.finished] for e in experiments]
        whole = max([value for value in map(mean, finals) if math.isfinite(value)], default=0.0)
    if whole <= 0:
        return None, f"Good: not defined, as {whose} is not above 0."
    return share * whole, (
        f"Good: $J_r$ at least {share * whole:.4g}, {share:.0%} of {whose}, and every $J_c$ within "
        "its limit, over as many epochs as final scores; steps and hours are means over the good "
        "seeds."
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


def better_tables(records: Sequence[Record]) -> list[Table]:
    """Which algorithm is better than which: a file of all pairs, and a matrix per environment.

    What has finished no episode neither keeps its limits nor breaks them, and is not ranked.
    """
    groups: dict[Hashable, list[Record]] = {}
    for record in records:
        judged = [value for name, value in record.items() if name.startswith("excess_")]
        if all(map(math.isfinite, [record["episode_return"], *judged])):
            groups.setdefault((record["environment"], _rivals(record)), []).append(record)
    pairs: list[Record] = []
    matrices = []
    for own in groups.values():
        first = own[0]
        agents = {
            r["algorithm"]: Agent(r["episode_return"], r.get("cost_rate", 0.0), r["satisfies"], 0)
            for r in own
        }
        place, fields = first["environment"], ("environment", "better", "worse", "reason")
        found = [dict(zip(fields, (place, *pair), strict=True)) for pair in compare(agents)]
        pairs += found
        words = [place, f"{short_number(first['steps'])} steps"]
        words += [f"{name[6:]} ≤ {first[name]:g}" for name in first if name.startswith("limit_")]
        matrices += [matrix(", ".join(words), [*agents], signs_of(agents))] if found else []
    return [Table("dominance", "", {}, pairs), *matrices]


def signs_of(agents: Mapping[str, Agent]) -> dict[tuple[str, str], str]:
    """Pair of algorithms -> sign, if the first is better by the rules of the paper."""
    signs = {"satisfies": "✓", "dominates": "≻"}
    return {(better, worse): signs[reason] for better, worse, reason in compare(agents)}


def matrix(title: str, names: Sequence[str], signs: Mapping[tuple[str, str], str]) -> Table:
    """A table with a row and a column per algorithm."""
    numbers = range(1, len(names) + 1)
    rows = []
    for row, one in zip(numbers, names, strict=True):
        cells = {f"c{n}": signs.get((one, names[n - 1]), "") for n in numbers} | {f"c{row}": "·"}
        rows.append({"algorithm": f"{row} {one}", **cells})
    columns = {"better than …": "{algorithm}"} | {f"{n}": f"{{c{n}}}" for n in numbers}
    return Table("", title, columns, rows, is_matrix=True)
