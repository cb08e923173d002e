"""Comparison of models with people: tables in, tables out; no trial is opened."""

from typing import TYPE_CHECKING, Any

from physion.analysis.comparison import Comparison, compare_scores
from physion.analysis.intervals import Bootstrap
from physion.analysis.tables import read_human_zone, read_humans, read_labels, read_predictions

if TYPE_CHECKING:
    from physion.analysis.compare import ComparisonResults

__all__ = [
    "Bootstrap",
    "Comparison",
    "ComparisonResults",
    "compare_scores",
    "read_human_zone",
    "read_humans",
    "read_labels",
    "read_predictions",
]


def __getattr__(name: str) -> Any:
    """Import what needs the mixed models, which take seconds to import, when it is asked for."""
    if name == "ComparisonResults":
        from physion.analysis.compare import ComparisonResults

        return ComparisonResults
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
