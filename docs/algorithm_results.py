"""What runs of the algorithms came to: tables for their pages from results/algorithms/."""

from __future__ import annotations

import csv
import gzip
import statistics
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES, RESULTS = ROOT / "docs" / "algorithms", ROOT / "results" / "algorithms"
LIMIT, FRAMES, QUARTER = 25.0, 1_000_000, 250_000


def _runs(algo: str, env: str = "PointGoal1") -> dict[int, list[dict[str, float]]]:
    """Rows of the recorded tables by seed, numbers only, of runs that came to their end."""
    found = {}
    for path in sorted((RESULTS / env / algo).glob("seed*/progress.csv.gz")):
        with gzip.open(path, "rt") as table:
            rows = [
                {key: float(value) for key, value in row.items() if value}
                for row in csv.DictReader(table)
            ]
        if rows[-1]["steps"] >= FRAMES:
            found[int(path.parent.name.removeprefix("seed"))] = rows
    return found


def _part_of(rows: list[dict[str, float]], start: int, end: int) -> dict[str, float]:
    """Means over the epochs of a part of a run in which episodes ended."""
    part = [row for row in rows if start < row["steps"] <= end and "episode_return" in row]
    return {
        "return": statistics.fmean(row["episode_return"] for row in part),
        "cost": statistics.fmean(row["episode_cost"] for row in part),
        "above": statistics.fmean(row["episode_cost"] > LIMIT for row in part),
        "rate": rows[-1]["cost_rate"],
    }


def _command(algo: str, seeds: str, env: str = "PointGoal1") -> str:
    return f"`python train.py -m env={env} algo={algo} seed={seeds} frames=1_000_000`"


def measured(algo: str) -> str:
    """What an algorithm's page says of its runs."""
    runs = _runs(algo)
    if not runs:
        return f"Not yet: {_command(algo, '300,301,302')} is what the comparison is made of."
    rows = [
        "| seed | first | second | third | last | epochs of the last above the limit | $\\rho_c$ |",
        "|---|---|---|---|---|---|---|",
    ]
    for seed, table in runs.items():
        quarters = [_part_of(table, start, start + QUARTER) for start in range(0, FRAMES, QUARTER)]
        cells = [f"{part['return']:.1f} / {part['cost']:.0f}" for part in quarters]
        last = quarters[-1]
        rows.append(f"| {seed} | {' | '.join(cells)} | {last['above']:.0%} | {last['rate']:.3f} |")
    table = "\n".join(rows)
    command = _command(algo, ",".join(map(str, runs)))
    picture = f"\n\n![Learning curves]({algo}.png)" if (PAGES / f"{algo}.png").exists() else ""
    return f"""PointGoal1, limit 25, `preset=default`, return / episode cost by quarters of the run:

{table}

{command}; [all algorithms](comparison.md).{picture}"""


def comparison(algorithms: Iterable[str]) -> str:
    """The page that compares all algorithms, a row each."""
    rows = [
        "| `algo=` | seeds | return | episode cost | epochs above 25 | $\\rho_c$ |",
        "|---|---|---|---|---|---|",
    ]
    for algo in algorithms:
        parts = [_part_of(table, FRAMES - QUARTER, FRAMES) for table in _runs(algo).values()]
        if not parts:
            rows.append(f"| [`{algo}`]({algo}.md) | 0 | not yet | | | |")
            continue
        cells = [
            _spread([part["return"] for part in parts], 1),
            _spread([part["cost"] for part in parts], 1),
            f"{statistics.fmean(part['above'] for part in parts):.0%}",
            f"{statistics.fmean(part['rate'] for part in parts):.3f}",
        ]
        rows.append(f"| [`{algo}`]({algo}.md) | {len(parts)} | {' | '.join(cells)} |")
    table = "\n".join(rows)
    return f"""# The on-policy algorithms compared

PointGoal1, limit 25, one million steps, `preset=default`: means over the last quarter million
steps, ± the standard deviation among seeds where there are several. A single seed is a direction,
not a verdict. $\\rho_c$ is the cost per step of the whole run.

{table}

Commands: {_command("…", "300,301,302")}. Tables of all epochs and the commits are in
[`results/algorithms/`](../../results/README.md).
"""


def _spread(values: list[float], digits: int) -> str:
    deviation = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.fmean(values):.{digits}f}{deviation}"
