"""Report a folder of runs: ``safe-rl report RUNS_DIR [seeds=3 title=...]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Interval
from pydantic import PositiveInt

from safe_rl.checks import rule
from safe_rl.cli.options import run_command
from safe_rl.cli.user_code import import_modules
from safe_rl.envs import SUITE, env_node, resolve
from safe_rl.evaluation.settings import option
from safe_rl.files import check_place, printable
from safe_rl.reporting import Look, Report, build_report, write_report
from safe_rl.reporting.archive import archive_runs
from safe_rl.reporting.tables import clean
from safe_rl.scores.benchmark import SEEDS, Suite

FORMATS = ("png", "svg", "pdf")
_FORMATS = rule(
    lambda text: set(_listed(text)) <= set(FORMATS), f"one or more of {', '.join(FORMATS)}"
)


def _listed(text: str | None) -> list[str]:
    """Parts of a text that commas separate."""
    return list(filter(None, map(str.strip, (text or "").split(","))))


@dataclass
class ReportOptions:
    """Options of ``safe-rl report``; their help texts describe them."""

    out: str | None = option(None, "folder of the report; null: RUNS_DIR/report")
    seeds: PositiveInt = option(len(SEEDS), "finished runs per environment that a slate needs")
    algos: str | None = option(None, "algorithms to report, such as cpo,ppo_lagrangian; null: all")
    baselines: str | None = option(
        None, "other runs to put beside these: archives or folders, such as results/held_out"
    )
    unfinished: bool = option(False, "include unfinished runs in scores")
    archive: str | None = option(None, "campaign archive to add the runs to; null: none")
    title: str | None = option(None, "heading; null: the folder's name")
    formats: Annotated[str, _FORMATS] = option("png", "of the pictures, such as png,svg,pdf")
    width: Annotated[float, Interval(ge=2, le=40)] = option(12.0, "of the pictures [inch]")
    panels: bool = option(False, "write every panel of a picture to a file of its own, too")
    labels: dict[str, str] = option(dict, "names to show, such as '{cpo: CPO (ours)}'")
    columns: str | None = option(None, "columns of tables.tex, such as algorithm,J_r,J_c")


def suite() -> Suite:
    """All environments of the suite, every key of each."""
    nodes = {name: env_node(name) for name in SUITE}
    return Suite(nodes, env_node(resolve({})))


def report(root: Path, options: ReportOptions) -> tuple[Report, Path]:
    """Report the runs below a folder; return the content of the report, and its page.

    Raises:
        FileNotFoundError: If there is no run.
        OSError: If the page cannot be written; this is checked before any run is read.
        ValueError: If an option cannot have its value; if RUNS_DIR/report is a link, because
            another person could have chosen what it overwrites.
    """
    out = root / "report" if options.out is None else Path(options.out).expanduser()
    if options.out is None and out.is_symlink():
        raise ValueError(f"{out} is a link: remove it, or give out=FOLDER.")
    if root.is_dir():
        check_place(out / "report.html", "out=FOLDER writes the report elsewhere.")
    look = Look(
        formats=_listed(options.formats),
        width=options.width,
        panels=options.panels,
        labels=options.labels,
        columns=_listed(options.columns),
    )
    result = build_report(
        root,
        suite(),
        seeds_needed=options.seeds,
        unfinished=options.unfinished,
        algorithms=_listed(options.algos),
        baselines=[Path(place).expanduser() for place in _listed(options.baselines)],
        look=look,
    )
    page = write_report(result, out, options.title or root.resolve().name, look)
    if options.archive is not None:
        archive_runs(result.runs, root, Path(options.archive).expanduser())
    return result, page


def main(arguments: Sequence[str] | None = None, program: str = "safe-rl report") -> int:
    """Run the command; return its exit status."""
    return run_command(carry_out, arguments, f"{program} RUNS_DIR", ReportOptions)


def carry_out(words: list[str], options: ReportOptions, modules: list[str] | None) -> int:
    """Report the runs below a folder, the first word, and print what was left out."""
    import_modules(modules)
    root = Path(words[0])
    result, page = report(root, options)
    if options.archive is not None:
        print(f"kept {len(result.runs)} runs in {options.archive}")
    for path, reason in result.skipped.items():
        print(f"left out {clean(path)}: {printable(reason)}", file=sys.stderr)
    print(f"wrote {page}")
    return 0
