"""Figures of readout and training: effects on accuracy, and generalisation between scenarios.

`grouped_figure` draws accuracy by model and condition; the published results use it too.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from physion.analysis import figure_tables as tables
from physion.report.figures.theme import (
    LIGHT,
    TRAINING,
    Plot,
    Theme,
    label,
    panels,
    register_figure,
    style,
    title,
)
from physion.report.html import number
from physion.report.inputs import ReportInputs

PROTOCOLS = (
    "Training: all scenarios together (all), all but the tested one (all-but), only the "
    "tested one (only)."
)
"""Sentence of captions about the training protocols."""


def grouped_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw accuracy by model (rows) and condition (marks).

    ``table``: see `figure_tables.GROUPED_COLUMNS`; one panel for each of its ``panel``. A condition
    has the same mark in all panels.
    """
    names, groups = list(table["panel"].unique()), list(table["group"].unique())
    models = list(table["model"].unique())
    with matplotlib.rc_context(style(theme)):
        size = (11 / len(names), (0.34 if len(models) <= 8 else 0.27) * len(models) + 0.9)
        figure, axes = panels(len(names), len(names), size, above=0.3, sharex=True, sharey=True)
        for axis, name in zip(axes, names, strict=True):
            rows = table[table["panel"] == name]
            for place, group in enumerate(groups):
                subset = rows[rows["group"] == group]
                if subset.empty:
                    continue
                at = subset["model"].map(models.index) + (place - (len(groups) - 1) / 2) * 0.24
                _group_marks(axis, subset, at.to_numpy(dtype=np.float64), theme.mark(place), theme)
            axis.axvline(0.5, color=theme.faint, linestyle=":", linewidth=1, zorder=0)
            people = rows["people"].iloc[0]
            if np.isfinite(people):
                axis.axvline(people, color=theme.ink, linestyle="--", linewidth=1.3, zorder=0)
            title(axis, str(name))
            axis.set_xlabel("accuracy")
            axis.set_yticks(range(len(models)), [label(model) for model in models])
            axis.set_ylim(len(models) - 0.5, -0.5)
            axis.grid(axis="y", color=theme.zone, linewidth=0.5)
            axis.set_axisbelow(True)
            handles = _group_handles(groups, set(rows["group"]), people, theme)
            axis.legend(handles=handles, loc="lower center",
                        bbox_to_anchor=(0.5, 1.02 + 0.18 / len(models)), fontsize=8,
                        ncols=5 if len(names) < 3 else 2,
                        handletextpad=0.4, columnspacing=1.2)  # fmt: skip
    return figure


def _group_marks(
    axis: Axes, rows: pd.DataFrame, at: Any, mark: tuple[str, str], theme: Theme
) -> None:
    colour, marker = mark
    axis.hlines(at, rows["low"], rows["high"], color=colour, linewidth=1.4)
    axis.plot(rows["value"], at, linestyle="", marker=marker, color=colour, markersize=5.5,
              markeredgecolor=theme.ink, markeredgewidth=0.6)  # fmt: skip


def _group_handles(
    groups: Sequence[str], shown: Collection[str], people: float, theme: Theme
) -> list[Line2D]:
    handles = []
    for place, group in enumerate(groups):
        if group in shown:
            colour, marker = theme.mark(place)
            handles.append(
                Line2D([], [], color=colour, marker=marker, markeredgecolor=theme.ink, label=group)
            )
    if np.isfinite(people):
        handles.append(Line2D([], [], color=theme.ink, linestyle="--", label="people"))
    return handles


# --- effects on accuracy ------------------------------------------------------------------------


@register_figure("effects", section=TRAINING, order=40)
def effects(inputs: ReportInputs) -> Plot | None:
    """Return accuracy by readout and by training protocol."""
    if inputs.predictions is None:
        return None
    table = tables.effects_table(inputs.comparison, inputs.predictions)
    if table.empty:
        return None
    caption = (
        "Accuracy by readout and by training protocol, mean over scenarios, seeds of "
        "one model averaged; intervals draw stimuli. Readout full sees the whole movie. "
        f"{PROTOCOLS}"
    )
    caption += " Dashed: people." if inputs.comparison.has_people else ""
    return Plot("effects", caption, table, grouped_figure)


# --- accuracy by the scenario of training and the tested one ------------------------------------


@register_figure("generalization", section=TRAINING, order=50)
def generalization(inputs: ReportInputs) -> Plot | None:
    """Return accuracy by training and tested scenario."""
    if inputs.predictions is None:
        return None
    table = tables.generalization_table(inputs.comparison, inputs.predictions)
    if table.empty:
        return None
    people = inputs.comparison.has_people
    base = (
        "the accuracy of people on the same stimuli" if people else "0.5, the accuracy of guessing"
    )
    caption = f"Trained on (rows) and tested on (columns): accuracy less {base}. {PROTOCOLS}"
    return Plot("generalization", caption, table, generalization_figure)


def generalization_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw accuracy minus people's accuracy, trained on (rows) x tested on (columns); one panel per
    model.

    ``table``: see `figure_tables.GENERALIZATION_COLUMNS`. Each cell contains its number, so that
    the colours, purple below people and orange above, are not needed in print.
    """
    models = list(table["model"].unique())
    trained, tested = (list(table[name].unique()) for name in ("trained", "tested"))
    widest = max(float(table["difference"].abs().max()), 0.01)
    with matplotlib.rc_context(style(theme)):
        size = (max(0.46 * len(tested) + 1.2, 3.7), 0.3 * len(trained) + 0.6)  # titles fit
        columns = max(1, min(int(12 / size[0]), 3, len(models)))
        figure, axes = panels(len(models), columns, size, above=0.8, sharex=True, sharey=True)
        image = None
        for axis, model in zip(axes, models, strict=True):
            grid = table[table["model"] == model].pivot(
                index="trained", columns="tested", values="difference"
            )
            values = grid.reindex(index=trained, columns=tested).to_numpy(dtype=np.float64)
            image = axis.imshow(values, cmap="PuOr_r", norm=TwoSlopeNorm(0, -widest, widest),
                                aspect="auto")  # fmt: skip
            _cells(axis, values, widest)
            title(axis, label(model, 40))
            axis.set_xticks(range(len(tested)), tested, rotation=45, ha="right")
            axis.set_yticks(range(len(trained)), trained)
        figure.supxlabel("tested on", fontsize=10)
        figure.supylabel("trained on", fontsize=10)
        if image is not None:
            base = "people's" if table["people"].notna().any() else "0.5"
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
