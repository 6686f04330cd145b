"""Pictures of final scores, slates and variations, and what all pictures share: styles, legends."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, cycle, product
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from safe_rl.files import replacing
from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.slates import SYMBOLS, Aggregate
from safe_rl.reporting.tables import Record, span
from safe_rl.scores.comparisons import Estimate, pareto_front, performance_profile
from safe_rl.scores.published import ALGORITHMS

__all__ = [
    *("LIMIT_STYLE", "WIDTH", "Style", "add_legend", "algorithm_styles", "compared"),
    *("draw_fronts", "draw_middles", "draw_profiles", "draw_variations", "literal", "save"),
    "set_grid",
]

# Okabe and Ito's palette, which people with colour-blindness can read.
_OWN_COLOURS = {
    **{"ppo": "#e69f00", "ppo_lagrangian": "#0072b2", "trpo": "#d55e00"},
    **{"trpo_lagrangian": "#009e73", "cpo": "#cc79a7"},
}
_FURTHER_COLOURS = ("#56b4e9", "#555555", "#8c564b", "#9467bd", "#bcbd22", "#17becf")
# Of finished and of unfinished runs; those after the first tell apart what shares a colour.
_LINES: tuple[tuple[Any, Any], ...] = (
    ("-", ":"), ("-.", (0, (1, 4))), ((0, (8, 2)), (0, (3, 3))),
    ((0, (8, 2, 1, 2, 1, 2)), (0, (1, 1, 1, 6))),
)  # fmt: skip
LIMIT_STYLE: dict[str, Any] = {"color": "#c00000", "linestyle": "--", "linewidth": 1.1}
"""How limits are drawn."""
WIDTH = 12.0
"""Of a figure, in inches."""
# of a line of the legend, in letters: as many as the width of a figure holds
_LONGEST_LABEL = 130

_MARKERS = "osD^vP"
_UNLIMITED = "x"
# of the thresholds of a profile
_NUM_POINTS = 101
# of a panel [inch]
_WIDTH, _HEIGHT = 2.2, 2.0
_MOST_COLUMNS = 5
_COLOURS = ("#0072b2", "#d55e00", "#cc79a7", "#009e73")
_OTHERS = "others"
_NONE = Estimate(math.nan, math.nan, math.nan)  # of a cost that a variation has not


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
    order = list(ALGORITHMS)
    styles: dict[str, Style] = {}
    for name, algorithm in sorted(
        names.items(), key=lambda pair: order.index(pair[1]) if pair[1] in order else len(order)
    ):
        own = Style(_OWN_COLOURS.get(algorithm, ""), *first)
        styles[name] = own if own.colour and own not in styles.values() else next(further)
    return styles


def literal(text: str) -> str:
    """A name as Matplotlib draws it letter by letter: no mathematics, and shown in legends."""
    return text.replace("$", r"\$").replace("_", "\N{ZERO WIDTH SPACE}_", text[:1] == "_")


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
        figure.savefig(unfinished, dpi=130)
    return path


def compared(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Experiments that can be held against each other, by what stands above their panel.

    At least two with a return and a cost on the same environment after equally many steps.
    """
    groups: dict[tuple[str, int, int], list[Record]] = {}
    for record in records:
        if math.isfinite(record["episode_return"] + record.get("episode_cost", math.nan)):
            key = (record["environment"], record["fewest_steps"], record["steps"])
            groups.setdefault(key, []).append(record)
    kept = {key: members for key, members in sorted(groups.items()) if len(members) > 1}
    return {f"{name}, {span(steps)} steps": own for (name, *steps), own in kept.items()}


def draw_fronts(records: Sequence[Record], styles: Mapping[str, Style]) -> Figure:
    """Draw final returns against final costs, a panel per environment and length of training.

    A point is an experiment, with the standard deviations over its seeds; its marker says its
    limit, which is a vertical line, too. A line in an algorithm's colour joins its experiments
    under several limits. The grey line joins those that no other one beats in both.

    Args:
        records: Final scores, see :func:`safe_rl.reporting.scoring.final_record`.
        styles: Name of an algorithm -> how it is drawn.
    """
    groups = compared(records)
    columns = min(3, len(groups))
    rows = -(-len(groups) // columns)
    figure = Figure(figsize=(WIDTH, 3.4 * rows + 0.3), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    # a family's is that of the first of its experiments
    looks = {r["family"]: styles[r["algorithm"]] for r in reversed(records)}
    markers = _markers(records)
    for axis, (title, own) in zip(panels, groups.items(), strict=False):
        _draw_front(axis, own, looks, markers)
        axis.set_title(literal(fill(title, 44)), fontsize=10, fontweight="bold")
        axis.set(xlabel="final episode cost", ylabel="final return")
        set_grid(axis)
    for axis in panels[len(groups) :]:
        axis.set_axis_off()
    add_legend(figure, panels)
    return figure


def _markers(records: Sequence[Record]) -> dict[float | None, str]:
    """Limit -> marker, the same in all panels."""
    limits = sorted({r["limit_cost"] for r in records if "limit_cost" in r})
    return {None: _UNLIMITED, **dict(zip(limits, cycle(_MARKERS), strict=False))}


def _draw_front(
    axis: Axes,
    records: Sequence[Record],
    looks: Mapping[str, Style],
    markers: Mapping[float | None, str],
) -> None:
    points = np.array([(r["episode_cost"], r["episode_return"]) for r in records])
    front = points[pareto_front(points[:, 1], points[:, 0])]
    axis.plot(*front.T, color="0.6", linewidth=1, zorder=1, drawstyle="steps-post")
    for family in dict.fromkeys(r["family"] for r in records):
        own = [r for r in records if r["family"] == family]
        own.sort(key=lambda r: r.get("limit_cost", np.inf))
        joined = np.array([(r["episode_cost"], r["episode_return"]) for r in own]).T
        colour, line, _ = looks[family]
        axis.plot(
            *joined, color=colour, linestyle=line, linewidth=1.5, alpha=0.7, label=literal(family)
        )
        for record, cost, value in zip(own, *joined, strict=True):
            axis.errorbar(
                cost, value, xerr=record["episode_cost_std"], yerr=record["episode_return_std"],
                color=colour, linestyle="", elinewidth=1, markersize=7,
                marker=markers[record.get("limit_cost")],
            )  # fmt: skip
    there = {r.get("limit_cost") for r in records}
    for limit, marker in markers.items():
        if limit in there:
            name = "no limit of cost" if limit is None else f"limit {limit:g}"
            axis.plot([], [], color="0.3", linestyle="", marker=marker, markersize=7, label=name)
        if limit in there and limit is not None:
            axis.axvline(limit, **LIMIT_STYLE)


def draw_middles(records: Sequence[Record], styles: Mapping[str, Style]) -> Figure:
    """Draw interquartile means (of `middle_table`) and their intervals, a panel per score."""
    figure = Figure(figsize=(WIDTH, 0.9 + 0.32 * len(records)), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    heights = range(len(records))
    names = [literal(record["algorithm"][:60]) for record in records]
    for axis, (name, symbol) in zip(panels, SYMBOLS.items(), strict=True):
        for height, record in zip(heights, records, strict=True):
            value, low, high = (record[f"{name}{end}"] for end in ("", "_low", "_high"))
            colour = styles[record["algorithm"]].colour
            axis.barh(height, high - low, left=low, height=0.55, color=colour, alpha=0.45)
            axis.plot([value] * 2, [height - 0.33, height + 0.33], color="black")
        axis.set_title(symbol)
        axis.set_yticks(list(heights), names)
        axis.tick_params(axis="y", length=0)
        axis.grid(alpha=0.25, axis="x")
        axis.spines[["top", "right", "left"]].set_visible(False)
        axis.xaxis.set_major_locator(MaxNLocator(5))
        left, right = axis.get_xlim()
        axis.set_xlim(min(0.0, left), max(0.0, right))
    panels[0].invert_yaxis()
    return figure


def draw_profiles(aggregates: Sequence[Aggregate], styles: Mapping[str, Style]) -> Figure:
    """Draw the share of runs above every value of a normalised score, a panel per score.

    Bands are 95 % intervals of a bootstrap that resamples every environment's seeds. At least of
    one algorithm every run must have finished an episode.
    """
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    # where a run has finished no episode there is no share of runs
    known = [one for one in aggregates if one.is_measured]
    for axis, (name, symbol) in zip(panels, SYMBOLS.items(), strict=True):
        values = np.concatenate([v for one in known for v in one.strata[name]])
        # from where all runs are above to where none is
        margin = 0.05 * float(np.ptp(values)) + 1e-3
        thresholds = np.linspace(values.min() - margin, values.max() + margin, _NUM_POINTS)
        for one in known:
            share, low, high = performance_profile(one.strata[name], thresholds)
            style = styles[one.algorithm]
            label = literal(one.algorithm)
            axis.plot(thresholds, share, color=style.colour, linestyle=style.line, label=label)
            axis.fill_between(thresholds, low, high, color=style.colour, alpha=0.2, linewidth=0)
        axis.set(xlabel=f"τ of {symbol}", ylim=(0, 1.02))
        set_grid(axis)
    panels[0].set_ylabel("share of runs above τ")
    add_legend(figure, panels[:1])
    return figure


def draw_variations(
    rows: Sequence[tuple[Any, Mapping[str, Estimate]]],
    cost_limits: Mapping[str, float],
    path: Path,
) -> None:
    """Draw return and costs with their intervals over the values of every row.

    The band across a panel is the environment as trained on; limits are dashed.

    Args:
        rows: A variation (`row`, `value`) and its estimates, the first as trained on.
        cost_limits: Cost key -> d; without any, ``cost`` is drawn.
        path: Picture to write, replaced in one go.

    Examples:
        >>> from collections import namedtuple
        >>> Changed = namedtuple("Changed", "row value")
        >>> found = {"episode_return": Estimate(3, 2, 4), "episode_cost": Estimate(20, 15, 30)}
        >>> rows = [(Changed("as trained", None), found), (Changed("mass", 0.5), found)]
        >>> picture = getfixture("tmp_path") / "variations.png"
        >>> draw_variations(rows, {"cost": 25.0}, picture)
        >>> picture.exists()
        True
    """
    (_, trained), *varied = rows
    groups = _rows_of(varied) or {_OTHERS: [("as trained", trained)]}
    names = ["episode_return", *(f"episode_{key}" for key in cost_limits or ["cost"])]
    columns = min(len(groups), _MOST_COLUMNS)
    bands = math.ceil(len(groups) / columns)
    lines = bands * len(names)
    figure = Figure(figsize=(0.8 + _WIDTH * columns, 0.5 + _HEIGHT * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False)
    for name, colour, line in zip(names, cycle(_COLOURS), range(len(names)), strict=False):
        limit = cost_limits.get(name.removeprefix("episode_"))
        drawn = []
        for number, (row, group) in enumerate(groups.items()):
            axis = panels[number // columns * len(names) + line][number % columns]
            _draw(
                axis,
                [(label, found.get(name, _NONE)) for label, found in group],
                trained[name],
                colour,
            )
            if limit is not None:
                axis.axhline(limit, **LIMIT_STYLE)
            if line == 0:
                axis.set_title(literal(row))
            if number % columns == 0:
                axis.set_ylabel(literal(name.removeprefix("episode_")))
            drawn.append(axis)
        low, high = zip(*(axis.get_ylim() for axis in drawn), strict=True)
        for axis in drawn:
            axis.set_ylim(min(low), max(high))
    for axis in panels.flat:
        axis.set_visible(axis.has_data())
    figure.supxlabel("grey: as trained; dashed: the limit", fontsize="small", color="0.3")
    save(figure, path)


def _rows_of(
    varied: Sequence[tuple[Any, Mapping[str, Estimate]]],
) -> dict[str, list[tuple[str, Mapping[str, Estimate]]]]:
    """Row -> label and estimates of its values; what has a single value is in a row of all such."""
    groups: dict[str, list[tuple[str, Mapping[str, Estimate]]]] = {}
    for variation, estimates in varied:
        single = variation.value is None
        label = variation.row if single else f"{variation.value}"
        groups.setdefault(_OTHERS if single else variation.row, []).append((label, estimates))
    return groups


def _draw(
    axis: Axes, values: Sequence[tuple[str, Estimate]], trained: Estimate, colour: str
) -> None:
    places = range(len(values))
    axis.axhspan(trained.low, trained.high, color="0.85", zorder=0)
    axis.axhline(trained.value, color="0.5", linewidth=1, zorder=1)
    for place, (_, estimate) in zip(places, values, strict=True):
        axis.plot([place] * 2, [estimate.low, estimate.high], color=colour, linewidth=2)
        axis.plot(place, estimate.value, marker="o", color=colour)
    long = any(len(label) > 5 for label, _ in values)
    axis.set_xticks(list(places), [literal(label) for label, _ in values], rotation=25 * long)
    axis.set_xlim(-0.6, len(values) - 0.4)
    axis.grid(alpha=0.25, axis="y")
    axis.spines[["top", "right"]].set_visible(False)
