"""Pictures of experiments: the paper's Figures 7 to 9, and what all pictures share."""

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

from safe_rl.reporting.averages import average
from safe_rl.reporting.cleaning import clean
from safe_rl.reporting.experiments import Experiment, cost_keys_of
from safe_rl.runs.curves import point_marker
from safe_rl.runs.files import replacing
from safe_rl.scores.published import ALGORITHMS

__all__ = [
    *("LIMIT_STYLE", "ROW_HEIGHT", "WIDTH", "Style", "add_legend", "algorithm_styles"),
    *("draw_experiment", "draw_learning_curves", "drawn_keys", "limits_of", "literal", "save"),
    *("set_axes", "set_grid"),
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


def literal(text: str) -> str:
    """A name as Matplotlib draws it letter by letter: no mathematics, and shown in legends."""
    return text.replace("$", r"\$").replace("_", "\N{ZERO WIDTH SPACE}_", text[:1] == "_")


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
    order = list(ALGORITHMS)
    styles: dict[str, Style] = {}
    for name, algorithm in sorted(
        names.items(), key=lambda pair: order.index(pair[1]) if pair[1] in order else len(order)
    ):
        own = Style(_OWN_COLOURS.get(algorithm, ""), *first)
        styles[name] = own if own.colour and own not in styles.values() else next(further)
    return styles


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
        for key in drawn_keys([e for e in experiments if e.environment == environment])
    ]
    figure = Figure(figsize=(WIDTH, ROW_HEIGHT * len(rows) + 0.3), layout="constrained")
    panels = figure.subplots(len(rows), 3, squeeze=False)
    for (environment, key), axes in zip(rows, panels, strict=True):
        shown = [e for e in experiments if e.environment == environment]
        for experiment in shown:
            draw_experiment(experiment, key, axes, styles[experiment.algorithm])
        name = literal(fill(environment.replace(" (", "\n("), 24, replace_whitespace=False))
        axes[0].set_ylabel(
            name if key == "cost" else f"{name}\n{literal(clean(key, 40))}", fontweight="bold"
        )
        for axis, height in limits_of(shown, key, axes):
            axis.axhline(height, **LIMIT_STYLE)
        set_axes(axes)
    for axis, title in zip(panels[0], ("Return", "Episode cost", "Cost rate"), strict=True):
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
            steps, marker = curve.steps + offset, point_marker(curve.steps)
            axis.plot(
                steps, curve.mean, color=style.colour, linestyle=line, linewidth=width,
                label=label, marker=marker, markersize=5, clip_on=not marker,
            )  # fmt: skip
            if len(runs) > 1:
                axis.fill_between(
                    steps, curve.low, curve.high, color=style.colour, alpha=0.2, linewidth=0
                )


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


def set_grid(axis: Axes) -> None:
    """Faint lines behind a panel, and no frame above and to the right of it."""
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)


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


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG."""
    with replacing(path) as unfinished:
        figure.savefig(unfinished, dpi=_DPI)
    return path
