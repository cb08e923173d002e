"""Drawing of one measure by panel and model, with intervals, people and their zone.

Shared by accuracy, correlation, kappa, the thirds of stimuli and the published results.
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
from matplotlib.patches import Patch

from physion.analysis.models.figure_tables import ANCHOR, HALVES_ZONE, SCENARIO_ZONE
from physion.analysis.tables.stimuli import MEAN
from physion.report.figures.theme import LIGHT, Theme, label, legend, panels, style, title
from physion.report.words import number

CHANCE = {"accuracy": 0.5, "r": 0.0, "kappa": 0.0}
"""Value of guessing, by measure."""

LABELS = {
    "accuracy": "accuracy",
    "r": "Pearson's r with the average person",
    "kappa": "Cohen's kappa with participants",
}
"""Names on the axis, by measure."""

ANCHOR_MARKER = "d"
"""Mark of anchors; no readout has it."""

RELEASED_ZONES = (SCENARIO_ZONE, HALVES_ZONE)
"""Names of zones; those of the paper are hatched, as they say nothing about participants."""

BAND = (
    " Hatched, in the mean over scenarios: the band of the paper, a bootstrap over the scenario "
    "means, which shows how scenarios differ and not how participants do."
)
"""Sentence of captions about the hatched zone."""


def measure_figure(table: pd.DataFrame, measure: str, theme: Theme = LIGHT) -> Figure:
    """Draw one measure by scenario and model, with intervals, people as a line, their zone as a
    band.

    ``table``: see `figure_tables.MEASURE_COLUMNS`. One panel a scenario and one for the mean; the
    dotted line is chance. Anchors stand below the models, lighter and hollow.
    """
    names = list(table["panel"].unique())
    agents = list(table["agent"].unique())
    readouts = [kind for kind in table["kind"].unique() if kind != ANCHOR]
    kinds = {kind: theme.mark(place) for place, kind in enumerate(readouts)}
    anchors = set(table.loc[table["kind"] == ANCHOR, "agent"])
    kinds |= {ANCHOR: (theme.faint, ANCHOR_MARKER)} if anchors else {}
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
            for text, agent in zip(axis.get_yticklabels(), agents, strict=False):
                text.set_color(theme.faint if agent in anchors else theme.ink)
            if 0 < len(anchors) < len(agents):
                first = len(agents) - len(anchors)
                axis.axhline(first - 0.5, color=theme.zone, linewidth=0.8, zorder=0)
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
        if np.isfinite(row["low"]):
            axis.plot([row["low"], row["high"]], [place, place], color=kinds[row["kind"]][0],
                      linewidth=1.4)  # fmt: skip
        axis.plot(row["value"], place, linestyle="", **_mark(row["kind"], kinds, theme))
        words, anchor = number(row["value"]), row["kind"] == ANCHOR
        axis.text(0.995, place, words, va="center", ha="right", fontsize=7.5,
                  color=theme.faint if anchor else theme.ink,
                  transform=axis.get_yaxis_transform())  # fmt: skip


def _mark(kind: str, kinds: dict[str, tuple[str, str]], theme: Theme) -> dict[str, Any]:
    """Return the properties of a mark; those of anchors are hollow."""
    colour, marker = kinds[kind]
    properties = {"marker": marker, "color": colour, "markersize": 5.5, "markeredgewidth": 0.6}
    if kind == ANCHOR:
        return {**properties, "markerfacecolor": theme.paper, "markeredgewidth": 1.0}
    return {**properties, "markeredgecolor": theme.ink}


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


def _measure_handles(
    table: pd.DataFrame, kinds: dict[str, tuple[str, str]], theme: Theme
) -> list[Any]:
    handles: list[Any] = [
        Line2D([], [], label=kind, **_mark(kind, kinds, theme)) for kind in kinds if kind
    ]
    if table["people"].notna().any():
        words = table.loc[table["people"].notna(), "people_is"].iloc[0]
        handles.append(Line2D([], [], color=theme.ink, linestyle="--", label=words))
    zones = table.loc[table["zone_low"].notna(), "zone"].unique()
    handles += [Patch(**_zone(zone not in RELEASED_ZONES, theme), label=zone) for zone in zones]
    return [*handles, Line2D([], [], color=theme.faint, linestyle=":", label="chance")]
