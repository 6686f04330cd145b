"""The sections of a report, and its files: tables, pictures, and one page of HTML."""

from __future__ import annotations

import base64
import datetime
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import chain, count, groupby, starmap
from pathlib import Path
from typing import Annotated, Any

import yaml
from annotated_types import Interval
from pydantic import PositiveInt

from safe_rl.checks import CheckedOptions, option, rule
from safe_rl.extras import import_extra
from safe_rl.files import replace_text
from safe_rl.reporting import run_tables, scoring
from safe_rl.reporting.archive import ReportedRun, read_runs
from safe_rl.reporting.curves import benchmark_figures, curve_rows, curves_of_experiments
from safe_rl.reporting.experiments import Experiment, group_runs
from safe_rl.reporting.figures import WIDTH, Drawing, algorithm_styles, fronts
from safe_rl.reporting.tables import Table, clean
from safe_rl.runs.curves import save_figure
from safe_rl.scores.benchmark import SEEDS, Suite

_FOLDER = Path(__file__).parent
_SECTIONS = yaml.safe_load((_FOLDER / "texts.yaml").read_text(encoding="utf-8"))
_SYMBOL = re.compile(r"\$(\\bar )?(\\rho|\w)(?:_(\w))?\$")  # such as $\bar J_r$
_FORMATS = rule(
    lambda text: {*listed(text)} <= {"png", "svg", "pdf"}, "one or more of png, svg, pdf"
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
    width: Annotated[float, Interval(ge=2, le=40)] = option(WIDTH, "of the pictures [inch]")
    labels: dict[str, str] = option(dict, "names to show, such as \"{cpo: 'CPO (ours)'}\"")


def listed(text: str | None) -> list[str]:
    """The parts of an option's text, which commas separate."""
    return list(filter(None, map(str.strip, (text or "").split(","))))


Block = Table | Drawing


@dataclass(frozen=True)
class Report:
    """The contents of a report on a folder of runs.

    Attributes:
        experiments: The runs in groups.
        sections: Name of a section in ``texts.yaml`` -> its tables and pictures; none is empty.
        skipped: Folder or file -> the reason why it is left out.
    """

    experiments: Sequence[Experiment]
    sections: Mapping[str, Sequence[Block]]
    skipped: Mapping[Path, str]

    @property
    def runs(self) -> list[ReportedRun]:
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
    runs, skipped = _find_all(root, options)
    algorithms, width = listed(options.algos), options.width
    known = sorted({run.algorithm for run in runs})
    for name in algorithms:
        if name not in known:
            raise ValueError(f"algos={name}: there are runs of {', '.join(map(clean, known))}.")
    chosen = [run for run in runs if run.algorithm in (algorithms or known)]
    experiments, repeated = group_runs(chosen, suite, options.labels)
    skipped |= repeated
    styles = algorithm_styles(experiments)
    finished = [e for e in experiments if e.finished]
    groups = groupby(finished, key=lambda e: e.environment)
    finals = [scoring.final_table([*group]) for _, group in groups]
    records = chain(*(table.records for table in finals))
    slates = scoring.complete_slates(experiments, options.seeds)
    reasons = [{"what": clean(path), "why": clean(why, 500)} for path, why in skipped.items()]
    left_out = Table("left_out", "Left out", {"what": "{what}", "why": "{why}"}, reasons)
    curves = curves_of_experiments(experiments, styles, width)
    blocks: dict[str, list[Any]] = {
        "final": finals,
        "curves": [*benchmark_figures(experiments, width), *curves],
        "fronts": fronts(zip(finished, records, strict=True), styles, width),
        "normalised": [*starmap(scoring.slate_table, slates), scoring.paper_table(experiments)],
        "certificates": [run_tables.certificate_table(experiments)],
        "evaluations": [run_tables.evaluation_table(experiments)],
        "runs": [run_tables.run_table(experiments), left_out],
    }
    # tables without rows are left out
    shown = {n: [b for b in bs if isinstance(b, Drawing) or b.records] for n, bs in blocks.items()}
    return Report(experiments, {name: bs for name, bs in shown.items() if bs}, skipped)


def _name_among(place: Path, others: Collection[Path]) -> str:
    """The shortest end of a folder's path that is not the end of another folder's."""
    ends = (place.parts[-length:] for length in range(1, len(place.parts)))
    alone = (e for e in ends if not any(o.parts[-len(e) :] == e for o in others if o != place))
    return str(Path(*next(alone, place.parts)))


def _find_all(root: Path, options: ReportOptions) -> tuple[list[ReportedRun], dict[Path, str]]:
    """The runs below a folder and finished ones of baselines; and what is left out."""
    runs, skipped = read_runs(root, unfinished=options.unfinished)
    own = {run.environment for run in runs}
    places = [Path(place).expanduser().resolve() for place in listed(options.baselines)]
    for place in places:
        found, missed = read_runs(place)
        added = [run for run in found if run.environment in own and run.is_finished]
        for run in added:
            run.source = clean(_name_among(place, places), 80)
        if not added:
            missed[place] = "no baselines: it has no finished run on an environment of these runs"
        runs, skipped = [*runs, *added], skipped | missed
    return runs, skipped


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
    tables = [b for blocks in report.sections.values() for b in blocks if isinstance(b, Table)]
    out.mkdir(parents=True, exist_ok=True)
    replace_text(out / "tables.tex", "\n".join(table.latex() for table in tables))
    curves = Table("curves", "Learning curves", {}, curve_rows(report.experiments))
    curves.write_csv(out / "curves.csv")
    names: set[str] = set()
    template = jinja2.Template(
        (_FOLDER / "report.html.jinja").read_text(encoding="utf-8"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = template.render(
        title=clean(title),
        date=datetime.datetime.now().astimezone().strftime("%d %B %Y, %H:%M"),
        facts=_facts(report),
        symbols=_symbols,
        sections=[
            (name, _SECTIONS[name], [(b, _write(b, out, names, options)) for b in blocks])
            for name, blocks in report.sections.items()
        ],
    )
    replace_text(out / "report.html", page)
    return out / "report.html"


def _write(block: Block, out: Path, names: set[str], options: ReportOptions) -> str:
    """Write the files of a block under a new name; return a picture's PNG in base64, or ""."""
    stem = re.sub(r"\W+", "_", block.name).strip("_")[:100]
    name = next(n for i in count() if (n := f"{stem}{i or ''}") not in names)
    names.add(name)
    if isinstance(block, Table):
        block.write_csv(out / f"{name}.csv")
        return ""
    # the page needs PNG; always first, as saving a figure moves its layout a little
    for form in dict.fromkeys(["png", *listed(options.formats)]):
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
