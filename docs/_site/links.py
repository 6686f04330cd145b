"""Links from pages to files that are not in `docs/`: on GitHub they work as they stand.

On the site every such file has a page that shows it, so that no link leaves the site, and a file
that has gone makes the strict build fail.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

# page of the site -> Markdown, or a notebook, elsewhere in the repository that it shows
PAGES = {
    "benchmarks.md": "benchmarks/README.md",
    "campaigns.md": "results/README.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "first_steps.md": "examples/first_steps.ipynb",
}
_LINK = re.compile(r"(?<=\]\()(?!\w+:|#|/)(?P<path>[^)\s#]+)(?P<rest>#[^)\s]*)?(?=\))")
# in searches, below pages that were written to be read
_BELOW = "---\nsearch:\n  boost: 0.1\n---\n"
_LANGUAGES = {".py": "python", ".yaml": "yaml", ".sh": "bash", ".toml": "toml"}


def linked_files(texts: Mapping[str, str], root: Path) -> dict[str, str]:
    """Pages for the files outside of `docs/` that pages link to.

    Args:
        texts: Page, relative to `docs/` -> its Markdown.
        root: Folder of the repository.

    Returns:
        Page, relative to `docs/` -> its Markdown, for every file that exists.
    """
    targets = {
        _target(match["path"], page) for page, text in texts.items() for match in _links(text)
    }
    shown = {path for path in targets if _is_shown(path, root)}
    folders = {path for path in shown if (root / path).is_dir()}
    shown |= {path for folder in folders for path in _files_in(folder, root)}
    return {
        _page_of(path): _list(path, root) if path in folders else _shown(root / path, path)
        for path in shown
    }


def rewrite(text: str, page: str, root: Path) -> str:
    """The Markdown of a page with its links to files outside of `docs/` led to their pages."""
    here = PurePosixPath("docs", page).parent

    def led(match: re.Match[str]) -> str:
        path = _target(match["path"], page)
        if path in PAGES.values():
            page_of = next(name for name, source in PAGES.items() if source == path)
        elif _is_shown(path, root):
            page_of = _page_of(path)
        elif page in PAGES and path.startswith("docs/"):
            page_of = path.removeprefix("docs/")
        else:
            return match.group()
        return os.path.relpath(f"docs/{page_of}", here) + (match["rest"] or "")

    return _LINK.sub(led, text)


def _links(text: str) -> list[re.Match[str]]:
    return list(_LINK.finditer(text))


def _target(link: str, page: str) -> str:
    """What a link leads to, relative to the repository."""
    source = PAGES.get(page, f"docs/{page}")
    return os.path.normpath(PurePosixPath(source).parent / link)


def _is_shown(path: str, root: Path) -> bool:
    return not path.startswith(("docs/", "..")) and (root / path).exists()


def _files_in(folder: str, root: Path) -> list[str]:
    found = (path for path in sorted((root / folder).rglob("*")) if path.suffix in _LANGUAGES)
    return [path.relative_to(root).as_posix() for path in found]


def _list(folder: str, root: Path) -> str:
    """A page for a folder: its files, each with its page."""
    here = PurePosixPath(_page_of(folder)).parent
    found = _files_in(folder, root)
    lines = [f"- [{path}]({os.path.relpath(_page_of(path), here)})" for path in found]
    return f"{_BELOW}# {folder}\n\n" + "\n".join(lines) + "\n"


def _page_of(path: str) -> str:
    return f"files/{path}.md"


def _shown(file: Path, path: str) -> str:
    language = _LANGUAGES.get(file.suffix, "text")
    return f"{_BELOW}# {path}\n\n````{language}\n{file.read_text()}\n````\n"


def read_page(file: Path) -> str:
    """The Markdown of a file in `PAGES`; of a notebook its text, and its code in blocks."""
    if file.suffix != ".ipynb":
        return file.read_text()
    cells = json.loads(file.read_text())["cells"]
    texts = [("".join(cell["source"]), cell["cell_type"]) for cell in cells]
    return "\n\n".join(
        f"```python\n{text}\n```" if kind == "code" else text for text, kind in texts
    )
