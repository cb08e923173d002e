"""Drawing of a measure by model and condition, such as readout or training.

Shared by the effects of readout and training and the published results.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from physion.report.figures.theme import LIGHT, Theme, label, panels, style, title

PROTOCOLS = (
    "Training: all scenarios together (all), all but the tested one (all-but), the tested one "
    "alone (only)."
)
"""Sentence of captions about the training protocols."""


def grouped_figure(
    table: pd.DataFrame, measure: str, chance_level: float, theme: Theme = LIGHT
) -> Figure:
    """Draw a measure by model (rows) and condition (marks).

    ``table``: see `figure_tables.GROUPED_COLUMNS`; one panel for each of its ``panel``.
    """
    names = list(table["panel"].unique())
    agents = list(table["agent"].unique())
    with matplotlib.rc_context(style(theme)):
        size = (11 / len(names), (0.34 if len(agents) <= 8 else 0.27) * len(agents) + 0.9)
        figure, axes = panels(len(names), len(names), size, above=0.3, sharex=True, sharey=True)
        for axis, name in zip(axes, names, strict=True):
            rows = table[table["panel"] == name]
            groups = list(rows["group"].unique())
            for place, group in enumerate(groups):
                subset = rows[rows["group"] == group]
                at = subset["agent"].map(agents.index) + (place - (len(groups) - 1) / 2) * 0.24
                _group_marks(axis, subset, at.to_numpy(dtype=np.float64), theme.mark(place), theme)
            axis.axvline(chance_level, color=theme.faint, linestyle=":", linewidth=1, zorder=0)
            people = rows["people"].iloc[0]
            if np.isfinite(people):
                axis.axvline(people, color=theme.ink, linestyle="--", linewidth=1.3, zorder=0)
            title(axis, str(name))
            axis.set_xlabel(measure)
            axis.set_yticks(range(len(agents)), [label(agent) for agent in agents])
            axis.set_ylim(len(agents) - 0.5, -0.5)
            axis.grid(axis="y", color=theme.zone, linewidth=0.5)
            axis.set_axisbelow(True)
            axis.legend(handles=_group_handles(groups, people, theme), loc="lower center",
                        bbox_to_anchor=(0.5, 1.02 + 0.18 / len(agents)), ncols=5, fontsize=8,
                        handletextpad=0.4, columnspacing=1.2)  # fmt: skip
    return figure


def _group_marks(
    axis: Axes, rows: pd.DataFrame, at: Any, mark: tuple[str, str], theme: Theme
) -> None:
    colour, marker = mark
    axis.hlines(at, rows["low"], rows["high"], color=colour, linewidth=1.4)
    axis.plot(rows["value"], at, linestyle="", marker=marker, color=colour, markersize=5.5,
              markeredgecolor=theme.ink, markeredgewidth=0.6)  # fmt: skip


def _group_handles(groups: Sequence[str], people: float, theme: Theme) -> list[Line2D]:
    handles = []
    for place, group in enumerate(groups):
        colour, marker = theme.mark(place)
        handles.append(
            Line2D([], [], color=colour, marker=marker, markeredgecolor=theme.ink, label=group)
        )
    if np.isfinite(people):
        handles.append(Line2D([], [], color=theme.ink, linestyle="--", label="people"))
    return handles
