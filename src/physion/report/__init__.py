"""Tables, figures and one page that compare models with people."""

from physion.report.build import build_report, compare_files
from physion.report.inputs import ReportInputs

__all__ = ["ReportInputs", "build_report", "compare_files"]
