"""What MkDocs does for this site beyond Markdown: pages that are made, and links out of `docs/`."""

from __future__ import annotations

from pathlib import Path

import api
import campaigns
import catalogue
import curves
import equations
import links
import navigation
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]


def on_config(config: MkDocsConfig) -> None:
    """Complete the navigation by what is found and made."""
    sections = {name: pages for entry in config.nav or [] for name, pages in entry.items()}
    algorithms = sections["Algorithms"]
    algorithms += navigation.unlisted(algorithms, ROOT / "docs" / "algorithms")
    sections["API"] += [{name: page} for page, name in api.PAGES.items()]


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages that are made, and those of files that pages link to."""
    shown = {page: links.read_page(ROOT / source) for page, source in links.PAGES.items()}
    made = api.pages() | shown
    drawn = {f"algorithms/{algo}.png": picture for algo, picture in curves.pictures().items()}
    for uri, content in (made | drawn | {"report.html": campaigns.report()}).items():
        files.append(File.generated(config, uri, content=content))
    texts = {page.src_uri: page.content_string for page in files.documentation_pages()}
    for uri, text in links.linked_files(texts, ROOT).items():
        page = File.generated(config, uri, content=text, inclusion=InclusionLevel.NOT_IN_NAV)
        files.append(page)


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Put tables in, and lead links to files outside of `docs/` to their pages."""
    return links.rewrite(catalogue.fill(markdown), page.file.src_uri, ROOT)


def on_page_content(content: str, **_: object) -> str:
    """Typeset equations."""
    return equations.typeset(content)
