"""Everything a report says, before it is written down."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from safe_rl.reporting.experiments import Experiment, group_runs
from safe_rl.reporting.figures import (
    Style,
    algorithm_styles,
    draw_aggregates,
    draw_learning_curves,
)
from safe_rl.reporting.results import cost_keys_of, dominance_table, final_record, final_table
from safe_rl.reporting.runs import Run, find_runs
from safe_rl.reporting.slate_tables import middle_table, slate_table
from safe_rl.reporting.slates import (
    Aggregate,
    Gap,
    aggregate,
    can_be_normalised,
    find_gap,
)
from safe_rl.reporting.tables import Table
from safe_rl.reporting.transfer_figures import draw_transfer
from safe_rl.reporting.transfers import Transfer, find_transfers
from safe_rl.scores.published import REFERENCE
from safe_rl.scores.slates import SLATES

__all__ = ["Report", "Slate", "build_report"]


@dataclass(frozen=True)
class Slate:
    """Normalised scores on a set of environments.

    Attributes:
        name: Its name in the paper, or "shared" for what all algorithms were trained on.
        environments: What it consists of.
        table: The scores of every algorithm that has all of its runs.
        middle: Their interquartile means with intervals.
        figure: The same as a picture.
    """

    name: str
    environments: tuple[str, ...]
    table: Table
    middle: Table
    figure: Figure


@dataclass(frozen=True)
class Report:
    """What there is to say about a folder of runs.

    Attributes:
        experiments: Runs, grouped.
        finals: Final scores, a table per environment.
        curves: Robot -> its learning curves.
        transfers: Experiments that continue others, with both phases as a picture.
        slates: Sets of environments that are complete for an algorithm or more.
        gaps: What is missing for the others.
        dominance: Which algorithm is better than which.
        skipped: Folder -> why it was left out.
    """

    experiments: Sequence[Experiment]
    finals: Sequence[Table]
    curves: Mapping[str, Figure]
    transfers: Sequence[tuple[Transfer, Figure]]
    slates: Sequence[Slate]
    gaps: Sequence[Gap]
    dominance: Table
    skipped: Mapping[Path, str]

    @property
    def runs(self) -> list[Run]:
        """All runs in it."""
        return [run for experiment in self.experiments for run in experiment.runs]

    def lacking(self) -> dict[str, str]:
        """Slate -> how many runs it lacks of the algorithms that have begun it, in words."""
        begun = [gap for gap in self.gaps if gap.is_begun]
        return {
            slate: ", ".join(f"{g.num_runs} of {g.algorithm}" for g in begun if g.slate == slate)
            for slate in dict.fromkeys(gap.slate for gap in begun)
        }

    def hardly_begun(self) -> str:
        """A line on what :meth:`lacking` leaves out, or nothing."""
        slates = dict.fromkeys(gap.slate for gap in self.gaps if not gap.is_begun)
        if not slates:
            return ""
        return (
            "Not listed: algorithms with runs on less than a third of the environments of "
            f"{', '.join(slates)}."
        )


def build_report(
    root: Path,
    suite: Mapping[str, Mapping[str, Any]],
    *,
    seeds_needed: int,
    unfinished: bool,
) -> Report:
    """Find the runs below a folder and put everything together.

    Args:
        root: The folder.
        suite: Name -> every key of a benchmark environment.
        seeds_needed: Finished runs that a slate takes per environment.
        unfinished: Whether unfinished runs count as finished ones.

    Raises:
        FileNotFoundError: If there is no run.
    """
    runs, unreadable = find_runs(root, unfinished=unfinished)
    experiments, repeated = group_runs(runs, suite)
    styles = algorithm_styles(experiments)
    finals, records = _finals(experiments)
    slates, missing = _slates(experiments, styles, seeds_needed)
    robots: dict[str, list[Experiment]] = defaultdict(list)
    for experiment in experiments:
        robots[_robot(experiment)].append(experiment)
    return Report(
        experiments=experiments,
        finals=finals,
        curves={robot: draw_learning_curves(group, styles) for robot, group in robots.items()},
        transfers=[
            (transfer, draw_transfer(transfer, styles))
            for transfer in find_transfers(experiments, runs, suite)
        ],
        slates=slates,
        gaps=missing,
        dominance=dominance_table(records),
        skipped=unreadable | repeated,
    )


def _robot(experiment: Experiment) -> str:
    return Path(str(experiment.runs[0].config["env"].get("robot_base", "robot"))).stem


def _finals(experiments: Sequence[Experiment]) -> tuple[list[Table], list[dict[str, Any]]]:
    """A table per environment, and the records of all."""
    tables, everything = [], []
    for environment in dict.fromkeys(e.environment for e in experiments):
        group = [e for e in experiments if e.environment == environment and e.finished]
        if not group:
            continue
        cost_keys = cost_keys_of(group)
        records = [final_record(experiment, cost_keys) for experiment in group]
        tables.append(final_table(environment, records, cost_keys))
        everything += records
    return tables, everything


def _slates(
    experiments: Sequence[Experiment], styles: Mapping[str, Style], seeds_needed: int
) -> tuple[list[Slate], list[Gap]]:
    """The slates that are complete for an algorithm or more, and what the others lack."""
    usable = [e for e in experiments if can_be_normalised(e)]
    algorithms = list(
        dict.fromkeys(
            e.algorithm for e in experiments if e.benchmark in REFERENCE and not e.is_continued
        )
    )
    slates, missing = [], []
    for name, environments in SLATES.items():
        complete = []
        for algorithm in algorithms:
            gap = find_gap(name, algorithm, experiments, seeds_needed)
            if gap is None:
                complete.append(_aggregate(usable, algorithm, environments))
            else:
                missing.append(gap)
        if complete:
            slates.append(_slate(name, environments, complete, styles))
    shared = tuple(
        name
        for name in REFERENCE
        if algorithms and {e.algorithm for e in usable if e.benchmark == name} == set(algorithms)
    )
    if shared and shared not in [slate.environments for slate in slates]:
        everyone = [_aggregate(usable, algorithm, shared) for algorithm in algorithms]
        slates.append(_slate("shared", shared, everyone, styles))
    return slates, missing


def _aggregate(
    experiments: Sequence[Experiment], algorithm: str, environments: Sequence[str]
) -> Aggregate:
    return aggregate(
        [e for e in experiments if e.algorithm == algorithm and e.benchmark in environments]
    )


def _slate(
    name: str,
    environments: tuple[str, ...],
    aggregates: Sequence[Aggregate],
    styles: Mapping[str, Style],
) -> Slate:
    return Slate(
        name,
        environments,
        slate_table(name, aggregates),
        middle_table(name, aggregates),
        draw_aggregates(aggregates, styles),
    )
