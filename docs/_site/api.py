"""Pages of the API: one for each package that people import from, by its `__all__`."""

from __future__ import annotations

MODULES = {
    "safe_rl": "In notebooks and scripts",
    "safe_rl.envs": "Environments",
    "safe_rl.envs.extending": "Adding to environments",
    "safe_rl.envs.transforms": "Transforms",
    "safe_rl.envs.velocity": "Velocity limits",
    "safe_rl.objectives": "Losses, advantages, multipliers, limits",
    "safe_rl.objectives.cpo_dual": "CPO's dual",
    "safe_rl.objectives.trust_region": "Trust regions",
    "safe_rl.objectives.fisher": "Fisher-vector products",
    "safe_rl.objectives.risk": "Risk measures",
    "safe_rl.algorithms": "Recipes, updates, steps",
    "safe_rl.models": "Networks",
    "safe_rl.collectors": "Collection and accounting",
    "safe_rl.evaluation": "Evaluation and certificates",
    "safe_rl.scores.certificate": "Claims and their bounds",
    "safe_rl.scores.comparisons": "Intervals",
    "safe_rl.scores.measures": "Normalised scores",
    "safe_rl.reporting": "Reports",
    "safe_rl.runs.table": "Tables of runs",
}
# page -> its name in the navigation
PAGES = {f"api/{module}.md": module for module in MODULES}


def pages() -> dict[str, str]:
    """Page, relative to `docs/` -> its Markdown."""
    made = {page: f"# {module}\n\n::: {module}\n" for page, module in PAGES.items()}
    rows = "".join(f"| [`{m}`]({m}.md) | {what} |\n" for m, what in MODULES.items())
    made["api/index.md"] = (
        "# API\n\nWhat is public, from the docstrings; every example in them is run by a test.\n\n"
        f"| import from | for |\n|---|---|\n{rows}"
    )
    return made
