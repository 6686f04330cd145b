"""Reports: figures and tables of a folder of runs, on one page."""

from safe_rl.reporting.page import Look, Report, build_report, write_report

__all__ = ["Look", "Report", "build_report", "write_report"]
