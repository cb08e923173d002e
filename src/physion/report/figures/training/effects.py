"""Effects of readout and training on accuracy."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from physion.analysis.models import figure_tables as tables
from physion.report.figures.conditions import PROTOCOLS, grouped_figure
from physion.report.figures.registry import TRAINING, register_figure
from physion.report.figures.theme import Plot, Theme
from physion.report.inputs import ReportInputs


@register_figure("effects", section=TRAINING, order=40)
def effects(inputs: ReportInputs) -> Plot | None:
    """Return accuracy by readout and by training protocol."""
    if inputs.predictions is None:
        return None
    table = tables.effects_table(inputs.comparison, inputs.predictions)
    if table.empty:
        return None
    caption = (
        "Accuracy by readout protocol and by training protocol, mean over scenarios, seeds of "
        "one model averaged; intervals draw stimuli. Readout full sees the whole movie. "
        f"{PROTOCOLS}"
    )
    caption += " Dashed: people." if inputs.comparison.has_people else ""
    return Plot("effects", caption, table, draw)


def draw(table: pd.DataFrame, theme: Theme) -> Figure:
    """Draw the table of the figure."""
    return grouped_figure(table, "accuracy", 0.5, theme)
