"""The learning curves of a run: return, episode cost, cost rate, and multipliers if any."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import EngFormatter
from matplotlib.transforms import ScaledTranslation
from numpy.typing import ArrayLike

from safe_rl.files import replacing
from safe_rl.runs.table import final_width

_TO_LEGEND = -0.45  # from a panel to its legend, past ticks and the label [inch]


class NotebookFigure(Figure):
    """A figure that notebooks show, also if pyplot was never imported."""

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png")
        return picture.getvalue()


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, SVG or PDF by the suffix; return the path."""
    # a viewer that watches the file never shows an incomplete picture; publishers refuse fonts of
    # type 3, Matplotlib's default
    with replacing(path) as unfinished, rc_context({"pdf.fonttype": 42}):
        figure.savefig(unfinished, dpi=120)
    return path


def learning_curves(
    table: Mapping[str, Sequence[float]],
    cost_limits: Mapping[str, float],
    episode_length: int,
    title: str,
    measure: str,
) -> Figure:
    """Draw return, episode cost and cost rate over environment steps (Ray et al. 2019, Figure 7).

    Limits d are dashed in the second panel, d / T_ep in the third. There is a line for every cost
    with a limit, or for the aggregate cost without limits. Single epochs have faint lines, moving
    means strong ones. If the table has multipliers, a fourth panel shows them.

    Args:
        table: Columns of a run's table.
        cost_limits: Cost key -> d, undiscounted cost per episode.
        episode_length: T_ep, steps of a full episode.
        title: Text above the panels.
        measure: Which measure of episode costs is limited; another one than the mean has a line.
    """
    multipliers = {key: f"multiplier_{key}" for key in cost_limits if f"multiplier_{key}" in table}
    layout = ConstrainedLayoutEngine(h_pad=0.1)  # inch; the layout is a pixel or two inexact
    figure = NotebookFigure(figsize=(16 if multipliers else 12, 3.7), layout=layout)
    returns, costs, rates, *more = figure.subplots(1, 4 if multipliers else 3, sharex=True)
    steps = np.asarray(table["steps"], dtype=float)
    _draw(returns, steps, table["episode_return"], "C0", "return")
    for index, key in enumerate(cost_limits or ["cost"]):
        colour = f"C{index + 1}"
        _draw(costs, steps, table[f"episode_{key}"], colour, key)
        _plot(rates, steps, table[f"{key}_rate"], colour, key)
        if key in cost_limits and measure != "mean" and f"violation_{key}" in table:
            judged = np.asarray(table[f"violation_{key}"], dtype=float) + cost_limits[key]
            _draw(costs, steps, judged, f"C{len(cost_limits) + index + 1}", f"{key} as limited")
        if key in cost_limits:
            limit, per_step = cost_limits[key], cost_limits[key] / episode_length
            dashed: dict[str, Any] = {"color": colour, "linestyle": "--", "linewidth": 1}
            costs.axhline(limit, label=f"limit {limit:g}", **dashed)
            rates.axhline(per_step, label=f"limit / steps = {per_step:g}", **dashed)
        if key in multipliers:
            _plot(more[0], steps, table[multipliers[key]], colour, f"λ of {key}")
    names = ("Return", "Episode cost", "Cost rate", "Multiplier")
    for axes, name in zip((returns, costs, rates, *more), names, strict=False):
        _label(figure, axes, name, from_zero=axes is not returns)
    # legends stand below the panels, where they cover nothing
    lines = max(len(axes.get_legend_handles_labels()[0]) for axes in figure.axes)
    figure.set_figheight(figure.get_figheight() + 0.2 * lines)
    figure.suptitle(title)
    return figure


def _label(figure: Figure, axes: Axes, name: str, *, from_zero: bool) -> None:
    axes.set_title(name)
    axes.set_xlabel("Environment steps")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)
    if from_zero:
        axes.set_ylim(bottom=-0.02 * axes.get_ylim()[1])  # so that a line at zero is visible
    # stacked: side by side, names of costs would reach into the next panel
    below = ScaledTranslation(0, _TO_LEGEND, figure.dpi_scale_trans)
    axes.legend(
        fontsize="small", frameon=False, loc="upper center",
        bbox_to_anchor=(0.5, 0.0), bbox_transform=axes.transAxes + below,
    )  # fmt: skip


def _draw(
    axes: Axes, steps: np.ndarray, values: Sequence[float] | np.ndarray, colour: str, label: str
) -> None:
    """Draw the values of epochs in which an episode finished, and their moving mean."""
    known = np.isfinite(values)
    if not known.any():
        axes.text(0.5, 0.5, "no episode has ended", transform=axes.transAxes, ha="center")
    steps, heights = steps[known], np.asarray(values, dtype=float)[known]
    width = final_width(steps)  # so that curves end at the final figures
    axes.plot(steps, heights, color=colour, alpha=0.3, linewidth=1, label=f"{label}, of an epoch")
    _plot(axes, steps, moving_mean(heights, width), colour, f"{label}, mean of {width} epochs")


def _plot(axes: Axes, steps: np.ndarray, values: ArrayLike, colour: str, label: str) -> None:
    # without a marker a single point is invisible
    axes.plot(steps, values, color=colour, label=label, marker="o" if len(steps) == 1 else "")


def moving_mean(values: np.ndarray, width: int) -> np.ndarray:
    """Mean of each value, shape [n], and the up to ``width - 1`` before it.

    Examples:
        >>> moving_mean(np.array([1.0, 3.0, 5.0, 7.0, 9.0, 11.0]), 5).tolist()
        [1.0, 2.0, 3.0, 4.0, 5.0, 7.0]
    """
    if not len(values):
        return values
    # not by differences of running sums, which would lose precision after one huge value
    sums = np.convolve(values, np.ones(width))[: len(values)]
    return sums / np.minimum(np.arange(1, len(values) + 1), width)
