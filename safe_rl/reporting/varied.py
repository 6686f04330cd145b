"""The picture of a policy under variations: return and costs, a column of panels for each row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from safe_rl.reporting.pictures import LIMIT_STYLE, ROW_HEIGHT, literal, save
from safe_rl.scores.intervals import Estimate

__all__ = ["draw_variations"]

# of a panel, and of each of its values beyond the third [inch]
_WIDTH, _WIDER = 2.2, 0.35
_COLOURS = ("#0072b2", "#d55e00", "#cc79a7", "#009e73")
_OTHERS = "others"


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
    groups: dict[str, list[tuple[str, Mapping[str, Estimate]]]] = {}
    for variation, estimates in varied:
        single = variation.value is None
        label = variation.row if single else f"{variation.value}"
        groups.setdefault(_OTHERS if single else variation.row, []).append((label, estimates))
    names = ["episode_return", *(f"episode_{key}" for key in cost_limits or ["cost"])]
    groups = groups or {_OTHERS: [("as trained", trained)]}
    widths = [_WIDTH + _WIDER * max(0, len(group) - 3) for group in groups.values()]
    figure = Figure(
        figsize=(0.8 + sum(widths), 0.4 + ROW_HEIGHT * len(names)), layout="constrained"
    )
    panels = figure.subplots(
        len(names), len(groups), sharey="row", squeeze=False, width_ratios=widths
    )
    for line, (name, colour) in enumerate(zip(names, _COLOURS * len(names), strict=False)):
        limit = cost_limits.get(name.removeprefix("episode_"))
        for axis, (row, group) in zip(panels[line], groups.items(), strict=True):
            _draw(axis, [(label, found[name]) for label, found in group], trained[name], colour)
            if limit is not None:
                axis.axhline(limit, **LIMIT_STYLE)
            if line == 0:
                axis.set_title(literal(row))
        panels[line][0].set_ylabel(literal(name.removeprefix("episode_")))
    figure.supxlabel("grey: as trained; dashed: the limit", fontsize="small", color="0.3")
    save(figure, path)


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
