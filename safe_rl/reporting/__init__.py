"""Reports: figures and tables of a folder of runs, on one page."""

from safe_rl.reporting.page import Report, ReportOptions, build_report, write_report

__all__ = ["Report", "ReportOptions", "build_report", "write_report"]
