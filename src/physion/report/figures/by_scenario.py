"""Drawings of models and people: measures by scenario, effects by condition, generalization.

Every function draws its table and nothing else; `figure_tables` makes the tables.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from physion.analysis.models.figure_tables import HALVES_ZONE, SCENARIO_ZONE
from physion.analysis.tables.stimuli import MEAN
from physion.report.figures.theme import LIGHT, Theme, legend, panels, style, title
from physion.report.words import number, protocol_names


def label(agent: str, width: int = 48) -> str:
    """Return the name of a model for an axis, as on the page, broken into lines."""
    return textwrap.fill(protocol_names(str(agent)), width)


CHANCE = {"accuracy": 0.5, "r": 0.0, "kappa": 0.0}
"""Value of guessing, by measure."""

LABELS = {
    "accuracy": "accuracy",
    "r": "Pearson's r with the average person",
    "kappa": "Cohen's kappa with participants",
}


def measure_figure(table: pd.DataFrame, measure: str, theme: Theme = LIGHT) -> Figure:
    """Draw one measure by scenario and model, with intervals, people as a line, their zone as a
    band.

    ``table``: see `figure_tables.MEASURE_COLUMNS`. One panel a scenario and one for the mean; the
    dotted line is chance.
    """
    names = list(table["panel"].unique())
    agents = list(table["agent"].unique())
    kinds = {kind: theme.mark(place) for place, kind in enumerate(table["kind"].unique())}
    row_height = 0.3 if len(agents) <= 8 else 0.2
    low, high = _limits(table, CHANCE[measure])
    with matplotlib.rc_context(style(theme)):
        size = (11 / min(3, len(names)), row_height * len(agents) + 0.75)
        figure, axes = panels(len(names), min(3, len(names)), size, sharex=True)
        for place, (axis, name) in enumerate(zip(axes, names, strict=True)):
            rows = table[table["panel"] == name].set_index("agent")
            _human_marks(axis, rows, theme)
            _dots(axis, rows, agents, kinds, theme, high)
            axis.axvline(CHANCE[measure], color=theme.faint, linestyle=":", linewidth=1, zorder=1)
            title(axis, "mean over scenarios" if name == MEAN else str(name))
            labels = [label(agent, 48) for agent in agents]
            small = 9 if row_height == 0.3 else 8
            axis.set_yticks(range(len(agents)), labels if place % 3 == 0 else [], fontsize=small)
            # No ticks here: they would look like labels of the values in the panel to the left.
            axis.tick_params(axis="y", left=place % 3 == 0)
            axis.set_ylim(len(agents) - 0.4, -0.6)
            # Space on the right for the column of values.
            axis.set_xlim(low, high + 0.16 * (high - low))
        figure.supxlabel(LABELS[measure], fontsize=10)
        legend(figure, _measure_handles(table, kinds, theme), 4)
        figure.set_layout_engine("constrained", wspace=0.05, w_pad=0.1)
    return figure


def _limits(table: pd.DataFrame, chance_level: float) -> tuple[float, float]:
    columns = ["value", "low", "high", "people", "zone_low", "zone_high"]
    values = table[columns].to_numpy(dtype=np.float64)
    values = np.append(values[np.isfinite(values)], chance_level)
    margin = 0.03 * (values.max() - values.min() + 0.1)
    return float(values.min() - margin), float(values.max() + margin)


def _dots(
    axis: Axes,
    rows: pd.DataFrame,
    agents: Sequence[str],
    kinds: dict[str, tuple[str, str]],
    theme: Theme,
    high: float,
) -> None:
    for place, agent in enumerate(agents):
        if agent not in rows.index:
            axis.text(0.5, place, "no predictions", va="center", ha="center", fontsize=7,
                      color=theme.faint, transform=axis.get_yaxis_transform())  # fmt: skip
            continue
        row = rows.loc[agent]
        colour, marker = kinds[row["kind"]]
        if np.isfinite(row["low"]):
            axis.plot([row["low"], row["high"]], [place, place], color=colour, linewidth=1.4)
        axis.plot(row["value"], place, marker=marker, color=colour, markersize=5.5,
                  markeredgecolor=theme.ink, markeredgewidth=0.6, linestyle="")  # fmt: skip
        words = number(row["value"])
        axis.text(0.995, place, words, va="center", ha="right", fontsize=7.5,
                  transform=axis.get_yaxis_transform())  # fmt: skip


def _human_marks(axis: Axes, rows: pd.DataFrame, theme: Theme) -> None:
    subset = rows.iloc[0]
    if np.isfinite(subset["zone_low"]):
        # Zones that are not of participants are hatched.
        plain = subset["zone"] not in RELEASED_ZONES
        axis.axvspan(subset["zone_low"], subset["zone_high"], **_zone(plain, theme), zorder=0)
    if np.isfinite(subset["people"]):
        axis.axvline(subset["people"], color=theme.ink, linestyle="--", linewidth=1.3, zorder=1)


def _zone(plain: bool, theme: Theme) -> dict[str, Any]:
    if plain:
        return {"facecolor": theme.zone, "linewidth": 0}
    return {"facecolor": "none", "edgecolor": theme.faint, "hatch": "/////", "linewidth": 0}


RELEASED_ZONES = (SCENARIO_ZONE, HALVES_ZONE)
"""Names of zones; those of the paper are hatched, as they say nothing about participants."""


def _measure_handles(
    table: pd.DataFrame, kinds: dict[str, tuple[str, str]], theme: Theme
) -> list[Any]:
    handles: list[Any] = [
        Line2D([], [], color=colour, marker=marker, markeredgecolor=theme.ink, label=kind)
        for kind, (colour, marker) in kinds.items()
        if kind
    ]
    if table["people"].notna().any():
        words = table.loc[table["people"].notna(), "people_is"].iloc[0]
        handles.append(Line2D([], [], color=theme.ink, linestyle="--", label=words))
    zones = table.loc[table["zone_low"].notna(), "zone"].unique()
    handles += [Patch(**_zone(zone not in RELEASED_ZONES, theme), label=zone) for zone in zones]
    return [*handles, Line2D([], [], color=theme.faint, linestyle=":", label="chance")]


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
