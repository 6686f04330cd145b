"""The picture of variations: a policy's return and costs in changed environments."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from safe_rl.reporting.figures import LIMIT_STYLE, literal, save
from safe_rl.scores.comparisons import Estimate

__all__ = ["draw_variations"]

_WIDTH, _HEIGHT, _MOST_COLUMNS = 2.2, 2.0, 5  # of a panel [inch]; panels beside each other
_COLOURS = ("#0072b2", "#d55e00", "#cc79a7", "#009e73")
_OTHERS = "others"
_NONE = Estimate(math.nan, math.nan, math.nan)  # of a cost that a variation has not


def draw_variations(
    rows: Sequence[tuple[Any, Mapping[str, Estimate]]],
    cost_limits: Mapping[str, float],
    path: Path,
) -> None:
    """Draw return and costs with their intervals over the values of every row.

    The band across a panel is the environment as trained on, which is the first of the rows; limits
    are dashed. Without limits, ``cost`` is drawn.
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
