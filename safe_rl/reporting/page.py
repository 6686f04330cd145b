"""The sections of a report, and its files: tables, pictures, and one page of HTML."""

from __future__ import annotations

import base64
import datetime
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from itertools import chain, count, groupby, starmap
from pathlib import Path
from typing import Annotated, NamedTuple

import yaml
from annotated_types import Interval
from matplotlib.figure import Figure
from pydantic import PositiveInt

from safe_rl.checks import CheckedOptions, option, rule
from safe_rl.extras import import_extra
from safe_rl.files import replace_text
from safe_rl.reporting import figures, run_tables, scoring
from safe_rl.reporting.archive import Run, find_runs
from safe_rl.reporting.curves import (
    comparable,
    curve_rows,
    draw_benchmark,
    draw_learning_curves,
)
from safe_rl.reporting.experiments import Experiment, group_runs
from safe_rl.reporting.tables import Table, clean, short_number
from safe_rl.runs.curves import save_figure
from safe_rl.scores.benchmark import SEEDS, SLATES, Suite

_MOST_ROWS = 6  # of a picture of learning curves, so that it fits on a printed page
_MOST_CURVES = 6  # in one panel
_FEWEST_ENVIRONMENTS = 3  # of the benchmark, with which its figures are drawn
_TEXTS = yaml.safe_load(files(__package__).joinpath("texts.yaml").read_text(encoding="utf-8"))
_SYMBOL = re.compile(r"\$(\\bar )?(\\rho|\w)(?:_(\w))?\$")  # such as $\bar J_r$


FORMATS = ("png", "svg", "pdf")
_FORMATS = rule(
    lambda text: set(listed(text)) <= set(FORMATS), f"one or more of {', '.join(FORMATS)}"
)


@dataclass
class ReportOptions(CheckedOptions):
    """Options of ``safe-rl report``; their help texts describe them."""

    out: str | None = option(None, "folder of the report; null: RUNS_DIR/report")
    seeds: PositiveInt = option(len(SEEDS), "finished runs per environment that a slate needs")
    algos: str | None = option(None, "algorithms, also of baselines, such as cpo,ppo; null: all")
    baselines: str | None = option(
        None, "other runs to put beside these: archives or folders, such as results/held_out"
    )
    unfinished: bool = option(False, "include unfinished runs in scores")
    archive: str | None = option(None, "campaign archive to add the runs to; null: none")
    title: str | None = option(None, "heading; null: the folder's name")
    formats: Annotated[str, _FORMATS] = option("png", "of the pictures, such as png,svg,pdf")
    width: Annotated[float, Interval(ge=2, le=40)] = option(figures.WIDTH, "of the pictures [inch]")
    labels: dict[str, str] = option(dict, "names to show, such as \"{cpo: 'CPO (ours)'}\"")


def listed(text: str | None) -> list[str]:
    """The parts of an option's text, which commas separate."""
    return list(filter(None, map(str.strip, (text or "").split(","))))


class Drawing(NamedTuple):
    """A picture: stem of its file, heading, figure, and alternative text."""

    name: str
    title: str
    figure: Figure
    shows: str


Block = Table | Drawing
Styles = Mapping[str, figures.Style]


class Section(NamedTuple):
    """A part of the report: its key in ``texts.yaml``, its heading, its tables and pictures."""

    name: str
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Report:
    """The contents of a report on a folder of runs.

    Attributes:
        experiments: The runs in groups.
        sections: The sections of the page; none is empty.
        skipped: Folder or file -> the reason why it is left out.
    """

    experiments: Sequence[Experiment]
    sections: Sequence[Section]
    skipped: Mapping[Path, str]

    @property
    def runs(self) -> list[Run]:
        """All runs of the report, without baselines."""
        runs = [run for experiment in self.experiments for run in experiment.runs]
        return [run for run in runs if not run.source]


def build_report(root: Path, suite: Suite, options: ReportOptions) -> Report:
    """Find the runs below a folder, and make the sections of a report.

    Baselines are put beside these runs where they have the same environments; they keep the name of
    their folder.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If one of the algorithms has no run.
    """
    runs, skipped = find_runs(root, unfinished=options.unfinished)
    own = {run.environment for run in runs}
    places = [Path(place).expanduser().resolve() for place in listed(options.baselines)]
    for place in places:
        added, missed = _baselines(place, own, _name_among(place, places))
        runs, skipped = [*runs, *added], skipped | missed
    algorithms, width = listed(options.algos), options.width
    known = sorted({run.algorithm for run in runs})
    for name in algorithms:
        if name not in known:
            raise ValueError(f"algos={name}: there are runs of {', '.join(map(clean, known))}.")
    chosen = [run for run in runs if run.algorithm in (algorithms or known)]
    experiments, repeated = group_runs(chosen, suite, options.labels)
    skipped |= repeated
    styles = figures.algorithm_styles(experiments)
    groups = _by_environment([e for e in experiments if e.finished])
    finals = [scoring.final_table(group) for group in groups]
    curves = [*benchmark_figures(experiments, width), *_curves(experiments, styles, width)]
    complete = scoring.complete_slates(experiments, options.seeds)
    normalised = [*starmap(scoring.slate_table, complete), scoring.paper_table(experiments)]
    reasons = [{"what": clean(path), "why": clean(why, 500)} for path, why in skipped.items()]
    left_out = Table("left_out", "Left out", {"what": "{what}", "why": "{why}"}, reasons)
    sections = [
        Section("final", "Final scores", finals),
        Section("curves", "Learning curves", curves),
        Section("fronts", "Return against cost", _fronts(groups, finals, styles, width)),
        Section("normalised", "Normalised scores", normalised),
        Section("certificates", "Certificates", [run_tables.certificate_table(experiments)]),
        Section("evaluations", "Evaluations", [run_tables.evaluation_table(experiments)]),
        Section("runs", "Runs", [run_tables.run_table(experiments), left_out]),
    ]
    # tables without rows are left out
    shown = [(s, [b for b in s.blocks if not isinstance(b, Table) or b.records]) for s in sections]
    sections = [section._replace(blocks=blocks) for section, blocks in shown if blocks]
    return Report(experiments, sections, skipped)


def _name_among(place: Path, others: Collection[Path]) -> str:
    """The shortest end of a folder's path that is not the end of another folder's."""
    ends = (place.parts[-length:] for length in range(1, len(place.parts)))
    alone = (e for e in ends if not any(o.parts[-len(e) :] == e for o in others if o != place))
    return str(Path(*next(alone, place.parts)))


def _baselines(
    place: Path, environments: Collection[str], name: str
) -> tuple[list[Run], dict[Path, str]]:
    """Finished runs of another folder in some environments, and what is left out."""
    found, skipped = find_runs(place)
    runs = [run for run in found if run.environment in environments and run.is_finished]
    for run in runs:
        run.source = clean(name, 80)
    if not runs:
        skipped[place] = "no baselines: it has no finished run on an environment of these runs"
    return runs, skipped


def _by_environment(experiments: Sequence[Experiment]) -> list[list[Experiment]]:
    return [list(members) for _, members in groupby(experiments, key=lambda e: e.environment)]


def _fronts(
    groups: Sequence[Sequence[Experiment]], finals: Sequence[Table], styles: Styles, width: float
) -> list[Drawing]:
    panels = figures.compared(zip(chain(*groups), chain(*(t.records for t in finals)), strict=True))
    if not panels:
        return []
    texts = [f"{what}: {', '.join(e.algorithm for e, _ in m)}" for what, m in panels.items()]
    says = f"Final return against final episode cost. {'; '.join(texts)}"
    return [Drawing("fronts", "", figures.draw_fronts(panels, styles, width), says)]


def benchmark_figures(experiments: Sequence[Experiment], width: float) -> list[Drawing]:
    """The paper's Figures 7 to 9, of robots with runs; none if there are runs on few environments.

    Environments without runs are shown as missing.
    """
    robots = {"Point": 7, "Car": 8, "Doggo": 9}
    by_robot = {robot: comparable(experiments, SLATES[f"SG{robot}"]) for robot in robots}
    if len({e.benchmark for members in by_robot.values() for e in members}) < _FEWEST_ENVIRONMENTS:
        return []
    return [
        Drawing(
            f"figure_{robots[robot]}",
            f"The paper's Figure {robots[robot]}, from runs of "
            f"{short_number(members[0].planned_steps)} steps",
            draw_benchmark(members, SLATES[f"SG{robot}"], width),
            "Return, episode cost and cost rate of the paper's algorithms, a column for each of "
            f"{robot}'s environments",
        )
        for robot, members in by_robot.items()
        if members
    ]


def _curves(experiments: Sequence[Experiment], styles: Styles, width: float) -> list[Drawing]:
    """Pictures with a row per environment; one with many curves is shared out among pictures."""
    rows, pictures = [], []
    for group in _by_environment(experiments):
        for steps in sorted({e.planned_steps for e in group}):
            members = [e for e in group if e.planned_steps == steps]
            if len(members) <= _MOST_CURVES:
                rows.append(members)
            else:
                starts = range(0, len(members), _MOST_CURVES)
                pictures += [members[n : n + _MOST_CURVES] for n in starts]
    pictures += [[*chain(*rows[n : n + _MOST_ROWS])] for n in range(0, len(rows), _MOST_ROWS)]
    drawings = []
    for members in pictures:
        names = ", ".join(dict.fromkeys(e.environment for e in members))
        algorithms = ", ".join(dict.fromkeys(e.label for e in members))
        figure = draw_learning_curves(members, styles, width)
        says = f"Return, episode cost and cost rate over environment steps: {names}; {algorithms}"
        drawings.append(Drawing("curves", "", figure, says))
    return drawings


def write_report(report: Report, out: Path, title: str, options: ReportOptions) -> Path:
    """Write a report into a folder: a page, pictures, tables as CSV and all of them in LaTeX.

    ``curves.csv`` has the points of all learning curves, a row for each.

    Args:
        report: The content.
        out: The folder; it is made if it does not exist, and files of an earlier report are
            replaced.
        title: Heading of the page.
        options: How it is written.

    Returns:
        Path of the page, ``report.html``.

    Raises:
        ModuleNotFoundError: If Jinja is missing; the message names the extra.
    """
    jinja2 = import_extra("jinja2", "report")
    tables = [b for s in report.sections for b in s.blocks if isinstance(b, Table)]
    out.mkdir(parents=True, exist_ok=True)
    replace_text(out / "tables.tex", "\n".join(table.latex() for table in tables))
    curves = Table("curves", "Learning curves", {}, curve_rows(report.experiments))
    curves.write_csv(out / "curves.csv")
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["symbols"] = _symbols
    names: set[str] = set()
    text = environment.get_template("report.html.jinja").render(
        title=clean(title),
        date=datetime.datetime.now().astimezone().strftime("%d %B %Y, %H:%M"),
        facts=_facts(report),
        texts=_TEXTS,
        sections=[
            (s, [(b, _write(b, out, names, options)) for b in s.blocks]) for s in report.sections
        ],
    )
    replace_text(out / "report.html", text)
    return out / "report.html"


def _write(block: Block, out: Path, names: set[str], options: ReportOptions) -> str:
    """Write the files of a block under a new name; return a picture's PNG in base64, or ""."""
    stem = re.sub(r"\W+", "_", block.name).strip("_")[:100]
    name = next(n for i in count() if (n := f"{stem}{i or ''}") not in names)
    names.add(name)
    if isinstance(block, Table):
        block.write_csv(out / f"{name}.csv")
        return ""
    for form in {*listed(options.formats), "png"}:  # the page needs PNG
        save_figure(block.figure, out / f"{name}.{form}")
    return base64.b64encode((out / f"{name}.png").read_bytes()).decode()


def _facts(report: Report) -> dict[str, str]:
    runs = report.runs
    finished = sum(run.is_finished for run in runs)
    return {
        "runs": str(len(runs)) if finished == len(runs) else f"{finished} of {len(runs)} finished",
        "environments": str(len({e.environment for e in report.experiments})),
        "algorithms": str(len({run.algorithm for run in runs})),
        "experiments": str(len(report.experiments)),
        "environment steps": f"{sum(run.steps for run in runs):,}",
        "training": run_tables.duration(sum(run.hours for run in runs)),
    }


def _symbols(text: str) -> str:
    r"""A text with symbols such as ``$\bar J_r$`` as HTML."""

    def letters(match: re.Match[str]) -> str:
        bar, letter, index = match.groups()
        sign = letter.replace(r"\rho", "&rho;")
        shown = f'<i class="bar">{sign}</i>' if bar else f"<i>{sign}</i>"
        return shown + (f"<sub>{index}</sub>" if index else "")

    return _SYMBOL.sub(letters, escape(text))
