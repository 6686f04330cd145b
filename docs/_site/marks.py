"""What pages ask for: tables, between `<!-- made: name words -->` and `<!-- end -->`.

``python docs/_site/marks.py`` writes all of them again, from the program and from ``results/``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import environment_tables
import result_tables

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "algorithms"
_MARK = re.compile(
    r"(<!-- made: (\w+) ?([^\n]*?) -->\n)(?:(?!<!-- made).)*?(<!-- end -->\n)", re.DOTALL
)
_HEAD = "| `algo=` | problem it solves | policy step | source |\n|---|---|---|---|"


def listed(kind: str) -> str:
    """Problem, policy step and source of the algorithms of a kind, as their pages say."""
    rows = []
    for page in sorted(PAGES.glob("*.md")):
        short = re.search(r"^<!-- row: (.*) -->$", text := page.read_text(), re.M)
        source = re.search(r"^\[`algo=\w+`\]\(\S+\) · (.*)$", text, re.M)
        has_buffer = re.search("Groups of .*`memory`", text) is not None
        if short and source and has_buffer == (kind == "OffPolicy"):
            rows.append(f"| [`{page.stem}`]({page.name}) | {short[1]} | {source[1]} |")
    return "\n".join([_HEAD, *rows])


_ALL = (listed, *environment_tables.TABLES, *result_tables.TABLES)
TABLES: dict[str, Callable[..., str]] = {table.__name__: table for table in _ALL}


def fill(page: str) -> str:
    """The text of a page with the tables that it asks for; KeyError if there is no such table."""

    def made(match: re.Match[str]) -> str:
        return f"{match[1]}\n{TABLES[match[2]](*filter(None, [match[3]]))}\n\n{match[4]}"

    return _MARK.sub(made, page)


if __name__ == "__main__":
    for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        path.write_text(fill(path.read_text()))
