"""Figures of a comparison: the same for colour-blind readers, in print, on white and on dark.

Colours are those of Okabe and Ito; what a colour says, a hatch or the shape of a marker says too.
The bytes depend on the tables and on the version of matplotlib, not on the time or the process.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from physion.analysis.comparison import Comparison
from physion.analysis.tables import MEAN, POOLED, in_order

CHANCE = 0.5


@dataclass(frozen=True)
class Theme:
    """The colours of page and figures: paper, ink, faint lines, the human zone."""

    name: str
    paper: str
    ink: str
    faint: str
    zone: str
    palette: tuple[str, ...]


_OKABE_ITO = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#B8A800")
_BRIGHT = ("#4FA8E0", *_OKABE_ITO[1:4], "#A5DAF5", *_OKABE_ITO[5:])
LIGHT = Theme("light", "#ffffff", "#1b1f24", "#8a9099", "#d9dde3", (*_OKABE_ITO, "#4d4d4d"))
DARK = Theme("dark", "#15181d", "#e6e8eb", "#7d848e", "#3a414b", (*_BRIGHT, "#c9c9c9"))

_READOUTS = ("observed", "observed+simulated", "full")
_HATCHES = ("", "///", "...", "xx", "\\\\\\", "ooo", "++", "--")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")


def accuracy_figure(comparison: Comparison, theme: Theme = LIGHT) -> Figure:
    """Bars: accuracy by scenario and model, interval, people as a dashed line, their zone a band.

    One panel a scenario and one for the mean over scenarios; the dotted line is chance.
    """
    panels = [*in_order(comparison.stimuli["scenario"]), MEAN]
    agents, kinds = comparison.agents, _kinds(comparison)
    columns = min(3, len(panels))
    rows = math.ceil(len(panels) / columns)
    with matplotlib.rc_context(_style(theme)):
        figure = Figure(figsize=(11, rows * (0.3 * len(agents) + 0.75) + 0.9), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, sharex=True)
        for place, axis in enumerate(axes.flat):
            if place >= len(panels):
                axis.set_visible(False)
                continue
            _bars(axis, comparison, panels[place], agents, kinds, theme)
            names = [textwrap.fill(agent, 42) for agent in agents]
            axis.set_yticks(range(len(agents)), names if place % columns == 0 else [])
            axis.tick_params(labelbottom=place + columns >= len(panels))
        figure.supxlabel("accuracy", fontsize=10)
        handles = [
            Patch(facecolor=c, hatch=h, edgecolor=theme.paper, label=k)
            for k, (c, h) in kinds.items()
        ]
        handles += _human_handles(comparison, theme)
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    return figure


def _bars(
    axis: Axes,
    comparison: Comparison,
    panel: str,
    agents: Sequence[str],
    kinds: dict[str, tuple[str, str]],
    theme: Theme,
) -> None:
    scores = comparison.scores[comparison.scores["scenario"] == panel].set_index("agent")
    for place, agent in enumerate(agents):
        if agent not in scores.index:
            axis.text(0.02, place, "no predictions", va="center", fontsize=7, color=theme.faint)
            continue
        row = scores.loc[agent]
        colour, hatch = kinds[row["readout"]]
        axis.barh(place, row["accuracy"], 0.72, color=colour, hatch=hatch, edgecolor=theme.paper)
        low, high = row["accuracy_low"], row["accuracy_high"]
        if np.isfinite(low):
            axis.plot([low, high], [place, place], color=theme.ink, linewidth=1.2)
        # In a column of their own, where neither intervals nor the human line cross them.
        axis.text(1.14, place, f"{row['accuracy']:.2f}", va="center", ha="right", fontsize=8)
    _human_marks(axis, comparison, panel, theme)
    axis.axvline(CHANCE, color=theme.faint, linestyle=":", linewidth=1, zorder=3)
    title = "mean over scenarios" if panel == MEAN else panel
    axis.set_title(title, fontsize=10, fontweight="bold", loc="left")
    axis.set_xlim(0, 1.15)
    axis.set_xticks([0, 0.25, 0.5, 0.75, 1.0])
    axis.set_ylim(len(agents) - 0.4, -0.6)


def _human_marks(axis: Axes, comparison: Comparison, panel: str, theme: Theme) -> None:
    if not comparison.has_people:
        return
    people = comparison.people.set_index("scenario")
    if panel not in people.index:
        return
    row = people.loc[panel]
    if np.isfinite(row["zone_low"]):
        axis.axvspan(row["zone_low"], row["zone_high"], color=theme.zone, linewidth=0, zorder=0)
    axis.axvline(row["accuracy"], color=theme.ink, linestyle="--", linewidth=1.4, zorder=3)


def _human_handles(comparison: Comparison, theme: Theme) -> list[Any]:
    handles: list[Any] = []
    if comparison.has_people:
        handles.append(Line2D([], [], color=theme.ink, linestyle="--", label="people"))
        if comparison.people["zone_low"].notna().any():
            handles.append(Patch(color=theme.zone, label="95 % of participants"))
    return [*handles, Line2D([], [], color=theme.faint, linestyle=":", label="chance")]


def scatter_figure(
    comparison: Comparison, agents: Sequence[str] | None = None, theme: Theme = LIGHT
) -> Figure:
    """Points: P(contact) of each model against the share of people who say yes, by stimulus.

    One panel a model; colour and shape say the scenario; hollow points are stimuli whose simulated
    outcome is not the official one.
    """
    shown = list(comparison.agents if agents is None else agents)
    scenarios = in_order(comparison.stimuli["scenario"])
    columns = min(3, len(shown))
    rows = math.ceil(len(shown) / columns)
    with matplotlib.rc_context(_style(theme)):
        figure = Figure(figsize=(3.65 * max(columns, 2), 3.6 * rows + 0.9), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for place, axis in enumerate(axes.flat):
            if place < len(shown):
                _points(axis, comparison, shown[place], scenarios, theme)
                axis.tick_params(labelbottom=place + columns >= len(shown))
            else:
                axis.set_visible(False)
        figure.supxlabel("share of people who say yes", fontsize=10)
        figure.supylabel("P(contact) of the model", fontsize=10)
        figure.legend(
            handles=_scatter_handles(comparison, scenarios, theme),
            loc="outside upper center",
            ncols=5,
        )
    return figure


def _points(
    axis: Axes, comparison: Comparison, agent: str, scenarios: Sequence[str], theme: Theme
) -> None:
    rows = comparison.stimuli[comparison.stimuli["agent"] == agent]
    axis.plot([0, 1], [0, 1], color=theme.faint, linewidth=1, zorder=0)
    for place, scenario in enumerate(scenarios):
        for hollow in (False, True):
            part = rows[rows["scenario"] == scenario]
            part = part[(part["label"] != part["simulated"]) == hollow]
            colour, marker = _mark(place, theme)
            axis.scatter(
                part["p_yes"],
                part["p_contact"],
                s=16,
                marker=marker,
                facecolors="none" if hollow else colour,
                edgecolors=colour,
                linewidths=0.8 if hollow else 0,
                alpha=0.95 if hollow else 0.65,
            )
    scores = comparison.scores
    r = scores[(scores["agent"] == agent) & (scores["scenario"] == POOLED)]["r"].iloc[0]
    worth = "r undefined" if np.isnan(r) else f"r = {r:.2f} pooled"
    axis.set_title(
        f"{textwrap.fill(agent, 44)}\n{worth}, {len(rows)} stimuli", fontsize=8.5, loc="left"
    )
    axis.set_xlim(-0.03, 1.03)
    axis.set_ylim(-0.03, 1.03)
    axis.set_aspect("equal")
    axis.set_xticks([0, 0.5, 1])
    axis.set_yticks([0, 0.5, 1])


def _scatter_handles(
    comparison: Comparison, scenarios: Sequence[str], theme: Theme
) -> list[Line2D]:
    handles = []
    for place, scenario in enumerate(scenarios):
        colour, marker = _mark(place, theme)
        handles.append(
            Line2D([], [], color=colour, marker=marker, linestyle="", markersize=5, label=scenario)
        )
    if len(comparison.changed):
        hollow = Line2D([], [], color=theme.ink, marker="o", linestyle="", markersize=5)
        hollow.set_markerfacecolor("none")
        hollow.set_label("simulated outcome differs")
        handles.append(hollow)
    return handles


def accuracy_data(comparison: Comparison) -> pd.DataFrame:
    """What the bars show: a row a model and panel, with the human value and zone beside it."""
    columns = ["agent", "scenario", "stimuli", "accuracy", "accuracy_low", "accuracy_high"]
    table = comparison.scores[comparison.scores["scenario"] != POOLED][columns]
    wanted = ["scenario", "accuracy", "zone_low", "zone_high"]
    if not comparison.has_people:
        return table.assign(people_accuracy=np.nan, zone_low=np.nan, zone_high=np.nan)
    people = comparison.people[wanted].rename(columns={"accuracy": "people_accuracy"})
    return table.merge(people, on="scenario", how="left")


def scatter_data(comparison: Comparison) -> pd.DataFrame:
    """What the points show: a row a model and stimulus."""
    columns = ["agent", "scenario", "stimulus", "p_yes", "p_contact", "label", "simulated"]
    return comparison.stimuli[columns].reset_index(drop=True)


def figure_bytes(figure: Figure, kind: str) -> bytes:
    """A figure as ``svg`` or ``png``, without date, program version or random names."""
    metadata: dict[str, None] = {"Date": None} if kind == "svg" else {"Software": None}
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "physion", "svg.fonttype": "path"}):
        figure.savefig(buffer, format=kind, dpi=150, metadata=metadata)
    return buffer.getvalue()


def _kinds(comparison: Comparison) -> dict[str, tuple[str, str]]:
    """Colour and hatch of each readout that occurs."""
    found = list(comparison.scores["readout"].unique())
    names = [name for name in _READOUTS if name in found]
    names += sorted(set(found) - set(names))
    return {
        name: (_OKABE_ITO[place % len(_OKABE_ITO)], _HATCHES[place % len(_HATCHES)])
        for place, name in enumerate(names)
    }


def _mark(place: int, theme: Theme) -> tuple[str, str]:
    return theme.palette[place % len(theme.palette)], _MARKERS[place % len(_MARKERS)]


def _style(theme: Theme) -> Any:
    """Settings for ``rc_context``; its type in matplotlib spells out every key."""
    return {
        "font.family": "DejaVu Sans",
        "font.size": 9,
        "text.color": theme.ink,
        "axes.labelcolor": theme.ink,
        "axes.edgecolor": theme.faint,
        "axes.facecolor": theme.paper,
        "figure.facecolor": theme.paper,
        "savefig.facecolor": theme.paper,
        "xtick.color": theme.ink,
        "ytick.color": theme.ink,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "hatch.linewidth": 0.8,
        # A person's own settings must not change what a report looks like.
        "text.usetex": False,
        "text.parse_math": False,
        "path.simplify": True,
    }
