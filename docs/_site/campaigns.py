"""What of the campaigns in ``results/`` is done, made from their plans and runs."""

from __future__ import annotations

from pathlib import Path

from safe_rl.reporting.campaigns import campaign_tables
from safe_rl.reporting.recorded import find_runs

RESULTS = Path(__file__).resolve().parents[2] / "results"


def campaigns() -> str:
    """A table per campaign, its note, and the commands of what is missing."""
    runs, _ = find_runs(RESULTS)
    tables, _ = campaign_tables(RESULTS, runs)
    parts = []
    for name, (plan, *commands) in tables.items():
        parts += [f"**{name.replace('_', ' ')}.** {plan.note}", plan.markdown()]
        lines = [record["command"] for table in commands for record in table.records]
        parts += ["```\n" + "\n".join(lines) + "\n```"] if lines else []
    return "\n\n".join(parts)
