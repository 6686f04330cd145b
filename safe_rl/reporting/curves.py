"""Learning curves over environments, also as the paper's Figures 7 to 9."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from safe_rl.reporting.archive import Run
from safe_rl.reporting.experiments import Experiment, cost_keys_of
from safe_rl.reporting.figures import (
    LIMIT_STYLE,
    WIDTH,
    Style,
    add_legend,
    algorithm_styles,
    literal,
    set_grid,
)
from safe_rl.reporting.tables import clean, short_number
from safe_rl.runs.curves import moving_mean
from safe_rl.runs.table import final_width
from safe_rl.scores.benchmark import ALGORITHMS
from safe_rl.scores.comparisons import t_interval

_NUM_POINTS = 200  # of a curve at most; a panel is not much wider in pixels
_NUM_MARKERS = 6  # of a curve
_ROW_HEIGHT = 2.4  # of a row of panels [inch]
_TITLES = ("Return", "Episode cost", "Cost rate")


class Average(NamedTuple):
    """A quantity over training: its mean over seeds and the bounds of its 95 % interval.

    All have shape [points]; the interval is NaN with a single seed.
    """

    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def average(runs: Sequence[Run], column: str, *, smooth: bool) -> Average | None:
    """Average a column of the runs' tables over seeds; None without runs, or if one has no value.

    The curve ends with the shortest run. Between epochs, and where no episode finished, values are
    interpolated. With ``smooth`` values are moving means over as many epochs as final figures.
    """
    series = []
    for run in runs:
        steps, values = (np.array(run.table.get(name, [])) for name in ("steps", column))
        known = np.flatnonzero(np.isfinite(values))
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
    return Average(grid, heights.mean(-1), *t_interval(heights))


def draw_learning_curves(
    experiments: Sequence[Experiment], styles: Mapping[str, Style], width: float = WIDTH
) -> Figure:
    """Draw return, episode cost and cost rate over steps, a row per environment.

    Lines are means over seeds, bands their 95 % t intervals. Return and episode cost are moving
    means over as many epochs as final figures. Limits d are dashed, and so is d / T_ep in the panel
    of the cost rate. Each unfinished run is a dotted line of its own. An environment has a row for
    each number of steps and each cost with a limit.
    """
    groups: dict[tuple[str, int], list[Experiment]] = {}
    for e in experiments:
        groups.setdefault((e.environment, e.planned_steps), []).append(e)
    rows = [(*group, key) for group, members in groups.items() for key in drawn_keys(members)]
    figure = Figure(figsize=(width, _ROW_HEIGHT * len(rows) + 0.3), layout="constrained")
    panels = figure.subplots(len(rows), 3, squeeze=False, sharex="row")
    several = len({name for name, _ in groups}) < len(groups)
    for (environment, steps, key), axes in zip(rows, panels, strict=True):
        _draw_panels(groups[environment, steps], key, axes, styles)
        words = [fill(environment.replace(" (", "\n("), 24, replace_whitespace=False)]
        words += [f"{short_number(steps)} steps"] if several else []
        words += [] if key == "cost" else [clean(key, 40)]
        axes[0].set_ylabel(literal("\n".join(words)), fontweight="bold")
        set_axes(axes)
    for axis, title in zip(panels[0], _TITLES, strict=True):
        axis.set_title(title, fontweight="bold")
    for axis in panels[-1]:
        axis.set_xlabel("environment steps")
    add_legend(figure, panels.ravel())
    return figure


def comparable(experiments: Sequence[Experiment], environments: Sequence[str]) -> list[Experiment]:
    """The paper's algorithms on some environments: one experiment each, with equally many steps.

    These are the steps that most of the experiments have. Of several experiments that differ in
    other settings, the one with the most seeds is taken.
    """
    known = [
        replace(e, runs=e.finished, settings={})
        for e in experiments
        if e.benchmark in environments
        and e.base in ALGORITHMS
        and e.is_published_problem
        and e.finished
    ]
    cells = Counter(s for _, _, s in {(e.benchmark, e.base, e.planned_steps) for e in known})
    steps = max(cells, key=lambda steps: (cells[steps], steps), default=0)
    by_seeds = sorted((e for e in known if e.planned_steps == steps), key=lambda e: len(e.runs))
    return [*{(e.benchmark, e.base): e for e in by_seeds}.values()]


def draw_benchmark(
    experiments: Sequence[Experiment], environments: Sequence[str], width: float = WIDTH
) -> Figure:
    """Draw return, episode cost and cost rate below one another, a column per environment.

    With the experiments of `comparable` on a robot's environments, this is the paper's Figure 7, 8
    or 9. Below the name of an environment stands how many of the algorithms there are.
    """
    figure = Figure(figsize=(width, 0.55 * width), layout="constrained")
    panels = figure.subplots(3, len(environments), sharex=True)
    styles = algorithm_styles(experiments)
    for axes, name in zip(panels.T, environments, strict=True):
        shown = sorted(
            (e for e in experiments if e.benchmark == name),
            key=lambda e: [*ALGORITHMS].index(e.base),
        )
        _draw_panels(shown, "cost", axes, styles)
        axes[0].set_title(f"{name}\n{_coverage(shown)}", fontsize=8)
        axes[2].set_xlabel("environment steps", fontsize=8)
        for axis in axes if not shown else ():
            axis.text(0.5, 0.5, "no runs", transform=axis.transAxes, ha="center", color="0.5")
            axis.set_yticks([])
    for axes in panels.T:  # which share their steps: when all are drawn
        set_axes(axes, ticks=3)
    for axis, title in zip(panels[:, 0], _TITLES, strict=True):
        axis.set_ylabel(title, fontweight="bold")
    add_legend(figure, panels.ravel())
    return figure


def _coverage(experiments: Sequence[Experiment]) -> str:
    """How many of the paper's algorithms there are, and their numbers of seeds."""
    seeds = sorted({len(e.runs) for e in experiments})
    several = " to ".join(f"{n}" for n in dict.fromkeys((*seeds[:1], *seeds[-1:])))
    unit = "seed" if seeds == [1] else "seeds"
    algorithms = f"{len(experiments)} of {len(ALGORITHMS)} algorithms"
    return algorithms + (f", {several} {unit}" if seeds else "")


def drawn_keys(experiments: Sequence[Experiment]) -> list[str]:
    """Cost keys with a limit, or the aggregate cost if there are none."""
    limited = {key for experiment in experiments for key in experiment.limits}
    return [key for key in cost_keys_of(experiments) if key in limited] or ["cost"]


def _curves(runs: Sequence[Run], key: str) -> list[Average | None]:
    """Return, episode cost and cost rate; None in place of those without a value."""
    columns = [("episode_return", True), (f"episode_{key}", True), (f"{key}_rate", False)]
    return [average(runs, name, smooth=s) for name, s in columns]


def curve_rows(experiments: Sequence[Experiment]) -> list[dict[str, Any]]:
    """All curves of the pictures as a long table: a row for every point of every quantity."""
    return [
        {
            **{"environment": e.environment, "algorithm": e.algorithm, "cost": key},
            **{"quantity": name, "seeds": len(runs)},
            **dict(zip(Average._fields, map(float, point), strict=True)),
        }
        for e in experiments
        for runs in [e.finished or e.runs]
        for key in drawn_keys([e])
        for name, curve in zip(("return", "cost", "rate"), _curves(runs, key), strict=True)
        if curve is not None
        for point in zip(*curve, strict=True)
    ]


def _draw_panels(
    experiments: Sequence[Experiment], key: str, axes: Sequence[Axes], styles: Mapping[str, Style]
) -> None:
    """Draw return, episode cost and cost rate into a panel each, with the limits d and d / T_ep."""
    for experiment in experiments:
        _draw_experiment(experiment, key, axes, styles[experiment.label])
    limits = {(e.limits[key], e.runs[0].episode_length) for e in experiments if key in e.limits}
    for limit, length in limits:
        axes[1].axhline(limit, **LIMIT_STYLE)
        if length is not None:
            axes[2].axhline(limit / length, **LIMIT_STYLE)


def _draw_experiment(experiment: Experiment, key: str, axes: Sequence[Axes], style: Style) -> None:
    """Draw finished runs as a mean and its interval, each unfinished run as a line."""
    name = literal(experiment.label)
    looks: list[tuple[Any, ...]] = [(experiment.finished, name, style.line, 1.5)]
    unfinished = [[run] for run in experiment.runs if not run.is_finished]
    looks += [(runs, f"{name} (unfinished)", ":", 1.2) for runs in unfinished]
    for runs, label, line, width in looks:
        for axis, curve in zip(axes, _curves(runs, key), strict=True):
            if curve is None:
                continue
            every = max(1, len(curve.steps) // _NUM_MARKERS)
            axis.plot(
                curve.steps, curve.mean, **style.point, linestyle=line, linewidth=width,
                label=label, markevery=every, markersize=4,
            )  # fmt: skip
            if len(runs) > 1:
                look: dict[str, Any] = {"color": style.colour, "alpha": 0.2, "linewidth": 0}
                axis.fill_between(curve.steps, curve.low, curve.high, **look)


def set_axes(axes: Sequence[Axes], ticks: int = 6) -> None:
    """Set scales, ticks and grid of a row of panels: return, episode cost and cost rate."""
    for axis in axes:
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.xaxis.set_major_locator(MaxNLocator(ticks))
        set_grid(axis)
        axis.set_xlim(left=0)
    for axis in axes[1:]:
        axis.set_ylim(bottom=0)
