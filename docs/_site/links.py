"""Links from pages to files outside of `docs/`: on GitHub they work as they stand.

On the site some of these files are pages, too (`PAGES`). Of the others the site shows the name
only; a link to a file that has gone stays as it is, so that the strict build fails.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path, PurePosixPath

# page of the site -> Markdown, or a notebook, elsewhere in the repository that it shows
PAGES = {
    "benchmarks.md": "benchmarks/README.md",
    "campaigns.md": "results/README.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "first_steps.md": "examples/first_steps.ipynb",
}
_LINK = re.compile(r"\[(?P<text>[^\]]*)\]\((?!\w+:|#|/)(?P<path>[^)\s#]+)(?P<rest>#[^)\s]*)?\)")


def rewrite(text: str, page: str, root: Path) -> str:
    """The Markdown of a page, which is relative to ``docs/``, as the site shows it."""
    source = PurePosixPath(PAGES.get(page, f"docs/{page}"))
    page_of = {source: name for name, source in PAGES.items()}

    def led(match: re.Match[str]) -> str:
        path = os.path.normpath(source.parent / match["path"])
        target = page_of.get(path)
        if page in PAGES and path.startswith("docs/"):
            target = path.removeprefix("docs/")
        if target is not None:
            there = os.path.relpath(f"docs/{target}", PurePosixPath("docs", page).parent)
            return f"[{match['text']}]({there}{match['rest'] or ''})"
        is_outside = not path.startswith(("docs/", "..")) and (root / path).exists()
        return match["text"] if is_outside else match.group()

    return _LINK.sub(led, text)


def read_page(file: Path) -> str:
    """The Markdown of a file in `PAGES`; of a notebook its text, and its code in blocks."""
    if file.suffix != ".ipynb":
        return file.read_text()
    cells = json.loads(file.read_text())["cells"]
    texts = [("".join(cell["source"]), cell["cell_type"]) for cell in cells]
    return "\n\n".join(
        f"```python\n{text}\n```" if kind == "code" else text for text, kind in texts
    )
