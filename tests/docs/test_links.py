"""Links between files in Markdown, as they stand on GitHub: every one leads somewhere."""

import re

import pytest
from commands import ROOT

PAGES = sorted(
    path.relative_to(ROOT)
    # not what a report writes below results/
    for folder in (".", "docs/**", "results", "benchmarks", "examples")
    for path in ROOT.glob(f"{folder}/*.md")
)
# a page that only the site has, where the strict build finds it
MADE = "docs/report.html"
# not to other sites
_LINK = re.compile(r"\]\((?!\w+:)([^)\s#]*)(?:#([^)\s]+))?\)")


def headings(text):
    """Anchors of a page's headings, as GitHub makes them."""
    said = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    bare = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title) for title in said)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in bare}


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_links_lead_to_files_and_headings(page):
    text = (ROOT / page).read_text()
    for path, anchor in _LINK.findall(re.sub(r"```.*?```", "", text, flags=re.DOTALL)):
        target = (ROOT / page.parent / path if path else ROOT / page).resolve()
        if not str(target.relative_to(ROOT)).startswith(MADE):
            assert target.exists(), path
        if anchor and target.suffix == ".md":
            assert anchor in headings(target.read_text()), f"{path}#{anchor}"
