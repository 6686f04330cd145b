"""Experiments whose runs started from other runs' networks (paper section 6), as pictures."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from safe_rl.reporting.cleaning import clean
from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.origins import Origin
from safe_rl.reporting.pictures import (
    LIMIT_STYLE,
    ROW_HEIGHT,
    WIDTH,
    Style,
    add_legend,
    algorithm_styles,
    draw_experiment,
    drawn_keys,
    limits_of,
    literal,
    set_axes,
)
from safe_rl.reporting.recorded import Run

__all__ = ["Transfer", "draw_transfer", "find_transfers"]

_TITLES = ("Return", "Episode cost", "Cost rate of each phase")
_CHANGE: dict[str, Any] = {"color": "#333333", "linewidth": 1.1}


@dataclass(frozen=True)
class Transfer:
    """Training on one environment that was continued on another one.

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
    def offset(self) -> int:
        """Environment steps at which the second phase is drawn to begin."""
        return max(self.changes, default=0)

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
    experiments: Sequence[Experiment], origins: Mapping[Path, Origin]
) -> list[Transfer]:
    """Find the experiments that continue others.

    Args:
        experiments: All experiments.
        origins: Folder of a run -> what it started from.
    """
    names = {run.directory: e for e in experiments for run in e.runs}
    return [_transfer(e, origins, names) for e in experiments if e.is_continued]


def _transfer(
    second: Experiment, origins: Mapping[Path, Origin], names: Mapping[Path, Experiment]
) -> Transfer:
    continued = [run for run in second.runs if run.init_from is not None]
    found = [origins[run.directory] for run in continued if run.directory in origins]
    # several seeds may start from one run, which is one sample
    longest = {o.run.directory: o for o in sorted(found, key=lambda o: o.steps)}
    phases: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for directory, origin in longest.items():
        own = names.get(directory)
        # a repetition of a run that was kept is in no experiment
        key = (own.environment, own.algorithm) if own else ("?", origin.run.algorithm)
        phases[key].append(_until(*origin))
    return Transfer(
        tuple(Experiment(*key, None, tuple(members)) for key, members in phases.items()),
        second,
        tuple(sorted({origin.steps for origin in found})),
        tuple(r.init_from for r in continued if r.init_from and r.directory not in origins),
    )


def _until(run: Run, steps: int) -> Run:
    """A run as it was after so many steps, which counts as its end."""
    rows = sum(reached <= steps for reached in run.table["steps"])
    return replace(run, table={name: values[:rows] for name, values in run.table.items()}, frames=0)


class _Phase(NamedTuple):
    """Experiments that are drawn from ``start`` to ``stop``, in environment steps."""

    experiments: tuple[Experiment, ...]
    start: int
    stop: int

    @property
    def label(self) -> str:
        names = " / ".join(dict.fromkeys(e.environment for e in self.experiments))
        return literal(clean(names, 80).replace(" (", "\n("))


def draw_transfer(transfer: Transfer, styles: Mapping[str, Style]) -> Figure:
    """Draw return, episode cost and cost rate over the steps of both phases, a row per cost.

    The second phase follows the first, and a vertical line separates them. Each has its
    environment above it and its own limits, d and d / T_ep, dashed. The cost rate is the sum of all
    costs of a phase divided by all steps of that phase: it is not carried over.

    Args:
        transfer: The two phases; the second is drawn alone if the first was not found.
        styles: Name of an algorithm -> how it is drawn.
    """
    end = transfer.offset + max(run.steps for run in transfer.second.runs)
    phases = [_Phase((transfer.second,), transfer.offset, end)]
    if transfer.first:
        phases.insert(0, _Phase(transfer.first, 0, transfer.offset))
    keys = drawn_keys([e for phase in phases for e in phase.experiments])
    styles = {**algorithm_styles(transfer.first), **styles}
    figure = Figure(figsize=(WIDTH, ROW_HEIGHT * len(keys) + 0.7), layout="constrained")
    panels = figure.subplots(len(keys), 3, squeeze=False)
    for key, axes in zip(keys, panels, strict=True):
        for phase in phases:
            for experiment in phase.experiments:
                draw_experiment(experiment, key, axes, styles[experiment.algorithm], phase.start)
            for axis, height in limits_of(phase.experiments, key, axes):
                axis.plot([phase.start, phase.stop], [height, height], **LIMIT_STYLE)
        set_axes(axes)
        axes[0].set_ylabel("" if key == "cost" else literal(clean(key, 40)), fontweight="bold")
        for axis in axes:
            axis.set_xlim(right=end)
            if len(phases) > 1:
                axis.axvline(transfer.offset, **_CHANGE)
    for axis, title in zip(panels[0], _TITLES, strict=True):
        # the first environment from the left of the panel, the second up to its right
        sides = ({"center": 0.5}, {"left": 0.0, "right": 1.0})[len(phases) - 1]
        for phase, (side, place) in zip(phases, sides.items(), strict=True):
            axis.text(
                place, 1.02, phase.label, transform=axis.transAxes,
                ha=side, va="bottom", fontsize=9,
            )  # fmt: skip
        num_lines = 1 + max(phase.label.count("\n") for phase in phases)
        axis.set_title(title, fontweight="bold", pad=8 + 13 * num_lines)
    for axis in panels[-1]:
        axis.set_xlabel("environment steps")
    add_legend(figure, panels[:, 0])
    return figure
