"""The report as files: pictures, tables, Markdown, and one page of HTML that holds everything."""

from __future__ import annotations

import base64
import datetime
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safe_rl.extras import import_extra
from safe_rl.reporting.figures import save
from safe_rl.reporting.inventory import duration, evaluation_table, run_table, videos
from safe_rl.reporting.report import Report
from safe_rl.reporting.slate_tables import gap_table
from safe_rl.reporting.tables import Table

__all__ = ["write_report"]

_MIME_TYPES = {".png": "image/png", ".mp4": "video/mp4"}


@dataclass(frozen=True)
class Media:
    """A picture or a video of the page."""

    caption: str
    path: Path
    notes: Sequence[str] = ()

    @property
    def data(self) -> str:
        """The file as the text of a link, so that the page needs no other file."""
        content = base64.b64encode(self.path.read_bytes()).decode()
        return f"data:{_MIME_TYPES[self.path.suffix]};base64,{content}"


def write_report(report: Report, out: Path, title: str) -> Path:
    """Write everything into a folder.

    Args:
        report: What there is to say.
        out: Folder, made if need be; files of an earlier report in it are replaced.
        title: Heading of the page.

    Returns:
        The page, ``report.html``. Beside it are ``report.md``, a PNG for every figure and a CSV
        for every table.

    Raises:
        ModuleNotFoundError: If Jinja is missing; the message names the extra.
    """
    jinja2 = import_extra("jinja2", "report")
    out.mkdir(parents=True, exist_ok=True)
    context = _context(report, out, title)
    for table in _tables(context):
        table.write_csv(out)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=jinja2.select_autoescape(["html.jinja"]),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["symbols"] = _symbols
    for name in ("report.md", "report.html"):
        text = environment.get_template(f"{name}.jinja").render(context)
        (out / name).write_text(text, encoding="utf-8")
    return out / "report.html"


def _context(report: Report, out: Path, title: str) -> dict[str, Any]:
    """What the templates see."""
    curves = [
        Media(robot.capitalize(), save(figure, out / f"curves_{robot}.png"))
        for robot, figure in report.curves.items()
    ]
    transfers = [
        Media(transfer.title, save(figure, out / f"transfer_{number}.png"), transfer.notes)
        for number, (transfer, figure) in enumerate(report.transfers, start=1)
    ]
    aggregates = {
        slate.name: Media(slate.name, save(slate.figure, out / f"slate_{slate.name}.png"))
        for slate in report.slates
    }
    return {
        "title": title,
        "date": datetime.datetime.now().astimezone().strftime("%d %B %Y, %H:%M"),
        "facts": _facts(report),
        "finals": report.finals,
        "curves": curves,
        "transfers": transfers,
        "slates": report.slates,
        "aggregates": aggregates,
        "gaps": gap_table(report.gaps),
        "lacking": report.lacking(),
        "hardly_begun": report.hardly_begun(),
        "dominance": report.dominance,
        "evaluations": evaluation_table(report.experiments),
        "videos": [Media(caption, path) for caption, path in videos(report.experiments)],
        "runs": run_table(report.experiments),
        "skipped": report.skipped,
    }


def _facts(report: Report) -> dict[str, str]:
    """The page's first lines: name -> number."""
    runs = report.runs
    finished = sum(run.is_finished for run in runs)
    return {
        "runs": str(len(runs)) if finished == len(runs) else f"{finished} of {len(runs)} finished",
        "environments": str(len({e.environment for e in report.experiments})),
        "algorithms": str(len({e.algorithm for e in report.experiments})),
        "environment steps": f"{sum(run.steps for run in runs):,}",
        "training": duration(sum(run.hours for run in runs)),
    }


def _tables(context: Mapping[str, Any]) -> Sequence[Table]:
    single = [context[name] for name in ("gaps", "dominance", "evaluations", "runs")]
    slates = [table for slate in context["slates"] for table in (slate.table, slate.middle)]
    return [*context["finals"], *slates, *single]


def _symbols(text: str) -> Any:
    r"""Symbols as Markdown writes them, ``$\bar J_r$``, in HTML."""
    markupsafe = import_extra("markupsafe", "report")

    def html(match: re.Match[str]) -> str:
        bar, letter, index = match.groups()
        letter = {r"\rho": "ρ"}.get(letter, letter)  # noqa: RUF001
        letter = f'<i class="bar">{letter}</i>' if bar else f"<i>{letter}</i>"
        return letter + (f"<sub>{index}</sub>" if index else "")

    pattern = r"\$(\\bar )?(\\rho|\w)(?:_(\w))?\$"
    return markupsafe.Markup(re.sub(pattern, html, str(markupsafe.escape(text))))
