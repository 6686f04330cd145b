"""Returns against costs: what no other experiment beats, and what each limit costs an algorithm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from math import isfinite, nan
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from safe_rl.reporting.columns import Record, span
from safe_rl.reporting.pictures import LIMIT_STYLE, WIDTH, Style, add_legend, literal, set_grid
from safe_rl.scores.comparisons import pareto_front

__all__ = ["compared", "draw_fronts"]

_MARKERS = "osD^vP"
_UNLIMITED = "x"


def compared(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Experiments that can be held against each other, by what stands above their panel.

    They have a return and a cost on the same environment after equally many steps, and there are
    at least two of them.
    """
    groups: dict[tuple[str, int, int], list[Record]] = {}
    for record in records:
        if isfinite(record["episode_return"] + record.get("episode_cost", nan)):
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
