"""Report of a comparison: tables, figures and one page."""

from physion.report.build import build_report, compare_files
from physion.report.inputs import ReportInputs

__all__ = ["ReportInputs", "build_report", "compare_files"]
