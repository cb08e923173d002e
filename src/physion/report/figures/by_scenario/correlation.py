"""Correlation of models with the average person, by scenario."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from physion.analysis.models import figure_tables as tables
from physion.report.figures.measures import measure_figure
from physion.report.figures.registry import BY_SCENARIO, register_figure
from physion.report.figures.theme import Plot, Theme
from physion.report.inputs import ReportInputs


@register_figure("r", section=BY_SCENARIO, heading="Correlation with the average person", order=20)
def correlation(inputs: ReportInputs) -> Plot | None:
    """Return Pearson's r with the average person, by scenario and model."""
    if not inputs.comparison.has_people:
        return None
    zones = None if inputs.beside is None else inputs.beside.zones
    caption = (
        "Pearson's r of P(contact) with the fraction of people who say yes, with intervals by "
        "drawing stimuli. Dashed: the noise ceiling, which a model that knows the true fractions "
        "is expected to reach."
    )
    if zones is not None:
        caption += (
            " Grey: the middle 95 % of single participants, each with the average of the others; "
            "they answer yes or no, which lowers r, so that a model can exceed them. Hatched, in "
            "the mean: the band of the paper, r between random halves of the people."
        )
    return Plot("r", caption, tables.r_table(inputs.comparison, zones), draw)


def draw(table: pd.DataFrame, theme: Theme) -> Figure:
    """Draw the table of the figure."""
    return measure_figure(table, "r", theme)
