"""Both phases of a transfer in one figure (paper section 6, problems 1 and 2)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.figures import (
    LIMIT_STYLE,
    ROW_HEIGHT,
    WIDTH,
    Style,
    add_legend,
    algorithm_styles,
    draw_experiment,
    drawn_keys,
    set_axes,
)
from safe_rl.reporting.transfers import Transfer

__all__ = ["draw_transfer"]

_TITLES = ("Return", "Episode cost", "Cost rate of each phase")
_CHANGE = {"color": "#333333", "linewidth": 1.1}


class _Phase(NamedTuple):
    """Experiments that are drawn from ``start`` to ``stop``, in environment steps."""

    experiments: tuple[Experiment, ...]
    start: int
    stop: int

    @property
    def label(self) -> str:
        names = " / ".join(dict.fromkeys(e.environment for e in self.experiments))
        return names.replace(" (", "\n(")


def draw_transfer(transfer: Transfer, styles: Mapping[str, Style]) -> Figure:
    """Draw return, episode cost and cost rate over the steps of both phases, a row per cost.

    The second phase follows the first, and a vertical line separates them. Each has its
    environment above it and its own limits, d and d / T_ep, dashed. The cost rate is the sum of all
    costs of a phase divided by all steps of that phase: it is not carried over.

    Args:
        transfer: The two phases; the second is drawn alone if the first was not found.
        styles: Name of an algorithm -> how it is drawn.
    """
    phases = list(_phases(transfer))
    everyone = [e for phase in phases for e in phase.experiments]
    keys = drawn_keys(everyone)
    styles = {**algorithm_styles(transfer.first), **styles}
    figure = Figure(figsize=(WIDTH, ROW_HEIGHT * len(keys) + 0.7), layout="constrained")
    panels = figure.subplots(len(keys), 3, squeeze=False)
    for key, axes in zip(keys, panels, strict=True):
        for phase in phases:
            for experiment in phase.experiments:
                draw_experiment(experiment, key, axes, styles[experiment.algorithm], phase.start)
            _draw_limits(phase, key, axes)
        set_axes(axes)
        axes[0].set_ylabel("" if key == "cost" else key, fontweight="bold")
        for axis in axes:
            axis.set_xlim(right=phases[-1].stop)
            if len(phases) > 1:
                axis.axvline(transfer.offset, **_CHANGE)
    for axis, title in zip(panels[0], _TITLES, strict=True):
        _label_phases(axis, phases)
        num_lines = 1 + max(phase.label.count("\n") for phase in phases)
        axis.set_title(title, fontweight="bold", pad=8 + 13 * num_lines)
    for axis in panels[-1]:
        axis.set_xlabel("environment steps")
    add_legend(figure, panels[:, 0])
    return figure


def _phases(transfer: Transfer) -> Iterator[_Phase]:
    if transfer.first:
        yield _Phase(transfer.first, 0, transfer.offset)
    steps = max(run.steps for run in transfer.second.runs)
    yield _Phase((transfer.second,), transfer.offset, transfer.offset + steps)


def _draw_limits(phase: _Phase, key: str, axes: Sequence[Axes]) -> None:
    """Limits of a phase, along it."""
    _, costs, rates = axes
    for limit, length in {
        (e.limits[key], e.runs[0].episode_length) for e in phase.experiments if key in e.limits
    }:
        for axis, height in ((costs, limit), (rates, limit / length)):
            axis.plot([phase.start, phase.stop], [height, height], **LIMIT_STYLE)


def _label_phases(axis: Axes, phases: Sequence[_Phase]) -> None:
    """Environments above the panel: the first from its left, the second up to its right."""
    sides = {1: ("center",), 2: ("left", "right")}[len(phases)]
    places = {"left": 0.0, "center": 0.5, "right": 1.0}
    for phase, side in zip(phases, sides, strict=True):
        axis.text(
            places[side], 1.02, phase.label, transform=axis.transAxes,
            ha=side, va="bottom", fontsize=9,
        )  # fmt: skip
