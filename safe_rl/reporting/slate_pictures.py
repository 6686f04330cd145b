"""Pictures of slates: interquartile means with their intervals, and performance profiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from safe_rl.reporting.columns import Record
from safe_rl.reporting.pictures import WIDTH, Style, add_legend, literal, set_grid
from safe_rl.reporting.slate_scores import SYMBOLS, Aggregate
from safe_rl.scores.comparisons import performance_profile

__all__ = ["draw_middles", "draw_profiles"]

# of the thresholds of a profile
_NUM_POINTS = 101


def draw_middles(records: Sequence[Record], styles: Mapping[str, Style]) -> Figure:
    """Draw interquartile means and their intervals, a panel per normalised score.

    Args:
        records: Of :func:`safe_rl.reporting.slate_scores.middle_table`.
        styles: Name of an algorithm -> how it is drawn.
    """
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

    Bands are 95 % intervals of a bootstrap that resamples every environment's seeds.

    Args:
        aggregates: One per algorithm; at least of one every run has finished an episode.
        styles: Name of an algorithm -> how it is drawn.
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
