"""What runs came to: tables for the pages of the algorithms from results/algorithms/."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from pathlib import Path

import archived_runs
import numpy as np
from pandas import DataFrame, Series

PAGES = Path(__file__).resolve().parents[1] / "algorithms"
RESULTS = Path(__file__).resolve().parents[2] / "results"
LIMIT, FRAMES, QUARTER, EPOCH = 25.0, 1_000_000, 250_000, 20_000
ENVIRONMENTS = ("PointGoal1", "CarGoal1")
ARCHIVE = RESULTS / "algorithms"
BUDGETS = (60, 120, 300, 600)  # seconds of training
MISSING = "—"
PAUSE = 20  # times the median of a run's epochs: longer ones are not training alone


def finished_runs(archive: Path, algo: str, env: str) -> dict[int, DataFrame]:
    """Tables by seed of the runs that are as long as those that are compared."""
    return archived_runs.finished_runs(archive, algo, env, FRAMES)


def last_quarter(runs: Iterable[DataFrame]) -> DataFrame:
    """Return, episode cost and share of epochs above the limit of every run towards its end."""
    return DataFrame([_part_of(rows, FRAMES - QUARTER, FRAMES) for rows in runs])


def _part_of(rows: DataFrame, start: float, end: float) -> dict[str, float]:
    """Means over the epochs of a part of a run in which episodes ended.

    What is above the limit is counted by stretches of the protocol's 20,000 steps, whatever number
    of steps an algorithm's epochs have.
    """
    part = rows[(rows.steps > start) & (rows.steps <= end)].dropna(subset="episode_return")
    stretches = part.groupby(np.ceil(part.steps / EPOCH)).episode_cost.mean()
    return {
        "return": part.episode_return.mean(),
        "cost": part.episode_cost.mean(),
        "above": (stretches > LIMIT).mean(),
        "rate": rows.cost_rate.iloc[-1],
    }


def _command(algo: str, seeds: str, env: str, settings: str = "") -> str:
    words = f"python train.py -m env={env} algo={algo} seed={seeds} frames=1_000_000 {settings}"
    return f"`{words.rstrip()}`"


def _groups(algo: str, env: str, runs: dict[int, DataFrame]) -> list[tuple[str, list[int]]]:
    return archived_runs.groups(ARCHIVE, algo, env, list(runs))


def _named(algo: str, settings: str) -> str:
    """First cell of a row: the algorithm, and what tells its settings from another row's."""
    return f"[`{algo}`]({algo}.md)" + (f" `{settings}`" if settings else "")


def measured(algo: str) -> str:
    """What an algorithm's page says of its runs."""
    runs = {env: found for env in ENVIRONMENTS if (found := finished_runs(ARCHIVE, algo, env))}
    if not runs:
        command = _command(algo, "300,301,302", ENVIRONMENTS[0])
        return f"Not yet: {command} is what the comparison is made of."
    tables = "\n\n".join(_quarters(algo, env, found) for env, found in runs.items())
    return f"""Return / episode cost in each quarter of a run, with limit 25 and the defaults of the
run's commit, unless a setting is named ([how far these results go](comparison.md)):

{tables}"""


def _quarters(algo: str, env: str, runs: dict[int, DataFrame]) -> str:
    """Table of the runs in one environment, a row per seed."""
    rows = [
        f"| {env}, seed | first | second | third | last | epochs of the last above the limit "
        "| $\\rho_c$ |",
        "|---|---|---|---|---|---|---|",
    ]
    groups = _groups(algo, env, runs)
    settings = {seed: f", `{named}`" if named else "" for named, seeds in groups for seed in seeds}
    for seed, table in runs.items():
        quarters = [_part_of(table, start, start + QUARTER) for start in range(0, FRAMES, QUARTER)]
        cells = [f"{part['return']:.1f} / {part['cost']:.0f}" for part in quarters]
        last = quarters[-1]
        named = f"{seed}{settings[seed]}"
        rows.append(f"| {named} | {' | '.join(cells)} | {last['above']:.0%} | {last['rate']:.3f} |")
    commands = [_command(algo, ",".join(map(str, seeds)), env, named) for named, seeds in groups]
    return "\n".join(rows) + "\n\n" + "\n\n".join(commands)


def algorithms() -> list[str]:
    """Those whose pages have measurements of a million steps."""
    return [
        p.stem for p in sorted(PAGES.glob("*.md")) if f"made: measured {p.stem} " in p.read_text()
    ]


def compared(env: str) -> str:
    """Table of the algorithms in one environment, a row each."""
    return _compared(algorithms(), env)


def timed(env: str) -> str:
    """What they came to in equal times; empty where no time is shared by most of them."""
    return _timed(algorithms(), env)


def spread_of_times() -> str:
    """Largest factor between the times that seeds of one algorithm took, in any environment."""
    return f"{_spread_of_times(algorithms()):.1f}"


def _compared(algorithms: Iterable[str], env: str) -> str:
    """Table of the algorithms in one environment, a row each."""
    rows = [
        f"| {env}, `algo=` | seeds | return | episode cost | epochs above 25 | $\\rho_c$ "
        "| certified |",
        "|---|---|---|---|---|---|---|",
    ]
    missing: list[str] = []
    for algo in algorithms:
        runs = finished_runs(ARCHIVE, algo, env)
        if not runs:
            missing.append(f"`{algo}`")
        for settings, seeds in _groups(algo, env, runs):
            parts = last_quarter(runs[seed] for seed in seeds)
            cells = [
                _named(algo, settings),
                str(len(parts)),
                *end_cells(parts, 1),
                f"{parts.rate.mean():.3f}",
                archived_runs.certificates(ARCHIVE, algo, env, seeds),
            ]
            rows.append(f"| {' | '.join(cells)} |")
    found = "\n".join(rows) + "\n\n" if len(rows) > 2 else ""
    return f"{found}Not run yet on {env}: {', '.join(missing)}." if missing else found.rstrip()


def end_cells(parts: DataFrame, digits: int) -> list[str]:
    """Cells of a table: return with so many digits, episode cost, epochs above the limit."""
    several = len(parts) > 1
    return [
        *(
            spread(parts[name].mean(), parts[name].std() if several else None, n)
            for name, n in (("return", digits), ("cost", 1))
        ),
        f"{parts.above.mean():.0%}",
    ]


def spread(mean: float, deviation: float | None, digits: int) -> str:
    """A mean and, if there is one, the deviation around it."""
    return f"{mean:.{digits}f}" + ("" if deviation is None else f" ± {deviation:.{digits}f}")


def _timed(algorithms: Iterable[str], env: str) -> str:
    """Table of what the algorithms came to in one environment in equal times, a row each.

    Times by which most of the runs had come to their end are left out.
    """
    cells: dict[tuple[str, int], list[str]] = {}
    for algo in algorithms:
        runs = finished_runs(ARCHIVE, algo, env)
        for settings, seeds in _groups(algo, env, runs):
            tables = [runs[seed] for seed in seeds]
            row = [_within(tables, seconds) for seconds in BUDGETS]
            cells[_named(algo, settings), len(seeds)] = row
    empty = [sum(row[n] == MISSING for row in cells.values()) for n in range(len(BUDGETS))]
    shown = [n for n in range(len(BUDGETS)) if 2 * empty[n] <= len(cells)]
    if not (cells and shown):
        return ""
    heads = [f"{env}, `algo=`", "seeds", *(f"{BUDGETS[n]} s" for n in shown)]
    rows = [[name, str(seeds), *(row[n] for n in shown)] for (name, seeds), row in cells.items()]
    lines = [f"| {' | '.join(row)} |" for row in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


def _within(tables: list[DataFrame], seconds: float) -> str:
    """Return / cost of runs after a time, and their steps by then; a dash if one of them ended."""
    parts = []
    for rows in tables:
        done = rows[_times(rows) <= seconds]
        steps = done.steps.max()
        if (
            len(done) in (0, len(rows))
            or done[done.steps > 0.9 * steps].episode_return.isna().all()
        ):
            return MISSING
        parts.append(_part_of(done, 0.9 * steps, steps) | {"steps": steps})
    mean = DataFrame(parts).mean()
    return f"{mean['return']:.1f} / {mean.cost:.0f} ({mean.steps / 1e6:.2f})"


def _spread_of_times(algorithms: Iterable[str]) -> float:
    """Largest factor between the times that seeds of one algorithm took, in any environment."""
    pairs = product(algorithms, ENVIRONMENTS)
    found = (finished_runs(ARCHIVE, algo, env).values() for algo, env in pairs)
    times = [[_times(rows).iloc[-1] for rows in tables] for tables in found if tables]
    return max((max(of_one) / min(of_one) for of_one in times), default=1.0)


def _times(rows: DataFrame) -> Series:
    """Seconds of training by the end of each epoch, without pauses."""
    epochs = rows.time_total.diff().fillna(rows.time_total)
    return epochs.mask(epochs >= PAUSE * epochs.median(), epochs.median()).cumsum()
