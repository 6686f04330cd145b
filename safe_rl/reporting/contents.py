"""Everything a report says, in the order in which it says it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import yaml
from matplotlib.figure import Figure

from safe_rl.reporting.campaigns import campaign_tables
from safe_rl.reporting.cleaning import clean
from safe_rl.reporting.columns import Column, Record, Table
from safe_rl.reporting.experiments import Experiment, group_runs
from safe_rl.reporting.fronts import compared, draw_fronts
from safe_rl.reporting.inventory import (
    certificate_table,
    evaluation_table,
    run_table,
    variant_table,
    videos,
)
from safe_rl.reporting.lacking import lacking_table, missing_seeds
from safe_rl.reporting.origins import Origin, find_origins
from safe_rl.reporting.pictures import Style, algorithm_styles, draw_learning_curves
from safe_rl.reporting.recorded import Run, find_runs
from safe_rl.reporting.scoring import dominance_table, final_table, learning_table
from safe_rl.reporting.slate_pictures import draw_middles, draw_profiles
from safe_rl.reporting.slate_scores import (
    Aggregate,
    aggregate,
    by_length,
    can_be_normalised,
    improvement_table,
    middle_table,
    slate_table,
    title_of,
)
from safe_rl.reporting.transfers import draw_transfer, find_transfers
from safe_rl.scores.benchmark import Suite
from safe_rl.scores.published import REFERENCE
from safe_rl.scores.slates import SLATES

__all__ = ["Block", "Drawing", "Film", "Report", "Section", "build_report"]

# rows of a picture of learning curves, in environments: what a printed page holds
_MOST_ROWS = 6
_TEXTS = yaml.safe_load(files(__package__).joinpath("texts.yaml").read_text(encoding="utf-8"))


class Drawing(NamedTuple):
    """A picture: stem of its file, heading, and what it shows, for those who cannot see it."""

    name: str
    title: str
    figure: Figure
    shows: str


class Film(NamedTuple):
    """A video, and its caption."""

    title: str
    path: Path


Block = Table | Drawing | Film | str


class Section(NamedTuple):
    """A part of the report: its key in ``texts.yaml``, its heading, what is in it."""

    name: str
    title: str
    blocks: Sequence[Block]

    @property
    def text(self) -> str:
        """What a reader has to know."""
        return _TEXTS.get(self.name, "")


@dataclass(frozen=True)
class Report:
    """The contents of a report on a folder of runs.

    Attributes:
        experiments: Runs, grouped.
        sections: What is said of them; none is empty.
        lacking: Which runs slates still lack.
        campaigns: Name -> tables of what was planned, and what of it is done.
        skipped: Folder or file -> why it was left out.
    """

    experiments: Sequence[Experiment]
    sections: Sequence[Section]
    lacking: Table
    campaigns: Mapping[str, Sequence[Table]]
    skipped: Mapping[Path, str]

    @property
    def runs(self) -> list[Run]:
        """All runs in it."""
        return [run for experiment in self.experiments for run in experiment.runs]


def build_report(
    root: Path, suite: Suite, *, seeds_needed: int, unfinished: bool, good: float = 0.5
) -> Report:
    """Find the runs below a folder and put everything together.

    Args:
        root: The folder.
        suite: The benchmark.
        seeds_needed: Finished runs that a slate takes per environment.
        unfinished: Whether unfinished runs count as finished ones.
        good: Share of a return that a good policy has, see
            :func:`safe_rl.reporting.scoring.learning_table`.

    Raises:
        FileNotFoundError: If there is no run.
    """
    runs, skipped = find_runs(root, unfinished=unfinished)
    origins = find_origins(runs)
    experiments, repeated = group_runs(runs, suite, origins, root)
    campaigns, no_plans = campaign_tables(root, runs)
    skipped |= repeated | no_plans
    styles = algorithm_styles(experiments)
    groups = _by_environment(e for e in experiments if e.finished)
    finals = [final_table(group) for group in groups]
    records = [record for table in finals for record in table.records]
    lacking = lacking_table(experiments, seeds_needed)
    learning = [learning_table(group, good) for group in groups]
    sections = [
        Section("final", "Final scores", finals or ["No run is finished."]),
        Section("learning", "What learning cost", list(filter(None, learning))),
        Section("curves", "Learning curves", _curves(experiments, styles)),
        Section("fronts", "Return against cost", _fronts(records, styles)),
        Section("transfer", "Transfer", _transfers(experiments, origins, styles)),
        Section(
            "normalised",
            "Normalised scores",
            [*_slates(experiments, styles, seeds_needed), *_if_any(lacking)],
        ),
        Section("dominance", "Which is better", _if_any(dominance_table(records))),
        Section("certificates", "Certificates", _if_any(certificate_table(experiments))),
        Section("evaluations", "Evaluations", _if_any(evaluation_table(experiments))),
        Section("videos", "Videos", [Film(clean(c), path) for c, path in videos(experiments)]),
        Section("campaigns", "Campaigns", [t for own in campaigns.values() for t in own]),
        Section(
            "runs",
            "Runs",
            [
                run_table(experiments),
                *_if_any(variant_table(experiments)),
                *_if_any(_left_out(skipped)),
            ],
        ),
    ]
    return Report(experiments, [s for s in sections if s.blocks], lacking, campaigns, skipped)


def _if_any(table: Table) -> list[Table]:
    return [table] if table.records else []


def _left_out(skipped: Mapping[Path, str]) -> Table:
    records = [{"what": clean(path), "why": clean(why, 500)} for path, why in skipped.items()]
    columns = [Column(name) for name in ("what", "why")]
    return Table("left_out", "Left out", columns, records)


def _by_environment(experiments: Iterable[Experiment]) -> list[list[Experiment]]:
    groups: dict[str, list[Experiment]] = defaultdict(list)
    for experiment in experiments:
        groups[experiment.environment].append(experiment)
    return list(groups.values())


def _fronts(records: Sequence[Record], styles: Mapping[str, Style]) -> list[Drawing]:
    groups = compared(records)
    if not groups:
        return []
    panels = [f"{what}: {', '.join(r['algorithm'] for r in own)}" for what, own in groups.items()]
    says = f"Final return against final episode cost. {'; '.join(panels)}"
    return [Drawing("fronts", "", draw_fronts(records, styles), says)]


def _curves(experiments: Sequence[Experiment], styles: Mapping[str, Style]) -> list[Drawing]:
    """A picture per robot, where environments have one; several if it would get too long."""
    robots: dict[str, list[list[Experiment]]] = defaultdict(list)
    for group in _by_environment(experiments):
        robot = Path(str(group[0].runs[0].config["env"].get("robot_base", "other"))).stem
        robots[clean(robot, 40)].append(group)
    drawings = []
    for robot, groups in robots.items():
        for start in range(0, len(groups), _MOST_ROWS):
            shown = groups[start : start + _MOST_ROWS]
            names = ", ".join(group[0].environment for group in shown)
            says = f"Return, episode cost and cost rate over environment steps: {names}"
            figure = draw_learning_curves([e for group in shown for e in group], styles)
            drawings.append(Drawing(f"curves_{robot}", "", figure, says))
    return drawings


def _transfers(
    experiments: Sequence[Experiment],
    origins: Mapping[Path, Origin],
    styles: Mapping[str, Style],
) -> list[Block]:
    blocks: list[Block] = []
    for number, transfer in enumerate(find_transfers(experiments, origins), start=1):
        says = f"Return, episode cost and cost rate of both phases, {transfer.title}"
        figure = draw_transfer(transfer, styles)
        blocks += [Drawing(f"transfer_{number}", transfer.title, figure, says), *transfer.notes]
    return blocks


def _slates(
    experiments: Sequence[Experiment], styles: Mapping[str, Style], seeds_needed: int
) -> list[Block]:
    """The slates that are complete for an algorithm or more, and what all have in common."""
    begun = [e for e in experiments if e.benchmark in REFERENCE and not e.is_continued]
    algorithms = list(dict.fromkeys(e.algorithm for e in begun))
    usable = [e for e in experiments if can_be_normalised(e)]
    shared = tuple(
        name
        for name in REFERENCE
        if algorithms and {e.algorithm for e in usable if e.benchmark == name} == set(algorithms)
    )
    complete = {
        (name, slate): [
            a for a in algorithms if not missing_seeds(name, a, experiments, seeds_needed)
        ]
        for name, slate in SLATES.items()
    }
    if shared not in [slate for (_, slate), members in complete.items() if members]:
        complete["shared", shared] = algorithms if shared else []
    blocks: list[Block] = []
    for (name, slate), members in complete.items():
        aggregates = [
            aggregate([e for e in usable if e.algorithm == a and e.benchmark in slate])
            for a in members
        ]
        if aggregates:
            blocks.append(slate_table(name, slate, aggregates))
            for after, group in by_length(aggregates).items():
                blocks += _middles_and_profiles(name, group, after, styles)
            blocks += _if_any(improvement_table(name, aggregates))
    return blocks


def _middles_and_profiles(
    slate: str, aggregates: Sequence[Aggregate], after: str, styles: Mapping[str, Style]
) -> list[Block]:
    """What can be seen of a slate's runs as a whole, of algorithms that were trained equally long.

    A single run has no middle and no profile, and of what has finished no episode there is none to
    draw.
    """
    if max(one.num_runs for one in aggregates) == 1:
        return []
    middle = middle_table(slate, aggregates, after)
    if not any(one.is_measured for one in aggregates):
        return [middle]
    iqm, profiles = draw_middles(middle.records, styles), draw_profiles(aggregates, styles)
    says = ", ".join([title_of(slate) + after, *(one.algorithm for one in aggregates)])
    return [
        middle,
        Drawing(f"slate_{slate}", "", iqm, f"Interquartile means with 95 % intervals: {says}"),
        Drawing(f"profiles_{slate}", "", profiles, f"Share of runs above every score: {says}"),
    ]
