"""Accuracy of one model against that of people, a point a scenario."""

from __future__ import annotations

import matplotlib
import pandas as pd
from matplotlib.figure import Figure

from physion.analysis.tables.stimuli import MEAN
from physion.report.figures.theme import LIGHT, Theme, label, panels, style

NEAR = (0.04, 0.015)
"""Differences of accuracy below which a name to the right of a point meets the next point."""


def model_and_people_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw the accuracy of people against that of a model by scenario, with the diagonal.

    ``table``: ``model``, ``scenario`` (with the mean, which is hollow), ``accuracy``, ``people``.
    """
    values = table[["accuracy", "people"]]
    low = min(0.5, float(values.min(axis=None)) - 0.02)
    high = min(1.0, float(values.max(axis=None)) + 0.05)
    with matplotlib.rc_context(style(theme)):
        figure, (axis,) = panels(1, 2, (5.5, 4.6), above=0)
        axis.plot([low, high], [low, high], color=theme.faint, linewidth=1, zorder=0)
        for name, x, y in table[["scenario", "accuracy", "people"]].itertuples(index=False):
            mean = name == MEAN
            axis.plot(x, y, marker="o", markersize=7, color=theme.palette[0],
                      markerfacecolor="none" if mean else theme.palette[0])  # fmt: skip
            left = _has_neighbour(table, x, y)
            axis.annotate(name, (x, y), (-6 if left else 6, 4), textcoords="offset points",
                          ha="right" if left else "left", fontsize=8.5)  # fmt: skip
        axis.set_xlim(low, high)
        axis.set_ylim(low, high)
        axis.set_aspect("equal")
        axis.set_xlabel(f"accuracy of {label(str(table['model'].iloc[0]))}")
        axis.set_ylabel("accuracy of people")
    return figure


def _has_neighbour(table: pd.DataFrame, x: float, y: float) -> bool:
    """Return whether another point is so close on the right that names would overlap."""
    ahead = table["accuracy"] - x
    return bool((ahead.between(1e-9, NEAR[0]) & ((table["people"] - y).abs() < NEAR[1])).any())
