"""The report as files: pictures, tables, Markdown, and one page of HTML that holds everything."""

from __future__ import annotations

import base64
import datetime
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from safe_rl.extras import import_extra
from safe_rl.reporting.cleaning import clean
from safe_rl.reporting.columns import SYMBOL, Table, escaped
from safe_rl.reporting.contents import Block, Drawing, Film, Report
from safe_rl.reporting.inventory import duration
from safe_rl.reporting.pictures import save
from safe_rl.runs.files import replace_text

__all__ = ["write_report"]

_MIME_TYPES = {".png": "image/png", ".mp4": "video/mp4"}
# of a film, above which it is named instead of embedded [bytes]
_LARGEST = 50_000_000


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
    place = _places(out)
    context = {
        "title": clean(title),
        "date": datetime.datetime.now().astimezone().strftime("%d %B %Y, %H:%M"),
        "facts": _facts(report),
        "sections": [(s, [_written(b, place) for b in s.blocks]) for s in report.sections],
    }
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=jinja2.select_autoescape(["html.jinja"]),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"symbols": _symbols, "words": _words, "md": _markdown}
    for name in ("report.md", "report.html"):
        text = environment.get_template(f"{name}.jinja").render(context)
        replace_text(out / name, text)
    return out / "report.html"


def _places(out: Path) -> Callable[[str], Path]:
    """Names of files that no other has, also where case is not told apart."""
    taken: set[str] = set()

    def place(name: str) -> Path:
        stem, suffix = re.sub(r"\W+", "_", name.rpartition(".")[0])[:100], Path(name).suffix
        numbered = (f"{stem}{number or ''}{suffix}" for number in range(len(taken) + 1))
        free = next(name for name in numbered if name.lower() not in taken)
        taken.add(free.lower())
        return out / free

    return place


def _written(block: Block, place: Callable[[str], Path]) -> dict[str, Any]:
    """A block as the templates see it; tables and pictures are written on the way."""
    if isinstance(block, Table):
        block.write_csv(place(f"{block.name}.csv"))
        return {"kind": "table", "title": block.title, "table": block}
    if isinstance(block, Drawing):
        path = save(block.figure, place(f"{block.name}.png"))
        return {
            "kind": "picture", "title": block.title, "file": path.name, "data": _embedded(path),
            "says": block.shows,
        }  # fmt: skip
    if isinstance(block, Film):
        data = _embedded(block.path)
        return {"kind": "film", "title": block.title, "file": clean(block.path), "data": data}
    return {"kind": "text", "title": "", "text": block}


def _embedded(path: Path) -> str:
    """A file as the text of a link, so that the page needs no other; "" if it is too big."""
    if path.stat().st_size > _LARGEST:
        return ""
    return f"data:{_MIME_TYPES[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _facts(report: Report) -> dict[str, str]:
    """The page's first lines: name -> number."""
    runs = report.runs
    finished = sum(run.is_finished for run in runs)
    return {
        "runs": str(len(runs)) if finished == len(runs) else f"{finished} of {len(runs)} finished",
        "environments": str(len({e.environment for e in report.experiments})),
        "algorithms": str(len({run.algorithm for run in runs})),
        "experiments": str(len(report.experiments)),
        "environment steps": f"{sum(run.steps for run in runs):,}",
        "training": duration(sum(run.hours for run in runs)),
    }


def _symbols(text: str) -> Any:
    r"""Symbols as Markdown writes them, ``$\bar J_r$``, in HTML."""
    markupsafe = import_extra("markupsafe", "report")

    def html(match: re.Match[str]) -> str:
        bar, letter, index = match.groups()
        letter = {r"\rho": "ρ"}.get(letter, letter)  # noqa: RUF001
        letter = f'<i class="bar">{letter}</i>' if bar else f"<i>{letter}</i>"
        return letter + (f"<sub>{index}</sub>" if index else "")

    return markupsafe.Markup(SYMBOL.sub(html, str(markupsafe.escape(text))))


def _words(text: str) -> str:
    """Symbols as plain letters, for where a page takes no markup: ``J_r``."""
    return SYMBOL.sub(
        lambda match: match.group().strip("$").replace(r"\bar ", "").replace(r"\rho", "ρ"),  # noqa: RUF001
        text,
    )


def _markdown(text: str) -> str:
    return escaped(clean(text, most=10_000))
