"""Learning curves over environments, also as the paper's Figures 7 to 9."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain, groupby
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from safe_rl.reporting.archive import ReportedRun
from safe_rl.reporting.experiments import Experiment, cost_keys_of
from safe_rl.reporting.figures import (
    LIMIT_STYLE,
    Drawing,
    Style,
    add_legend,
    algorithm_styles,
    literal,
    set_grid,
)
from safe_rl.reporting.tables import clean, short_number
from safe_rl.runs.curves import moving_mean
from safe_rl.runs.table import final_width
from safe_rl.scores.benchmark import ALGORITHMS, SLATES
from safe_rl.scores.comparisons import t_interval

_NUM_POINTS = 200  # of a curve at most; a panel is not much wider in pixels
_NUM_MARKERS = 6  # of a curve
_ROW_HEIGHT = 2.4  # of a row of panels [inch]
_MOST_ROWS = 6  # of a picture of learning curves, so that it fits on a printed page
_MOST_CURVES = 6  # in one panel
_FEWEST_ENVIRONMENTS = 3  # of the benchmark, with which its figures are drawn
_TITLES = ("Return", "Episode cost", "Cost rate")


class Average(NamedTuple):
    """A quantity over training: its mean over seeds and the bounds of its 95 % interval.

    All have shape [points]; the interval is NaN with a single seed.
    """

    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def average(runs: Sequence[ReportedRun], column: str, *, smooth: bool) -> Average | None:
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


def _curves(runs: Sequence[ReportedRun], key: str) -> list[Average | None]:
    """Return, episode cost and cost rate; None in place of those without a value."""
    columns = [("episode_return", True), (f"episode_{key}", True), (f"{key}_rate", False)]
    return [average(runs, name, smooth=s) for name, s in columns]


def _drawn_keys(experiments: Sequence[Experiment]) -> list[str]:
    """Cost keys with a limit, or the aggregate cost if there are none."""
    limited = {key for experiment in experiments for key in experiment.limits}
    return [key for key in cost_keys_of(experiments) if key in limited] or ["cost"]


def curve_rows(experiments: Sequence[Experiment]) -> list[dict[str, Any]]:
    """All curves of the pictures as a long table: a row for every point of every quantity."""
    return [
        {
            **{"environment": e.environment, "algorithm": algorithm, "cost": key},
            **{"quantity": name, "seeds": len(runs)},
            **dict(zip(Average._fields, map(float, point), strict=True)),
        }
        for e in experiments
        for runs, algorithm in [(e.finished or e.runs, e.algorithm)]
        for key in _drawn_keys([e])
        for name, curve in zip(("return", "cost", "rate"), _curves(runs, key), strict=True)
        if curve is not None
        for point in zip(*curve, strict=True)
    ]


def curves_of_experiments(
    experiments: Sequence[Experiment], styles: Mapping[str, Style], width: float
) -> list[Drawing]:
    """Draw return, episode cost and cost rate over steps, a row per environment and steps of runs.

    More than a few curves of a row are shared out among pictures of their own.
    """
    rows, pictures = [], []
    for _, group in groupby(experiments, key=lambda e: e.environment):
        by_steps = sorted(group, key=lambda e: e.planned_steps)
        for _, of_steps in groupby(by_steps, key=lambda e: e.planned_steps):
            row = [*of_steps]
            if len(row) <= _MOST_CURVES:
                rows.append(row)
            else:
                pictures += [[part] for part in _parts(row, _MOST_CURVES)]
    drawings = []
    for picture in [*pictures, *_parts(rows, _MOST_ROWS)]:
        names = ", ".join(dict.fromkeys(e.environment for e in chain(*picture)))
        algorithms = ", ".join(dict.fromkeys(e.label for e in chain(*picture)))
        says = f"Return, episode cost and cost rate over environment steps: {names}; {algorithms}"
        drawings.append(Drawing("curves", "", _draw_rows(picture, styles, width), says))
    return drawings


def _parts(items: list[Any], most: int) -> list[list[Any]]:
    return [items[start : start + most] for start in range(0, len(items), most)]


def _draw_rows(
    rows: Sequence[Sequence[Experiment]], styles: Mapping[str, Style], width: float
) -> Figure:
    """Draw a picture of learning curves, with a row of panels for each cost with a limit.

    Lines are means over seeds, bands their 95 % t intervals. Return and episode cost are moving
    means over as many epochs as final figures. Limits d are dashed, and so is d / T_ep in the panel
    of the cost rate. Each unfinished run is a dotted line of its own.
    """
    lines = [(members, key) for members in rows for key in _drawn_keys(members)]
    figure = Figure(figsize=(width, _ROW_HEIGHT * len(lines) + 0.3), layout="constrained")
    panels = figure.subplots(len(lines), 3, squeeze=False, sharex="row")
    has_several_steps = len({members[0].environment for members in rows}) < len(rows)
    for (members, key), axes in zip(lines, panels, strict=True):
        _draw_panels(members, key, axes, styles)
        environment = members[0].environment.replace(" (", "\n(")
        words = [fill(environment, 24, replace_whitespace=False)]
        words += [f"{short_number(members[0].planned_steps)} steps"] if has_several_steps else []
        words += [] if key == "cost" else [clean(key, 40)]
        axes[0].set_ylabel(literal("\n".join(words)), fontweight="bold")
        _set_axes(axes, ticks=6)
    for axis, title in zip(panels[0], _TITLES, strict=True):
        axis.set_title(title, fontweight="bold")
    for axis in panels[-1]:
        axis.set_xlabel("environment steps")
    add_legend(figure, panels.ravel())
    return figure


def benchmark_figures(experiments: Sequence[Experiment], width: float) -> list[Drawing]:
    """The paper's Figures 7 to 9, of robots with runs; none if there are runs on few environments.

    Environments without runs are shown as missing.
    """
    robots = {"Point": 7, "Car": 8, "Doggo": 9}
    by_robot = {robot: _comparable(experiments, SLATES[f"SG{robot}"]) for robot in robots}
    if len({e.benchmark for members in by_robot.values() for e in members}) < _FEWEST_ENVIRONMENTS:
        return []
    return [
        Drawing(
            f"figure_{robots[robot]}",
            f"The paper's Figure {robots[robot]}, from runs of "
            f"{short_number(members[0].planned_steps)} steps",
            _draw_columns(members, SLATES[f"SG{robot}"], width),
            "Return, episode cost and cost rate of the paper's algorithms, a column for each of "
            f"{robot}'s environments",
        )
        for robot, members in by_robot.items()
        if members
    ]


def _comparable(experiments: Sequence[Experiment], environments: Sequence[str]) -> list[Experiment]:
    """The paper's algorithms on some environments: one experiment each, with equally many steps.

    These are the steps that most of the experiments have. Of several experiments that differ in
    other settings, the one with the most seeds is taken.
    """
    known = [
        replace(e, runs=e.finished, settings={})
        for e in experiments
        if e.is_of_paper and e.benchmark in environments
    ]
    cells = Counter(s for _, _, s in {(e.benchmark, e.base, e.planned_steps) for e in known})
    steps = max(cells, key=lambda steps: (cells[steps], steps), default=0)
    by_seeds = sorted((e for e in known if e.planned_steps == steps), key=lambda e: len(e.runs))
    return [*{(e.benchmark, e.base): e for e in by_seeds}.values()]


def _draw_columns(
    experiments: Sequence[Experiment], environments: Sequence[str], width: float
) -> Figure:
    """Draw return, episode cost and cost rate below one another, a column per environment.

    Below the name of an environment stands how many of the algorithms there are.
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
        _set_axes(axes, ticks=3)
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


def _draw_panels(
    experiments: Sequence[Experiment], key: str, axes: Sequence[Axes], styles: Mapping[str, Style]
) -> None:
    """Draw return, episode cost and cost rate into a panel each, with the limits d and d / T_ep.

    Finished runs are a mean and its interval, each unfinished run is a line.
    """
    for e in experiments:
        name, style = literal(e.label), styles[e.label]
        looks = [(e.finished, {**style, "linewidth": 1.5, "label": name})]
        dotted = {"linestyle": ":", "linewidth": 1.2, "label": f"{name} (unfinished)"}
        looks += [((run,), {**style, **dotted}) for run in e.runs if not run.is_finished]
        for runs, look in looks:
            for axis, curve in zip(axes, _curves(runs, key), strict=True):
                if curve is None:
                    continue
                every = max(1, len(curve.steps) // _NUM_MARKERS)
                axis.plot(curve.steps, curve.mean, **look, markevery=every, markersize=4)
                if len(runs) > 1:
                    band = {"color": style["color"], "alpha": 0.2, "linewidth": 0}
                    axis.fill_between(curve.steps, curve.low, curve.high, **band)
    limits = {(e.limits[key], e.runs[0].episode_length) for e in experiments if key in e.limits}
    for limit, length in limits:
        axes[1].axhline(limit, **LIMIT_STYLE)
        if length is not None:
            axes[2].axhline(limit / length, **LIMIT_STYLE)


def _set_axes(axes: Sequence[Axes], ticks: int) -> None:
    """Set scales, ticks and grid of panels of return, episode cost and cost rate."""
    for axis in axes:
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.xaxis.set_major_locator(MaxNLocator(ticks))
        set_grid(axis)
        axis.set_xlim(left=0)
    for axis in axes[1:]:
        axis.set_ylim(bottom=0)
