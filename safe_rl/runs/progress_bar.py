"""The progress bar of a run."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from time import monotonic

from tqdm import tqdm

from safe_rl.runs.table import measured

LINE_SECONDS = "SAFE_RL_LINE_SECONDS"
"""Environment variable of runs that share a terminal: they print lines, this many seconds apart."""


class ProgressBar(tqdm):
    """A bar with steps, steps per second, return, and costs with their present limits.

    Args:
        directory: Folder of the run; if lines replace the bar, they begin with its name.
        total: Environment steps of the whole run.
        begun: Steps that a continued run has made before.
        limits: Cost key -> d, undiscounted cost per episode.
        measure: Which measure of episode costs is limited.
    """

    def __init__(
        self,
        directory: Path,
        total: int,
        begun: int,
        limits: Mapping[str, float],
        measure: str,
    ) -> None:
        self._limits, self._measure = limits, measure
        self._seconds, self._printed = float(os.environ.get(LINE_SECONDS, "inf")), monotonic()
        # a delayed bar draws nothing by itself
        lines = math.isfinite(self._seconds)
        options = {"delay": math.inf, "desc": os.path.relpath(directory)} if lines else {}
        super().__init__(
            total=total, initial=begun, unit=" steps", unit_scale=True, dynamic_ncols=True,
            smoothing=0.1, **options,
        )  # fmt: skip

    def add(self, row: Mapping[str, float]) -> None:
        """Show an epoch, given as its row of the table."""
        self.set_postfix(shown(row, self._limits, self._measure), refresh=False)
        self.update(int(row["steps"]) - self.n)
        if monotonic() - self._printed >= self._seconds:
            self._printed = monotonic()
            print(self, file=sys.stderr, flush=True)


def shown(row: Mapping[str, float], limits: Mapping[str, float], measure: str) -> dict[str, str]:
    """Figures of an epoch for the bar: return, costs with their present limits, multipliers.

    Return and costs are means over the episodes that ended in the epoch. While an algorithm lowers
    its limit, the word "target" precedes the present one.

    Examples:
        >>> row = {"episode_return": 1.25, "episode_cost": 30.0, "multiplier_cost": 0.5}
        >>> shown(row, {"cost": 25.0}, "mean")
        {'return': '1.25', 'cost': '30.0/25', 'λ': '0.5'}
        >>> row |= {"estimate_cost": 31.0, "target_cost": 29.0}
        >>> shown(row, {"cost": 25.0}, "mean")["cost"]
        '30.0/target 29'
    """
    if math.isnan(row["episode_return"]):
        return {"episodes": "none has ended"}
    figures = {"return": f"{row['episode_return']:.2f}"}
    for key in list(limits) or ["cost"]:
        limit, target = limits.get(key), row.get(f"target_{key}", -math.inf)
        figures[key] = f"{measured(row, key, limit, measure):.1f}"
        if limit is not None and target <= limit:
            figures[key] += f"/{limit:g}"
        elif limit is not None:
            has_no_limit = target > row.get(f"estimate_{key}", math.inf)
            figures[key] += " (no limit yet)" if has_no_limit else f"/target {target:.3g}"
    multipliers = [value for name, value in row.items() if name.startswith("multiplier_")]
    if multipliers:
        figures["λ"] = " ".join(f"{value:.3g}" for value in multipliers)
    return figures
