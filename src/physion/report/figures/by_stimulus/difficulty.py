"""Accuracy of people by stimulus, with the stimuli that mislead them."""

from __future__ import annotations

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from physion.analysis.models import figure_tables as tables
from physion.analysis.tables.stimuli import in_order
from physion.report.figures.registry import BY_STIMULUS, register_figure
from physion.report.figures.theme import HATCHES, LIGHT, Plot, Theme, legend, panels, style, title
from physion.report.inputs import ReportInputs

BINS = np.linspace(0, 1, 21)
"""Edges of the bars in the distribution of accuracy."""

TAIL = (
    ("not below chance", 0),
    ("below chance by the study's rule alone", 4),
    ("below chance also when corrected", 5),
)
"""Parts of these bars, and their positions in the palette."""


CAPTION = (
    "Accuracy of people by stimulus. The tail: stimuli that people get wrong more often than by "
    "guessing, by the study's rule (accuracy + 1.96 standard errors below 0.5, not corrected for "
    "the number of stimuli), and those that an exact binomial test also finds after correction "
    "(false discovery rate 5 % by Benjamini and Hochberg, all stimuli together)."
)


@register_figure("difficulty", section=BY_STIMULUS, heading="Stimuli that mislead people", order=90)
def difficulty(inputs: ReportInputs) -> Plot | None:
    """Return the distribution of people's accuracy over stimuli."""
    if not inputs.comparison.has_people:
        return None
    by_stimulus = None if inputs.people is None else inputs.people.tables["by_stimulus"]
    table = tables.difficulty_table(inputs.comparison, by_stimulus)
    return Plot("difficulty", CAPTION, table, difficulty_figure)


def difficulty_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw the distribution of people's accuracy over stimuli, by scenario, with the tail below
    chance.

    ``table``: from `difficulty.below_chance_level`.
    """
    scenarios = in_order(table["scenario"])
    with matplotlib.rc_context(style(theme)):
        size = (11 / 4, 2.1)
        figure, axes = panels(len(scenarios), 4, size, above=0.7, sharex=True, sharey=True)
        for axis, scenario in zip(axes, scenarios, strict=True):
            rows = table[table["scenario"] == scenario]
            _tail_bars(axis, rows, theme)
            axis.axvline(0.5, color=theme.ink, linestyle=":", linewidth=1)
            axis.axvline(rows["accuracy"].mean(), color=theme.ink, linestyle="--", linewidth=1.2)
            title(axis, scenario)
            axis.set_xlim(0, 1)
            tail = int((rows["released"] | rows["exact"]).sum())
            axis.text(0.03, 0.95, f"{tail} of {len(rows)}\nbelow chance", fontsize=8, va="top",
                      transform=axis.transAxes)  # fmt: skip
        figure.supxlabel("accuracy of people on a stimulus", fontsize=10)
        figure.supylabel("stimuli", fontsize=10)
        handles: list[Patch | Line2D] = [
            Patch(facecolor=_tail_colour(index, theme), hatch=_tail_hatch(index),
                  edgecolor=theme.paper, label=words)
            for words, index in TAIL
        ]  # fmt: skip
        handles.append(Line2D([], [], color=theme.ink, linestyle="--", label="mean"))
        handles.append(Line2D([], [], color=theme.ink, linestyle=":", label="chance"))
        legend(figure, handles, 5)
    return figure


def _tail_bars(axis: Axes, rows: pd.DataFrame, theme: Theme) -> None:
    """Draw stacked bars; those without height are not drawn."""
    corrected = rows["exact"].to_numpy(dtype=bool)
    alone = rows["released"].to_numpy(dtype=bool) & ~corrected
    below = np.zeros(len(BINS) - 1)
    for (_, index), subset in zip(TAIL, (~(alone | corrected), alone, corrected), strict=True):
        count, _ = np.histogram(rows["accuracy"][subset], BINS)
        some = count > 0
        axis.bar(BINS[:-1][some], count[some], np.diff(BINS)[some], below[some], align="edge",
                 facecolor=_tail_colour(index, theme), edgecolor=theme.paper,
                 hatch=_tail_hatch(index), linewidth=0.6)  # fmt: skip
        below += count


def _tail_colour(index: int, theme: Theme) -> str:
    return theme.palette[index]


def _tail_hatch(index: int) -> str:
    return {0: "", 4: HATCHES[1], 5: HATCHES[3]}[index]
