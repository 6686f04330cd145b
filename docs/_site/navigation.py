"""Entries of the site's navigation that are found, not written down."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

Entry = str | Mapping[str, str]


def unlisted(listed: Iterable[Entry], folder: Path) -> list[dict[str, str]]:
    """Entries for the pages of a folder that a section of the navigation does not list.

    Args:
        listed: The section as `mkdocs.yml` has it: pages, or titles with their pages.
        folder: A folder directly below `docs/`.

    Returns:
        Title with page, by name; a title is the page's file name and its heading.
    """
    there = {
        page for entry in listed for page in ([entry] if isinstance(entry, str) else entry.values())
    }
    pages = {f"{folder.name}/{path.name}": path for path in sorted(folder.glob("*.md"))}
    return [{_title(path): page} for page, path in pages.items() if page not in there]


def _title(path: Path) -> str:
    heading = re.search(r"^# (.+)$", path.read_text(), re.MULTILINE)
    return f"{path.stem}: {heading[1]}" if heading else path.stem
