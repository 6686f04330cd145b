"""What MkDocs does for this site beyond Markdown: pages that are made, and links out of `docs/`."""

from __future__ import annotations

import re
from pathlib import Path

import equations
import links
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]


def on_config(config: MkDocsConfig) -> None:
    """Complete the navigation by the algorithms' pages, each by its heading, and the API."""
    sections = {name: pages for entry in config.nav or [] for name, pages in entry.items()}
    for path in sorted((ROOT / "docs" / "algorithms").glob("*.md")):
        if f"algorithms/{path.name}" not in str(sections["Algorithms"]):
            heading = re.search(r"^# (.+)$", path.read_text(), re.M)[1]  # type: ignore[index]
            sections["Algorithms"].append({f"{path.stem}: {heading}": f"algorithms/{path.name}"})
    sections["API"] += [{module: f"api/{module}.md"} for module in links.API]


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages of the API, and those of files elsewhere."""
    rows = "".join(f"| [`{m}`]({m}.md) | {what} |\n" for m, what in links.API.items())
    made = {"api/index.md": f"# API\n\n| import from | for |\n|---|---|\n{rows}"}
    made |= {f"api/{module}.md": f"# {module}\n\n::: {module}\n" for module in links.API}
    made |= {page: links.read_page(ROOT / source) for page, source in links.PAGES.items()}
    for uri, content in made.items():
        files.append(File.generated(config, uri, content=content))


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Lead links to files outside of `docs/` to their pages."""
    return links.rewrite(markdown, page.file.src_uri, ROOT)


def on_page_content(content: str, **_: object) -> str:
    """Typeset equations."""
    return equations.typeset(content)
