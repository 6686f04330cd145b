"""A folder of runs as figures, tables and one page."""

from safe_rl.reporting.page import Report, build_report, write_report

__all__ = ["Report", "build_report", "write_report"]
