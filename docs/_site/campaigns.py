"""The campaigns in ``results/``: what of their plans is done, and their report."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from safe_rl.cli.report import ReportOptions
from safe_rl.cli.report import report as write_report
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


@cache
def report() -> str:
    """The page of all campaigns, as ``python -m safe_rl.report results`` writes it."""
    with TemporaryDirectory() as place:
        options = ReportOptions(out=place, title="Campaigns of safe_rl")
        return write_report(RESULTS, options)[1].read_text(encoding="utf-8")
