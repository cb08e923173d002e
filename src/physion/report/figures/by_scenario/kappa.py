"""Agreement of models with single participants, by scenario."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from physion.analysis.models import figure_tables as tables
from physion.report.figures.measures import BAND, measure_figure
from physion.report.figures.registry import BY_SCENARIO, register_figure
from physion.report.figures.theme import Plot, Theme
from physion.report.inputs import ReportInputs


@register_figure(
    "kappa", section=BY_SCENARIO, heading="Agreement with single participants", order=30
)
def kappa(inputs: ReportInputs) -> Plot | None:
    """Return Cohen's kappa with participants, by scenario and model."""
    if inputs.beside is None:
        return None
    caption = (
        "Cohen's kappa of a model with each participant, mean over participants; intervals draw "
        "people and stimuli. Dashed: the mean kappa of people with each other; grey: the middle "
        "95 % of participants, each by the mean kappa with the others." + BAND
    )
    table = tables.kappa_table(inputs.comparison, inputs.beside)
    return Plot("kappa", caption, table, draw)


def draw(table: pd.DataFrame, theme: Theme) -> Figure:
    """Draw the table of the figure."""
    return measure_figure(table, "kappa", theme)
