"""P(contact) of models against the fraction of people who say yes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from physion.analysis.models import figure_tables as tables
from physion.analysis.statistics.agreement import pearson
from physion.analysis.tables.stimuli import in_order
from physion.report.figures.registry import BY_STIMULUS, register_figure
from physion.report.figures.theme import LIGHT, Plot, Theme, label, legend, panels, style
from physion.report.inputs import ReportInputs
from physion.report.words import number

SQUARE = 1.16
"""Distance from the left edge of one scenario's square to that of the next; a square is 1 wide."""


@register_figure("scatter", section=BY_STIMULUS, heading="Models against people", order=60)
def scatter(inputs: ReportInputs) -> Plot | None:
    """Return P(contact) against the fraction of people who say yes."""
    comparison, shown = inputs.comparison, inputs.scatter_agents()
    if not comparison.has_people:
        return None
    caption = (
        "P(contact) of each model (rows) against the fraction of people who say yes, by scenario; "
        "one point a stimulus."
    )
    if len(comparison.changed):
        caption += " Hollow: the simulated outcome is not the official one."
    rest = comparison.models[inputs.scatter_limit :]
    if rest:
        caption += f" Not drawn, but in tables/stimuli.csv: {', '.join(map(str, rest))}."
    return Plot("scatter", caption, tables.scatter_table(comparison, shown), scatter_figure)


def scatter_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw P(contact) of each model against the fraction of people who say yes, by stimulus.

    ``table``: see `figure_tables.scatter_table`. A panel a model, in it a square a scenario, so
    that no colour is needed; hollow points are stimuli whose simulated outcome is not the official
    one.
    """
    agents = list(table["agent"].unique())
    scenarios = in_order(table["scenario"])
    columns = max(1, min(4, 8 // len(scenarios)))
    width = 11 / columns
    height = (width - 0.4) / (SQUARE * len(scenarios))
    with matplotlib.rc_context(style(theme)):
        figure, axes = panels(
            len(agents), columns, (width, height + 0.52), above=0.4, sharex=True, sharey=True
        )
        for axis, agent in zip(axes, agents, strict=True):
            _squares(axis, table[table["agent"] == agent], scenarios, theme)
        figure.supxlabel("share of people who say yes", fontsize=10)
        figure.supylabel("P(contact) of the model", fontsize=10)
        if (table["label"] != table["simulated"]).any():
            legend(figure, _scatter_handles(theme), 2)
    return figure


def _squares(axis: Axes, rows: pd.DataFrame, scenarios: Sequence[str], theme: Theme) -> None:
    """Draw the squares of one model next to each other on one axis, which is fast."""
    left = SQUARE * np.arange(len(scenarios))
    frame = np.array([(0, 0), (1, 1), (np.nan, np.nan), (0, 1), (0, 0), (1, 0), (np.nan, np.nan)])
    lines = np.concatenate([frame + np.array([x, 0]) for x in left])
    axis.plot(*lines.T, color=theme.faint, linewidth=0.8, zorder=0)
    x = rows["p_yes"] + rows["scenario"].map(dict(zip(scenarios, left, strict=True)))
    changed = rows["label"] != rows["simulated"]
    for hollow in (False, True):
        if (changed == hollow).any():
            # A line with markers is fast to draw and small in SVG.
            axis.plot(x[changed == hollow], rows["p_contact"][changed == hollow],
                      **_point(hollow, theme))  # fmt: skip
    for index, scenario in zip(left, scenarios, strict=True):
        subset = rows[rows["scenario"] == scenario]
        words = f"{scenario}, {_describe_r(subset['p_contact'], subset['p_yes'])}"
        axis.text(index, 1.05, words, fontsize=7.5, va="bottom")
    pooled = f"{_describe_r(rows['p_contact'], rows['p_yes'])} pooled, {len(rows)} stimuli"
    join = ", " if len(scenarios) > 3 else "\n"
    axis.set_title(f"{label(rows['agent'].iloc[0], 90)}{join}{pooled}", fontsize=8.5, loc="left",
                   pad=15)  # fmt: skip
    axis.set_xlim(-0.04, left[-1] + 1.04)
    axis.set_ylim(-0.04, 1.04)
    axis.set_aspect("equal")
    axis.set_xticks(np.ravel(np.column_stack([left, left + 1])), ["0", "1"] * len(left), fontsize=8)
    axis.set_yticks([0, 0.5, 1])
    axis.spines[["left", "bottom"]].set_visible(False)


def _describe_r(x: pd.Series, y: pd.Series) -> str:
    return f"r = {number(pearson(x, y))}"


def _point(hollow: bool, theme: Theme) -> dict[str, Any]:
    colour = theme.palette[0]
    style_of_point = {"linestyle": "", "marker": "o", "markersize": 3.2, "color": colour}
    if hollow:
        return style_of_point | {"markerfacecolor": "none", "markeredgewidth": 0.9}
    return style_of_point | {"alpha": 0.55, "markeredgewidth": 0}


def _scatter_handles(theme: Theme) -> list[Line2D]:
    names = ("stimulus", "stimulus whose simulated outcome differs")
    return [
        Line2D([], [], label=name, **_point(hollow, theme))
        for name, hollow in zip(names, (False, True), strict=True)
    ]
