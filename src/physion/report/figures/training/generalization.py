"""Accuracy by the scenario of training and the tested one."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from physion.analysis.models import figure_tables as tables
from physion.report.figures.conditions import PROTOCOLS
from physion.report.figures.registry import TRAINING, register_figure
from physion.report.figures.theme import LIGHT, Plot, Theme, label, panels, style, title
from physion.report.inputs import ReportInputs
from physion.report.words import number


@register_figure("generalization", section=TRAINING, order=50)
def generalization(inputs: ReportInputs) -> Plot | None:
    """Return accuracy by training and tested scenario."""
    if inputs.predictions is None:
        return None
    table = tables.generalization_table(inputs.comparison, inputs.predictions)
    if table.empty:
        return None
    people = inputs.comparison.has_people
    base = "that of people on the same stimuli" if people else "0.5, the accuracy of guessing"
    caption = f"Trained on (rows) and tested on (columns): accuracy less {base}. {PROTOCOLS}"
    return Plot("generalization", caption, table, generalization_figure)


def generalization_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw accuracy less that of people, trained on (rows) x tested on (columns); one panel a
    model.

    ``table``: see `figure_tables.GENERALIZATION_COLUMNS`. Each cell contains its number, so that
    the colours, purple below people and orange above, are not needed in print.
    """
    agents = list(table["agent"].unique())
    trained, tested = (list(table[name].unique()) for name in ("trained", "tested"))
    widest = max(float(table["difference"].abs().max()), 0.01)
    with matplotlib.rc_context(style(theme)):
        size = (0.46 * len(tested) + 1.2, 0.3 * len(trained) + 0.6)
        columns = max(1, min(int(12 / size[0]), 3, len(agents)))
        figure, axes = panels(len(agents), columns, size, above=0.8, sharex=True, sharey=True)
        image = None
        for axis, agent in zip(axes, agents, strict=True):
            grid = table[table["agent"] == agent].pivot(
                index="trained", columns="tested", values="difference"
            )
            values = grid.reindex(index=trained, columns=tested).to_numpy(dtype=np.float64)
            image = axis.imshow(values, cmap="PuOr_r", norm=TwoSlopeNorm(0, -widest, widest),
                                aspect="auto")  # fmt: skip
            _cells(axis, values, widest)
            title(axis, label(agent, 40))
            axis.set_xticks(range(len(tested)), tested, rotation=45, ha="right")
            axis.set_yticks(range(len(trained)), trained)
        figure.supxlabel("tested on", fontsize=10)
        figure.supylabel("trained on", fontsize=10)
        if image is not None:
            base = "that of people" if table["people"].notna().any() else "0.5"
            figure.colorbar(image, ax=axes, label=f"accuracy less {base}", shrink=0.9)
    return figure


def _cells(axis: Axes, values: Any, widest: float) -> None:
    for row, column in np.ndindex(*values.shape):
        value = values[row, column]
        if not np.isfinite(value):
            continue  # this combination was not tested
        # The colour map is light in the middle and dark at its ends in both themes.
        colour = "#ffffff" if abs(value) > 0.6 * widest else "#1b1f24"
        words = number(value) if value < 0.005 else f"+{number(value)}"
        axis.text(column, row, words, ha="center", va="center", color=colour, fontsize=7)
