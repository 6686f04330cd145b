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
# packages that people import from: each has a page, by its `__all__`
API = {
    "safe_rl": "In notebooks and scripts",
    "safe_rl.envs": "Environments",
    "safe_rl.envs.extending": "Adding to environments",
    "safe_rl.envs.transforms": "Transforms",
    "safe_rl.envs.velocity": "Velocity limits",
    "safe_rl.objectives": "Losses, advantages, multipliers, limits",
    "safe_rl.objectives.cpo_dual": "CPO's dual",
    "safe_rl.objectives.trust_region": "Trust regions, Fisher-vector products",
    "safe_rl.objectives.risk": "Risk measures",
    "safe_rl.algorithms": "Algorithms, updates, steps",
    "safe_rl.models": "Networks",
    "safe_rl.collectors": "Collection and accounting",
    "safe_rl.evaluation": "Evaluation and certificates",
    "safe_rl.scores.certificate": "Claims and their bounds",
    "safe_rl.scores.comparisons": "Intervals",
    "safe_rl.reporting": "Reports",
    "safe_rl.runs.table": "Tables of runs",
}
_LINK = re.compile(r"\[(?P<text>[^\]]*)\]\((?!\w+:|#|/)(?P<path>[^)\s#]+)(?P<rest>#[^)\s]*)?\)")


def rewrite(text: str, page: str, root: Path) -> str:
    """The Markdown of a page, which is relative to ``docs/``, as the site shows it."""
    source = PurePosixPath(PAGES.get(page, f"docs/{page}"))
    page_of = {source: name for name, source in PAGES.items()}

    def led(match: re.Match[str]) -> str:
        path = os.path.normpath(source.parent / match["path"])
        module = path.removesuffix(".py").replace("/", ".")
        target = page_of.get(path, f"api/{module}.md" if module in API else None)
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
