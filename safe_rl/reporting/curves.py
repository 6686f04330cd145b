"""Learning curves (the paper's Figures 7 to 9), joined where runs continue other ones."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from safe_rl.reporting.experiments import Experiment, Source, cost_keys_of
from safe_rl.reporting.figures import (
    LIMIT_STYLE,
    WIDTH,
    Style,
    add_legend,
    algorithm_styles,
    literal,
    set_grid,
)
from safe_rl.reporting.recorded import Run
from safe_rl.reporting.tables import clean
from safe_rl.runs.curves import moving_mean, point_marker
from safe_rl.runs.outcome import final_width
from safe_rl.scores.intervals import bootstrap

__all__ = [
    *("Average", "Transfer", "average", "draw_experiment", "draw_learning_curves"),
    *("draw_transfer", "find_transfers", "limits_of", "set_axes"),
]

_NUM_POINTS = 200  # of a curve at most; a panel is not much wider in pixels
_ROW_HEIGHT = 2.5  # of a row of panels [inch]
_TITLES = ("Return", "Episode cost", "Cost rate")


class Average(NamedTuple):
    """A quantity over training: its mean over seeds and the ends of its 95 % interval.

    All have shape [points]; the interval is NaN with a single seed.
    """

    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def average(runs: Sequence[Run], column: str, *, smooth: bool) -> Average | None:
    """Average a column of the runs' tables over seeds; None if one has no value, or there is none.

    The curve ends where the first of the runs does. Between epochs, and over those in which no
    episode finished, values are interpolated.

    Args:
        runs: One per seed.
        column: Column of their tables.
        smooth: Whether to take :func:`safe_rl.runs.curves.moving_mean` first, which ends at the
            run's final figure.
    """
    series = []
    for run in runs:
        steps = np.array(run.table["steps"])
        values = np.array(run.table.get(column, np.full(steps.shape, np.nan)))
        known = np.isfinite(values)
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
    return Average(grid, heights.mean(-1), *bootstrap([heights], np.mean))


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
        for key in _drawn_keys([e for e in experiments if e.environment == environment])
    ]
    figure = Figure(figsize=(WIDTH, _ROW_HEIGHT * len(rows) + 0.3), layout="constrained")
    panels = figure.subplots(len(rows), 3, squeeze=False)
    for (environment, key), axes in zip(rows, panels, strict=True):
        shown = [e for e in experiments if e.environment == environment]
        for experiment in shown:
            draw_experiment(experiment, key, axes, styles[experiment.algorithm])
        name = literal(fill(environment.replace(" (", "\n("), 24, replace_whitespace=False))
        label = name if key == "cost" else f"{name}\n{literal(clean(key, 40))}"
        axes[0].set_ylabel(label, fontweight="bold")
        for axis, height in limits_of(shown, key, axes):
            axis.axhline(height, **LIMIT_STYLE)
        set_axes(axes)
    for axis, title in zip(panels[0], _TITLES, strict=True):
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


def _drawn_keys(experiments: Sequence[Experiment]) -> list[str]:
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
                look: dict[str, Any] = {"color": style.colour, "alpha": 0.2, "linewidth": 0}
                axis.fill_between(steps, curve.low, curve.high, **look)


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


@dataclass(frozen=True)
class Transfer:
    """Training on one environment that was continued on another one (paper section 6).

    Attributes:
        first: The runs it started from, up to the checkpoints that were taken; one experiment as a
            rule, none if no run was found.
        second: The runs that started from them.
        changes: Environment steps of the first phase, ascending; one number unless the seeds
            started from checkpoints of different ages.
        missing: What ``init_from`` names and was not found, of each run of the second phase.
    """

    first: tuple[Experiment, ...]
    second: Experiment
    changes: tuple[int, ...]
    missing: tuple[Path, ...]

    @property
    def title(self) -> str:
        """Both environments and the algorithm."""
        before = " / ".join(dict.fromkeys(e.environment for e in self.first)) or "?"
        return f"{before} → {self.second.environment}, {self.second.algorithm}"

    @property
    def notes(self) -> list[str]:
        """What has to be said beside the figure, in sentences."""
        notes = []
        if self.missing:
            names = ", ".join(map(clean, dict.fromkeys(self.missing)))
            shown = "the first phase is that of the others" if self.first else "drawn alone"
            notes.append(f"The run it started from is not in this folder ({names}): {shown}.")
        if len(self.changes) > 1:
            notes.append(
                f"The seeds started from checkpoints after {self.changes[0]:,} to "
                f"{self.changes[-1]:,} steps: the second phase is averaged over steps of its own "
                "and drawn from the last of these."
            )
        return notes


def find_transfers(
    experiments: Sequence[Experiment], sources: Mapping[Path, Source]
) -> list[Transfer]:
    """Find the experiments that continue others.

    Args:
        experiments: All experiments.
        sources: Folder of a run -> what it started from.
    """
    names = {run.directory: e for e in experiments for run in e.runs}
    return [_transfer(e, sources, names) for e in experiments if e.is_continued]


def _transfer(
    second: Experiment, sources: Mapping[Path, Source], names: Mapping[Path, Experiment]
) -> Transfer:
    continued = [run for run in second.runs if run.init_from is not None]
    found = [sources[run.directory] for run in continued if run.directory in sources]
    # several seeds may start from one run, which is one sample
    longest = {source.run.directory: source for source in sorted(found, key=lambda s: s.steps)}
    phases: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for directory, (run, steps) in longest.items():
        own = names.get(directory)
        # a repetition of a run that was kept is in no experiment
        key = (own.environment, own.algorithm) if own else ("?", run.algorithm)
        rows = sum(reached <= steps for reached in run.table["steps"])
        table = {name: values[:rows] for name, values in run.table.items()}
        phases[key].append(replace(run, table=table, frames=0))
    return Transfer(
        tuple(Experiment(*key, None, tuple(members)) for key, members in phases.items()),
        second,
        tuple(sorted({source.steps for source in found})),
        tuple(r.init_from for r in continued if r.init_from and r.directory not in sources),
    )


def draw_transfer(transfer: Transfer, styles: Mapping[str, Style]) -> Figure:
    """Draw return, episode cost and cost rate over the steps of both phases, a row per cost.

    The second phase follows the first, and a vertical line separates them. Each has its
    environment above it and its own limits, dashed. The cost rate is the sum of all costs of a
    phase divided by all steps of that phase: it is not carried over.

    Args:
        transfer: The two phases; the second is drawn alone if the first was not found.
        styles: Name of an algorithm -> how it is drawn.
    """
    change = max(transfer.changes, default=0)
    end = change + max(run.steps for run in transfer.second.runs)
    phases: list[tuple[tuple[Experiment, ...], int, int]] = [((transfer.second,), change, end)]
    if transfer.first:
        phases.insert(0, (transfer.first, 0, change))
    keys = _drawn_keys([*transfer.first, transfer.second])
    styles = {**algorithm_styles(transfer.first), **styles}
    figure = Figure(figsize=(WIDTH, _ROW_HEIGHT * len(keys) + 0.7), layout="constrained")
    panels = figure.subplots(len(keys), 3, squeeze=False)
    for key, axes in zip(keys, panels, strict=True):
        for experiments, start, stop in phases:
            for experiment in experiments:
                draw_experiment(experiment, key, axes, styles[experiment.algorithm], start)
            for axis, height in limits_of(experiments, key, axes):
                axis.plot([start, stop], [height, height], **LIMIT_STYLE)
        set_axes(axes)
        axes[0].set_ylabel("" if key == "cost" else literal(clean(key, 40)), fontweight="bold")
        for axis in axes:
            axis.set_xlim(right=end)
            if len(phases) > 1:
                axis.axvline(change, color="#333333", linewidth=1.1)
    names = [" / ".join(dict.fromkeys(e.environment for e in own)) for own, _, _ in phases]
    labels = [literal(clean(name, 80).replace(" (", "\n(")) for name in names]
    # the first environment from the left of the panel, the second up to its right
    sides = [("center", 0.5)] if len(phases) == 1 else [("left", 0.0), ("right", 1.0)]
    for axis, title in zip(panels[0], (*_TITLES[:2], "Cost rate of each phase"), strict=True):
        for label, (side, place) in zip(labels, sides, strict=True):
            look = {"ha": side, "va": "bottom", "fontsize": 9}
            axis.text(place, 1.02, label, transform=axis.transAxes, **look)
        num_lines = 1 + max(label.count("\n") for label in labels)
        axis.set_title(title, fontweight="bold", pad=8 + 13 * num_lines)
    for axis in panels[-1]:
        axis.set_xlabel("environment steps")
    add_legend(figure, panels[:, 0])
    return figure
