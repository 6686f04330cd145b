"""Output on the terminal: a progress bar during training, and a line at the end.

`limits` are d, the undiscounted cost allowed per episode, by cost key. `episode_length` is the
largest number of steps of an episode. `measure` names the limited measure of episode costs.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic

from tqdm import tqdm

from safe_rl.runs.outcome import final_figures, final_rows, measured

LINE_SECONDS = "SAFE_RL_LINE_SECONDS"
"""Environment variable of runs that share a terminal: they print lines, this many seconds apart."""


class ProgressBar:
    """A bar with steps, steps per second, return, and costs with their present limits.

    Args:
        directory: Folder of the run; if lines replace the bar, they begin with its name.
        total: Environment steps of the whole run.
        begun: Steps that a continued run has made before.
    """

    def __init__(
        self,
        directory: Path,
        total: int,
        begun: int,
        limits: Mapping[str, float],
        measure: str = "mean",
    ) -> None:
        self._name = os.path.relpath(directory)
        self._seconds = float(os.environ.get(LINE_SECONDS, "inf"))
        self._printed = monotonic()
        options = {"disable": True} if math.isfinite(self._seconds) else {}
        self._bar = tqdm(
            total=total, initial=begun, unit=" steps", unit_scale=True, dynamic_ncols=True,
            smoothing=0.1, **options,
        )  # fmt: skip
        self._limits, self._measure = limits, measure

    def add(self, row: Mapping[str, float]) -> None:
        """Show an epoch, given as its row of the table."""
        figures = shown(row, self._limits, self._measure)
        self._bar.set_postfix(figures, refresh=False)
        self._bar.update(int(row["steps"]) - self._bar.n)
        if monotonic() - self._printed >= self._seconds:
            self._printed = monotonic()
            words = [f"{row['steps'] / self._bar.total:.0%} of {self._bar.total:,} steps"]
            words += [f"{row['steps_per_second']:,.0f} steps/s"]
            words += [f"{name}={value}" for name, value in figures.items()]
            print(f"{self._name}: {', '.join(words)}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Close the bar; its last state stays on the terminal."""
        self._bar.close()


def shown(
    row: Mapping[str, float], limits: Mapping[str, float], measure: str = "mean"
) -> dict[str, str]:
    """Figures of an epoch for the bar: return, costs with their present limits, multipliers.

    Return and costs are means over the episodes that ended in the epoch. While an algorithm lowers
    its limit, the word "target" precedes the present one.

    Examples:
        >>> row = {"episode_return": 1.25, "episode_cost": 30.0, "multiplier_cost": 0.5}
        >>> shown(row, {"cost": 25.0})
        {'return': '1.25', 'cost': '30.0/25', 'λ': '0.5'}
        >>> shown(row | {"estimate_cost": 31.0, "target_cost": 29.0}, {"cost": 25.0})["cost"]
        '30.0/target 29'
    """
    if math.isnan(row["episode_return"]):
        return {"episodes": "none has ended"}
    figures = {"return": f"{row['episode_return']:.2f}"}
    for key in list(limits) or ["cost"]:
        value = measured(row, key, limits.get(key), measure)
        figures[key] = f"{value:.1f}{_present_limit(row, key, limits)}"
    multipliers = [value for name, value in row.items() if name.startswith("multiplier_")]
    if multipliers:
        figures["λ"] = " ".join(f"{value:.3g}" for value in multipliers)
    return figures


def _present_limit(row: Mapping[str, float], key: str, limits: Mapping[str, float]) -> str:
    """The present limit of a cost, to follow its figure."""
    if key not in limits:
        return ""
    target, limit = row.get(f"target_{key}", -math.inf), limits[key]
    if target <= limit:
        return f"/{limit:g}"
    if target > row.get(f"estimate_{key}", math.inf):
        return " (no limit yet)"
    return f"/target {target:.3g}"


def outcome_line(
    table: Mapping[str, Sequence[float]],
    limits: Mapping[str, float],
    episode_length: int,
    measure: str = "mean",
) -> str:
    """One line about the end of a run: return and costs over its last epochs.

    Examples:
        >>> table = {"steps": [1000, 2000], "time_total": [2.0, 4.0], "cost_rate": [0.03, 0.03]}
        >>> table |= {"episode_return": [1.0, 2.0], "episode_cost": [30.0, 20.0]}
        >>> outcome_line(table, {"cost": 25.0}, 1000)
        'Return 1.50, cost 25.0 (limit 25) per episode, mean of steps 1 to 2,000; 500 steps/s'
        >>> outcome_line(table | {"episode_return": [math.nan] * 2}, {"cost": 25.0}, 1000)
        'No episode of 1,000 steps has ended; 500 steps/s'
    """
    keys = list(limits) or ["cost"]
    final, rows = final_figures(table, keys), final_rows(table)
    speed = f"{final['steps_per_second']:,.0f} steps/s"
    if not rows:
        return f"No episode of {episode_length:,} steps has ended; {speed}"
    what = f"Return {final['episode_return']:.2f}"
    for key in keys:
        limit = f" (limit {limits[key]:g})" if key in limits else ""
        what += f", {key} {_final_cost(final, key, limits.get(key), measure)}{limit}"
    begin = 0 if rows[0] == 0 else table["steps"][rows[0] - 1]
    span = f"steps {begin + 1:,.0f} to {table['steps'][rows[-1]]:,.0f}"
    return f"{what} per episode, mean of {span}; {speed}"


def _final_cost(final: Mapping[str, float], key: str, limit: float | None, measure: str) -> str:
    mean, limited = final[f"episode_{key}"], measured(final, key, limit, measure)
    differs = abs(limited - mean) > 0.05
    return f"{mean:.1f}" + (f", limited measure {limited:.1f}" if differs else "")
