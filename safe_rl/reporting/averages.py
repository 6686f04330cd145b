"""Several seeds as one curve: mean and interval over environment steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safe_rl.reporting.recorded import Run
from safe_rl.runs.curves import moving_mean
from safe_rl.runs.outcome import final_width
from safe_rl.scores.intervals import bootstrap

__all__ = ["Average", "average"]

NUM_POINTS = 200
"""Of a curve at most; a panel is not much wider in pixels."""


class Average(NamedTuple):
    """A quantity over training.

    Attributes:
        steps: Environment steps, shape [points].
        mean: Mean over seeds, shape [points].
        low: Lower end of its 95 % interval, shape [points]; NaN with a single seed.
        high: Upper end.
    """

    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def average(runs: Sequence[Run], column: str, *, smooth: bool) -> Average | None:
    """Average a column of the runs' tables over seeds.

    The curve ends where the first of the runs does. Between epochs, and over those in which no
    episode finished, values are interpolated.

    Args:
        runs: One per seed.
        column: Column of their tables.
        smooth: Whether to take :func:`safe_rl.runs.curves.moving_mean` first, which ends at the
            run's final figure.

    Returns:
        The curve, or None if there is no run, or one has no value.
    """
    series = [_series(run, column) for run in runs]
    if not series or not all(len(steps) for steps, _ in series):
        return None
    start = max(steps[0] for steps, _ in series)
    stop = min(steps[-1] for steps, _ in series)
    longest = max(len(steps) for steps, _ in series)
    grid = np.linspace(start, stop, min(longest, NUM_POINTS)) if stop > start else np.array([stop])
    heights = [moving_mean(y, final_width(steps)) if smooth else y for steps, y in series]
    values = np.stack(
        [np.interp(grid, steps, y) for (steps, _), y in zip(series, heights, strict=True)], -1
    )
    return Average(grid, values.mean(-1), *bootstrap([values], np.mean))


def _series(run: Run, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values where there is a value."""
    steps = np.array(run.table["steps"])
    values = np.array(run.table.get(column, np.full(steps.shape, np.nan)))
    known = np.isfinite(values)
    return steps[known], values[known]
