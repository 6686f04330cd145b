"""Figures 7 to 9 of the paper, one per robot, and interquartile means with their intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, cycle, product
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from safe_rl.reporting.curves import mean_curve
from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.results import cost_keys_of
from safe_rl.reporting.slate_tables import SYMBOLS
from safe_rl.reporting.slates import Aggregate
from safe_rl.runs.curves import point_marker
from safe_rl.scores.published import ALGORITHMS

__all__ = [
    "LIMIT_STYLE",
    "ROW_HEIGHT",
    "WIDTH",
    "Style",
    "add_legend",
    "algorithm_styles",
    "draw_aggregates",
    "draw_experiment",
    "draw_learning_curves",
    "drawn_keys",
    "save",
    "set_axes",
]

# Okabe and Ito's palette, which people with colour-blindness can read.
_OWN_COLOURS = {
    "ppo": "#e69f00",
    "ppo_lagrangian": "#0072b2",
    "trpo": "#d55e00",
    "trpo_lagrangian": "#009e73",
    "cpo": "#cc79a7",
}
_FURTHER_COLOURS = ("#56b4e9", "#555555", "#8c564b", "#9467bd", "#bcbd22", "#17becf")
# Of finished and of unfinished runs; those after the first tell apart what shares a colour.
_LINES: tuple[tuple[Any, Any], ...] = (
    ("-", ":"), ("-.", (0, (1, 4))), ((0, (8, 2)), (0, (3, 3))),
    ((0, (8, 2, 1, 2, 1, 2)), (0, (1, 1, 1, 6))),
)  # fmt: skip
_DPI = 130
LIMIT_STYLE: dict[str, Any] = {"color": "#c00000", "linestyle": "--", "linewidth": 1.1}
"""How limits are drawn."""
ROW_HEIGHT, WIDTH = 2.5, 12.0
"""Of a row of panels, and of a figure, in inches."""
# of a line of the legend, in letters: as many as the width of a figure holds
_LONGEST_LABEL = 130


class Style(NamedTuple):
    """How an algorithm is drawn: its colour, and its lines of finished and unfinished runs."""

    colour: str
    line: Any
    unfinished: Any


def algorithm_styles(experiments: Iterable[Experiment]) -> dict[str, Style]:
    """Name of an algorithm -> its style, the same in every figure and no other algorithm's."""
    names = {e.algorithm: e.runs[0].algorithm for e in experiments}
    first, *others = _LINES
    everything = (*_OWN_COLOURS.values(), *_FURTHER_COLOURS)
    further = cycle(
        Style(colour, *lines)
        for colours, several in ((_FURTHER_COLOURS, [first]), (everything, others))
        for lines, colour in product(several, colours)
    )
    styles: dict[str, Style] = {}
    for name, algorithm in sorted(names.items(), key=lambda pair: _rank(pair[1])):
        own = Style(_OWN_COLOURS.get(algorithm, ""), *first)
        styles[name] = own if own.colour and own not in styles.values() else next(further)
    return styles


def _rank(algorithm: str) -> int:
    return list(ALGORITHMS).index(algorithm) if algorithm in ALGORITHMS else len(ALGORITHMS)


def draw_learning_curves(experiments: Sequence[Experiment], styles: Mapping[str, Style]) -> Figure:
    """Draw return, episode cost and cost rate over steps, a row per environment.

    Lines are means over seeds and bands their 95 % intervals; return and episode cost are means of
    an epoch and the four before it. Limits d are dashed, and so is d / T_ep beside the cost rate.
    Runs that have not come to their end are drawn one by one, thin.

    Args:
        experiments: Any environments and algorithms.
        styles: Name of an algorithm -> how it is drawn.
    """
    rows = [
        (environment, key)
        for environment in dict.fromkeys(e.environment for e in experiments)
        for key in drawn_keys([e for e in experiments if e.environment == environment])
    ]
    figure = Figure(figsize=(WIDTH, ROW_HEIGHT * len(rows) + 0.3), layout="constrained")
    panels = figure.subplots(len(rows), 3, squeeze=False)
    for (environment, key), axes in zip(rows, panels, strict=True):
        shown = [e for e in experiments if e.environment == environment]
        for experiment in shown:
            draw_experiment(experiment, key, axes, styles[experiment.algorithm])
        name = environment.replace(" (", "\n(")
        _decorate(axes, name if key == "cost" else f"{name}\n{key}", shown, key)
    for axis, title in zip(panels[0], ("Return", "Episode cost", "Cost rate"), strict=True):
        axis.set_title(title, fontweight="bold")
    for axis in panels[-1]:
        axis.set_xlabel("environment steps")
    add_legend(figure, panels[:, 0])
    return figure


def drawn_keys(experiments: Sequence[Experiment]) -> list[str]:
    """Cost keys with a limit, or the aggregate cost where none has one."""
    limited = {key for experiment in experiments for key in experiment.limits}
    return [key for key in cost_keys_of(experiments) if key in limited] or ["cost"]


def draw_experiment(
    experiment: Experiment, key: str, axes: Sequence[Axes], style: Style, offset: int = 0
) -> None:
    """Draw return, episode cost and cost rate of an experiment.

    Args:
        experiment: The finished runs become a mean and its interval, others a line each.
        key: Cost key.
        axes: A panel for each of the three.
        style: Of everything.
        offset: Environment steps to its beginning.
    """
    columns = (("episode_return", True), (f"episode_{key}", True), (f"{key}_rate", False))
    unfinished = [run for run in experiment.runs if not run.is_finished]
    for axis, (column, smooth) in zip(axes, columns, strict=True):
        curve = (
            mean_curve(experiment.finished, column, smooth=smooth) if experiment.finished else None
        )
        if curve is not None:
            steps = curve.steps + offset
            _plot(axis, steps, curve.mean, style.colour, style.line, experiment.algorithm)
            axis.fill_between(
                steps, curve.low, curve.high, color=style.colour, alpha=0.2, linewidth=0
            )
        for run in unfinished:
            line = mean_curve([run], column, smooth=smooth)
            if line is not None:
                label = f"{experiment.algorithm} (unfinished)"
                steps = line.steps + offset
                _plot(axis, steps, line.mean, style.colour, style.unfinished, label, width=1.2)


def _plot(
    axis: Axes, steps: Any, heights: Any, colour: str, line: Any, label: str, width: float = 1.5
) -> None:
    axis.plot(
        steps, heights, color=colour, linestyle=line, linewidth=width, label=label,
        marker=point_marker(steps), markersize=5, clip_on=not point_marker(steps),
    )  # fmt: skip


def _decorate(axes: Sequence[Axes], name: str, experiments: Sequence[Experiment], key: str) -> None:
    returns, costs, rates = axes
    returns.set_ylabel(name, fontweight="bold")
    for limit, length in {
        (e.limits[key], e.runs[0].episode_length) for e in experiments if key in e.limits
    }:
        costs.axhline(limit, **LIMIT_STYLE)
        rates.axhline(limit / length, **LIMIT_STYLE)
    set_axes(axes)


def set_axes(axes: Sequence[Axes]) -> None:
    """Scales, ticks and grid of a row of panels: return, episode cost and cost rate."""
    for axis in axes:
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.xaxis.set_major_locator(MaxNLocator(6))
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_xlim(left=0)
    for axis in axes[1:]:
        # with zero among the data, the margin above them is a share of their height
        axis.update_datalim([(0.0, 0.0)], updatex=False)
        axis.autoscale_view(scalex=False)
        axis.set_ylim(bottom=0)


def add_legend(figure: Figure, axes: Iterable[Axes]) -> None:
    """One legend for all panels, below the figure, which grows by its height.

    It has as many columns as the figure is wide enough for; labels wider than the figure are
    broken into lines.
    """
    pairs = chain.from_iterable(
        zip(*axis.get_legend_handles_labels(), strict=True) for axis in axes
    )
    handles = {label: handle for handle, label in pairs}
    if not handles:
        return
    labels = [fill(label, _LONGEST_LABEL, break_on_hyphens=False) for label in handles]
    for columns in range(min(5, len(handles)), 0, -1):
        legend = figure.legend(
            handles.values(), labels, loc="outside lower center", ncols=columns,
            frameon=False, handlelength=3.0,
        )  # fmt: skip
        size = legend.get_window_extent(FigureCanvasAgg(figure).get_renderer())
        if size.width < 0.97 * figure.bbox.width or columns == 1:
            break
        legend.remove()
    figure.set_figheight(figure.get_figheight() + size.height / figure.dpi)


def draw_aggregates(aggregates: Sequence[Aggregate], styles: Mapping[str, Style]) -> Figure:
    """Draw interquartile means and their intervals, a panel per normalised score."""
    figure = Figure(figsize=(WIDTH, 0.9 + 0.32 * len(aggregates)), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    heights = range(len(aggregates))
    for axis, (name, symbol) in zip(panels, SYMBOLS.items(), strict=True):
        for height, aggregate in zip(heights, aggregates, strict=True):
            estimate, colour = aggregate.middle[name], styles[aggregate.algorithm].colour
            axis.barh(
                height, estimate.high - estimate.low, left=estimate.low, height=0.55, color=colour,
                alpha=0.45,
            )  # fmt: skip
            axis.plot([estimate.value] * 2, [height - 0.33, height + 0.33], color="black")
        axis.set_title(symbol)
        axis.set_yticks(list(heights), [aggregate.algorithm for aggregate in aggregates])
        axis.tick_params(axis="y", length=0)
        axis.grid(alpha=0.25, axis="x")
        axis.spines[["top", "right", "left"]].set_visible(False)
        axis.xaxis.set_major_locator(MaxNLocator(5))
        left, right = axis.get_xlim()
        axis.set_xlim(min(0.0, left), max(0.0, right))
    panels[0].invert_yaxis()
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG."""
    figure.savefig(path, dpi=_DPI)
    return path
