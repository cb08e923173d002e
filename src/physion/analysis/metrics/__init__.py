"""Metrics: one registry, and a module for each kind of number in the order of the tables."""

from physion.analysis.metrics import (
    accuracy,
    average_person,
    beyond_outcome,
    participants,
    signal_detection,
)
from physion.analysis.metrics.registry import (
    Metric,
    all_metrics,
    measure_metrics,
    metrics,
    register_metric,
    score_metrics,
)

__all__ = [
    "Metric",
    "accuracy",
    "all_metrics",
    "average_person",
    "beyond_outcome",
    "measure_metrics",
    "metrics",
    "participants",
    "register_metric",
    "score_metrics",
    "signal_detection",
]
