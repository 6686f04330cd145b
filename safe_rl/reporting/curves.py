"""Learning curves (the paper's Figures 7 to 9)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from safe_rl.reporting.experiments import Experiment, cost_keys_of
from safe_rl.reporting.figures import (
    LIMIT_STYLE,
    WIDTH,
    Style,
    add_legend,
    literal,
    set_grid,
)
from safe_rl.reporting.recorded import Run
from safe_rl.reporting.tables import clean
from safe_rl.runs.curves import moving_mean, point_marker
from safe_rl.runs.outcome import final_width
from safe_rl.scores.comparisons import bootstrap

__all__ = [
    *("Average", "average", "draw_experiment", "draw_learning_curves", "limits_of", "set_axes"),
]

_NUM_POINTS = 200  # of a curve at most; a panel is not much wider in pixels
_ROW_HEIGHT = 2.5  # of a row of panels [inch]
_TITLES = ("Return", "Episode cost", "Cost rate")


class Average(NamedTuple):
    """A quantity over training: its mean over seeds and the ends of its 95 % interval.

    All have shape [points]; the interval is NaN with a single seed.
    """

    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def average(runs: Sequence[Run], column: str, *, smooth: bool) -> Average | None:
    """Average a column of the runs' tables over seeds; None if one has no value, or there is none.

    The curve ends where the first of the runs does. Between epochs, and over those in which no
    episode finished, values are interpolated.

    Args:
        runs: One per seed.
        column: Column of their tables.
        smooth: Whether to take :func:`safe_rl.runs.curves.moving_mean` first, which ends at the
            run's final figure.
    """
    series = []
    for run in runs:
        steps = np.array(run.table["steps"])
        values = np.array(run.table.get(column, np.full(steps.shape, np.nan)))
        known = np.isfinite(values)
        steps, values = steps[known], values[known]
        if not len(steps):
            return None
        series.append((steps, moving_mean(values, final_width(steps)) if smooth else values))
    if not series:
        return None
    start, stop = max(steps[0] for steps, _ in series), min(steps[-1] for steps, _ in series)
    longest = max(len(steps) for steps, _ in series)
    grid = np.linspace(start, stop, min(longest, _NUM_POINTS)) if stop > start else np.array([stop])
    heights = np.stack([np.interp(grid, steps, values) for steps, values in series], -1)
    return Average(grid, heights.mean(-1), *bootstrap([heights], np.mean))


def draw_learning_curves(experiments: Sequence[Experiment], styles: Mapping[str, Style]) -> Figure:
    """Draw return, episode cost and cost rate over steps, a row per environment.

    Lines are means over seeds and bands their 95 % intervals; return and episode cost are means of
    an epoch and those before it, as many as final figures have. Limits d are dashed, and so is
    d / T_ep beside the cost rate. Runs that have not come to their end are drawn one by one, thin.

    Args:
        experiments: Any environments and algorithms.
        styles: Name of an algorithm -> how it is drawn.
    """
    rows = [
        (environment, key)
        for environment in dict.fromkeys(e.environment for e in experiments)
        for key in _drawn_keys([e for e in experiments if e.environment == environment])
    ]
    figure = Figure(figsize=(WIDTH, _ROW_HEIGHT * len(rows) + 0.3), layout="constrained")
    panels = figure.subplots(len(rows), 3, squeeze=False)
    for (environment, key), axes in zip(rows, panels, strict=True):
        shown = [e for e in experiments if e.environment == environment]
        for experiment in shown:
            draw_experiment(experiment, key, axes, styles[experiment.algorithm])
        name = literal(fill(environment.replace(" (", "\n("), 24, replace_whitespace=False))
        label = name if key == "cost" else f"{name}\n{literal(clean(key, 40))}"
        axes[0].set_ylabel(label, fontweight="bold")
        for axis, height in limits_of(shown, key, axes):
            axis.axhline(height, **LIMIT_STYLE)
        set_axes(axes)
    for axis, title in zip(panels[0], _TITLES, strict=True):
        axis.set_title(title, fontweight="bold")
    for axis in panels[-1]:
        axis.set_xlabel("environment steps")
    add_legend(figure, panels[:, 0])
    return figure


def limits_of(
    experiments: Iterable[Experiment], key: str, axes: Sequence[Axes]
) -> list[tuple[Axes, float]]:
    """Panels of episode cost and cost rate, and the heights of limits in them: d and d / T_ep."""
    limited = [e for e in experiments if key in e.limits]
    pairs = {(e.limits[key], e.runs[0].episode_length) for e in limited}
    return [
        *((axes[1], limit) for limit, _ in pairs),
        *((axes[2], limit / length) for limit, length in pairs if length is not None),
    ]


def _drawn_keys(experiments: Sequence[Experiment]) -> list[str]:
    """Cost keys with a limit, or the aggregate cost where none has one."""
    limited = {key for experiment in experiments for key in experiment.limits}
    return [key for key in cost_keys_of(experiments) if key in limited] or ["cost"]


def draw_experiment(experiment: Experiment, key: str, axes: Sequence[Axes], style: Style) -> None:
    """Draw return, episode cost and cost rate of an experiment.

    Args:
        experiment: The finished runs become a mean and its interval, others a line each.
        key: Cost key.
        axes: A panel for each of the three.
        style: Of everything.
    """
    name = literal(experiment.algorithm)
    unfinished = [[run] for run in experiment.runs if not run.is_finished]
    looks: list[tuple[Any, ...]] = [(experiment.finished, name, style.line, 1.5)]
    looks += [(runs, f"{name} (unfinished)", style.unfinished, 1.2) for runs in unfinished]
    columns = (("episode_return", True), (f"episode_{key}", True), (f"{key}_rate", False))
    for axis, (column, smooth) in zip(axes, columns, strict=True):
        for runs, label, line, width in looks:
            curve = average(runs, column, smooth=smooth)
            if curve is None:
                continue
            steps, marker = curve.steps, point_marker(curve.steps)
            axis.plot(
                steps, curve.mean, color=style.colour, linestyle=line, linewidth=width,
                label=label, marker=marker, markersize=5, clip_on=not marker,
            )  # fmt: skip
            if len(runs) > 1:
                look: dict[str, Any] = {"color": style.colour, "alpha": 0.2, "linewidth": 0}
                axis.fill_between(steps, curve.low, curve.high, **look)


def set_axes(axes: Sequence[Axes]) -> None:
    """Scales, ticks and grid of a row of panels: return, episode cost and cost rate."""
    for axis in axes:
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.xaxis.set_major_locator(MaxNLocator(6))
        set_grid(axis)
        axis.set_xlim(left=0)
    for axis in axes[1:]:
        # with zero among the data, the margin above them is a share of their height
        axis.update_datalim([(0.0, 0.0)], updatex=False)
        axis.autoscale_view(scalex=False)
        axis.set_ylim(bottom=0)
