"""Report of a comparison: tables, figures and one page."""

from physion.report.build import build_report
from physion.report.compare import CompareResult
from physion.report.inputs import ReportInputs

__all__ = ["CompareResult", "ReportInputs", "build_report"]
