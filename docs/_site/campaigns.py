"""The report of the campaigns in ``results/``."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from safe_rl.cli.report import ReportOptions
from safe_rl.cli.report import report as write_report

RESULTS = Path(__file__).resolve().parents[2] / "results"


@cache
def report() -> str:
    """The page of all campaigns, as ``python -m safe_rl.report results`` writes it."""
    with TemporaryDirectory() as place:
        options = ReportOptions(out=place, title="Campaigns of safe_rl")
        return write_report(RESULTS, options)[1].read_text(encoding="utf-8")
