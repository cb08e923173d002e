"""Comparison of models with people: tables in, tables out; no trial is opened."""

from physion.analysis.models.comparison import Comparison, compare
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.predictions import read_predictions
from physion.analysis.tables.responses import read_human_zone, read_humans, read_labels

__all__ = [
    "Bootstrap",
    "Comparison",
    "compare",
    "read_human_zone",
    "read_humans",
    "read_labels",
    "read_predictions",
]
