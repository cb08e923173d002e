"""Correlation with people within hard, chance and easy stimuli."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from physion.analysis.models import figure_tables as tables
from physion.report.figures.measures import measure_figure
from physion.report.figures.registry import BY_STIMULUS, register_figure
from physion.report.figures.theme import Plot, Theme
from physion.report.inputs import ReportInputs


@register_figure("thirds", section=BY_STIMULUS, heading="Hard, chance and easy stimuli", order=70)
def thirds(inputs: ReportInputs) -> Plot | None:
    """Return r within hard, chance and easy stimuli."""
    if not inputs.comparison.has_people:
        return None
    caption = (
        "Pearson's r with the average person within the stimuli on which people are right up to a "
        "third of the time (hard), from two thirds on (easy), and between (chance); all scenarios "
        "pooled, intervals draw stimuli. Within hard and easy stimuli the answers of people nearly "
        "determine the outcome, so a model that is always right has r below 0 in hard ones."
    )
    answers = None if inputs.people is None else inputs.people.kept.test
    if answers is not None:
        caption += (
            " Dashed: mean r between random halves of the people within the same stimuli; grey: "
            "the middle 95 % of these r. A half is a noisier average than all people, with whom "
            "models are correlated."
        )
    table = tables.thirds_table(inputs.comparison, answers)
    return Plot("thirds", f"{caption} Dotted: chance.", table, draw)


def draw(table: pd.DataFrame, theme: Theme) -> Figure:
    """Draw the table of the figure."""
    return measure_figure(table, "r", theme)
