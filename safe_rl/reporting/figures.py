"""Pictures of final scores; styles and legends of all pictures."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from safe_rl.reporting.experiments import PACKAGED, Experiment
from safe_rl.reporting.tables import Record, short_number
from safe_rl.scores.benchmark import ALGORITHMS
from safe_rl.scores.comparisons import pareto_front

# colours and markers of the package's algorithms; those of the paper come first, in colours of
# Okabe and Ito that colour-blind readers can distinguish
_LOOKS = (
    *(("#e69f00", "o"), ("#0072b2", "o"), ("#d55e00", "s"), ("#009e73", "s"), ("#cc79a7", "D")),
    *(("#999933", "p"), ("#17becf", "<"), ("#6699cc", "d"), ("#7f7f7f", ">"), ("#bcbd22", "v")),
    *(("#9467bd", "^"), ("#44aa99", "X"), ("#aa4499", "P"), ("#8c564b", "d"), ("#56b4e9", "v")),
    *(("#b07c00", "*"), ("#117733", "p"), ("#e31a1c", "h"), ("#332288", "H"), ("#cc6677", "8")),
    # of other algorithms, far from all of these
    *(("#0000ff", "^"), ("#ff00ff", "D"), ("#00cc00", "v"), ("#000000", "X")),
    *(("#ff0099", "<"), ("#0066ff", "P")),
)
LIMIT_STYLE: dict[str, Any] = {"color": "#c00000", "linestyle": "--", "linewidth": 1.0}
"""Style of the lines at limits."""
WIDTH = 12.0
"""Width of a figure [inch]."""
_LEGEND, _LONGEST_LABEL = 140, 60  # widths of a legend and of a line in it [letters]


class Drawing(NamedTuple):
    """A picture: stem of its file, heading, figure, and alternative text."""

    name: str
    title: str
    figure: Figure
    shows: str


Style = dict[str, Any]
"""Matplotlib's keyword arguments of an experiment's line and markers."""


def algorithm_styles(experiments: Iterable[Experiment]) -> dict[str, Style]:
    """Label of an experiment -> its style, the same in every picture.

    Experiments with one algorithm share colour and marker, and have different lines. Markers are
    filled for the first variant, and for those that differ from it only in limits.
    """
    variants: dict[str, set[tuple[int, str, str]]] = defaultdict(set)
    for e in experiments:
        variants[e.base].add((len(e.family), e.family, e.label))
    known = (*ALGORITHMS, *sorted(PACKAGED - ALGORITHMS.keys()))
    looks = dict(zip(known, _LOOKS, strict=False))
    further = cycle(_LOOKS[len(known) :])
    styles: dict[str, Style] = {}
    for base, of_base in sorted(variants.items()):
        colour, marker = looks.get(base) or next(further)
        for number, (_, family, label) in enumerate(sorted(of_base)):
            face = colour if family == min(of_base)[1] else "white"
            line = (0, (7, 2, *(1, 2) * (number - 1))) if number else "-"
            styles[label] = {"color": colour, "marker": marker, "markerfacecolor": face}
            styles[label]["linestyle"] = line
    return styles


def literal(text: str) -> str:
    """A name for Matplotlib: not read as mathematics, and not hidden in legends."""
    return text.replace("$", r"\$").replace("_", "\N{ZERO WIDTH SPACE}_", text[:1] == "_")


def set_grid(axis: Axes) -> None:
    """Add a faint grid to a panel, and remove the top and right sides of its frame."""
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)


def add_legend(figure: Figure, axes: Iterable[Axes]) -> None:
    """Add one legend for all panels below the figure, whose height increases by the legend's.

    The legend has as many columns as fit, and breaks long labels into lines.
    """
    pairs = (pair for axis in axes for pair in zip(*axis.get_legend_handles_labels(), strict=True))
    handles = {fill(label, _LONGEST_LABEL, break_on_hyphens=False): h for h, label in pairs}
    if not handles:
        return
    letters = int(_LEGEND * figure.get_figwidth() / WIDTH)
    longest = max(len(line) for label in handles for line in label.splitlines())
    legend = figure.legend(
        handles.values(), handles, loc="outside lower center", frameon=False, handlelength=5.0,
        ncols=max(1, min(6, len(handles), letters // (longest + 10))),
    )  # fmt: skip
    size = legend.get_window_extent(FigureCanvasAgg(figure).get_renderer())
    figure.set_figheight(figure.get_figheight() + size.height / figure.dpi)


Final = tuple[Experiment, Record]
"""An experiment, and the record of its final scores."""


def fronts(finals: Iterable[Final], styles: Mapping[str, Style], width: float) -> list[Drawing]:
    """Draw final returns against final costs, a panel per environment and number of steps.

    A point is an experiment, with the standard deviations over its seeds. A line in an algorithm's
    colour joins its experiments under several limits; the limits are written beside the points.
    The grey line is the Pareto front. A single experiment has no panel, and one without a return or
    a cost no point.
    """
    groups: dict[str, list[Final]] = defaultdict(list)
    for experiment, record in finals:
        if math.isfinite(record["episode_return"] + record.get("episode_cost", math.nan)):
            steps = dict.fromkeys((record["fewest_steps"], record["steps"]))
            lengths = " to ".join(map(short_number, steps))
            groups[f"{experiment.environment}, {lengths} steps"].append((experiment, record))
    shown = {title: members for title, members in groups.items() if len(members) > 1}
    if not shown:
        return []
    columns = min(max(1, round(3 * width / WIDTH)), len(shown))
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(width, 3.3 * rows + 0.2), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for number, (axis, (title, members)) in enumerate(zip(panels, shown.items(), strict=False)):
        _draw_front(axis, members, styles)
        axis.set_title(literal(fill(title, 44)), fontsize=10, fontweight="bold")
        axis.set_xlabel("episode cost")
        axis.set_ylabel("return" if number % columns == 0 else "")
        set_grid(axis)
    for axis in panels[len(shown) :]:
        axis.set_axis_off()
    add_legend(figure, panels)
    texts = [f"{title}: {', '.join(e.algorithm for e, _ in m)}" for title, m in shown.items()]
    says = f"Final return against final episode cost. {'; '.join(texts)}"
    return [Drawing("fronts", "", figure, says)]


def _draw_front(axis: Axes, finals: Sequence[Final], styles: Mapping[str, Style]) -> None:
    points = np.array([(r["episode_cost"], r["episode_return"]) for _, r in finals])
    front = points[pareto_front(points[:, 1], points[:, 0])]
    axis.plot(*front.T, color="0.7", linewidth=1, zorder=1, drawstyle="steps-post")
    families: dict[str, list[Final]] = defaultdict(list)
    for experiment, record in finals:
        families[experiment.family].append((experiment, record))
    for family, members in families.items():
        members.sort(key=lambda pair: pair[0].limits.get("cost", math.inf))
        style = styles[members[0][0].label]
        joined = np.array([(r["episode_cost"], r["episode_return"]) for _, r in members]).T
        axis.plot(*joined, color=style["color"], linewidth=1, alpha=0.6)
        for (experiment, record), cost, value in zip(members, *joined, strict=True):
            axis.errorbar(
                cost, value, xerr=record["episode_cost_std"], yerr=record["episode_return_std"],
                **{**style, "linestyle": ""}, elinewidth=0.8, markersize=7, label=literal(family),
            )  # fmt: skip
            if len(members) > 1 and "cost" in experiment.limits:
                text = f"≤ {experiment.limits['cost']:g}"
                axis.annotate(
                    text, (cost, value), (5, 4), textcoords="offset points", fontsize=7, color="0.3"
                )
    for limit in {e.limits["cost"] for e, _ in finals if "cost" in e.limits}:
        axis.axvline(limit, **LIMIT_STYLE)
