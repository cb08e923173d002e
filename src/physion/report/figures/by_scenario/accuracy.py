"""Accuracy by scenario and model."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from physion.analysis.models import figure_tables as tables
from physion.report.figures.measures import BAND, measure_figure
from physion.report.figures.registry import BY_SCENARIO, register_figure
from physion.report.figures.theme import Plot, Theme
from physion.report.inputs import ReportInputs


@register_figure("accuracy", section=BY_SCENARIO, heading="Accuracy", order=10)
def accuracy(inputs: ReportInputs) -> Plot:
    """Return accuracy by scenario and model."""
    comparison = inputs.comparison
    caption = "Fraction of answers that equal the official outcome, with 95 % intervals."
    if comparison.has_people:
        caption += " Dashed: people on the stimuli that any model predicts."
        if comparison.people["zone_low"].notna().any():
            caption += " Grey: the middle 95 % of participants."
        caption += BAND
    table = tables.accuracy_table(comparison)
    return Plot("accuracy", f"{caption} Dotted: chance.", table, draw)


def draw(table: pd.DataFrame, theme: Theme) -> Figure:
    """Draw the table of the figure."""
    return measure_figure(table, "accuracy", theme)
