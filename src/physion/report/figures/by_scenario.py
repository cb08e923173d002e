"""Figures by scenario: accuracy, r, kappa, error of imagined motion, a model against people.

`measure_figure` draws one measure by panel and model, with intervals, people and their zone; the
thirds of stimuli and the published results use it too.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from physion.analysis import figure_tables as tables
from physion.analysis.figure_tables import BASELINE, HALVES_ZONE, SCENARIO_ZONE
from physion.analysis.rollout_errors import CONSTANT_VELOCITY
from physion.analysis.tables import MEAN
from physion.report.figures.theme import (
    BY_SCENARIO,
    LIGHT,
    Plot,
    Theme,
    label,
    legend,
    panels,
    register_figure,
    style,
    title,
)
from physion.report.html import number
from physion.report.inputs import ReportInputs

CHANCE = {"accuracy": 0.5, "r": 0.0, "kappa": 0.0}
"""Value of guessing, by measure."""

LABELS = {
    "accuracy": "accuracy",
    "r": "Pearson's r with the average person",
    "kappa": "Cohen's kappa with participants",
}
"""Names on the axis, by measure."""

BASELINE_MARKER = "d"
"""Mark of baselines; no readout has it."""

RELEASED_ZONES = (SCENARIO_ZONE, HALVES_ZONE)
"""Names of zones; the paper's are hatched, as they say nothing about participants."""

BAND = (
    " Hatched, in the mean over scenarios: the band of the paper, a bootstrap over the scenario "
    "means, which shows how scenarios differ and not how participants do."
)
"""Sentence of captions about the hatched zone."""


def measure_figure(table: pd.DataFrame, theme: Theme = LIGHT, *, measure: str) -> Figure:
    """Draw one measure by scenario and model, with intervals, people as a line, their zone as a
    band.

    ``table``: see `figure_tables.MEASURE_COLUMNS`. One panel per scenario and one for the mean; the
    dotted line is chance. Baselines stand below the models, lighter and hollow.
    """
    names = list(table["panel"].unique())
    models = list(table["model"].unique())
    readouts = [kind for kind in table["kind"].unique() if kind != BASELINE]
    kinds = {kind: theme.mark(place) for place, kind in enumerate(readouts)}
    baselines = set(table.loc[table["kind"] == BASELINE, "model"])
    kinds |= {BASELINE: (theme.faint, BASELINE_MARKER)} if baselines else {}
    row_height = 0.3 if len(models) <= 8 else 0.2
    low, high = _limits(table, CHANCE[measure])
    with matplotlib.rc_context(style(theme)):
        size = (11 / min(3, len(names)), row_height * len(models) + 0.75)
        figure, axes = panels(len(names), min(3, len(names)), size, sharex=True)
        for place, (axis, name) in enumerate(zip(axes, names, strict=True)):
            rows = table[table["panel"] == name].set_index("model")
            _human_marks(axis, rows, theme)
            _dots(axis, rows, models, kinds, theme, high)
            axis.axvline(CHANCE[measure], color=theme.faint, linestyle=":", linewidth=1, zorder=1)
            title(axis, "mean over scenarios" if name == MEAN else str(name))
            labels = [label(model, 48) for model in models]
            small = 9 if row_height == 0.3 else 8
            axis.set_yticks(range(len(models)), labels if place % 3 == 0 else [], fontsize=small)
            for text, model in zip(axis.get_yticklabels(), models, strict=False):
                text.set_color(theme.faint if model in baselines else theme.ink)
            if 0 < len(baselines) < len(models):
                first = len(models) - len(baselines)
                axis.axhline(first - 0.5, color=theme.zone, linewidth=0.8, zorder=0)
            # No ticks here: they would look like labels of the values in the panel to the left.
            axis.tick_params(axis="y", left=place % 3 == 0)
            axis.set_ylim(len(models) - 0.4, -0.6)
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
    models: Sequence[str],
    kinds: dict[str, tuple[str, str]],
    theme: Theme,
    high: float,
) -> None:
    for place, model in enumerate(models):
        if model not in rows.index:
            axis.text(0.5, place, "no predictions", va="center", ha="center", fontsize=7,
                      color=theme.faint, transform=axis.get_yaxis_transform())  # fmt: skip
            continue
        row = rows.loc[model]
        if np.isfinite(row["low"]):
            axis.plot([row["low"], row["high"]], [place, place], color=kinds[row["kind"]][0],
                      linewidth=1.4)  # fmt: skip
        axis.plot(row["value"], place, linestyle="", **_mark(row["kind"], kinds, theme))
        words, baseline = number(row["value"]), row["kind"] == BASELINE
        axis.text(0.995, place, words, va="center", ha="right", fontsize=7.5,
                  color=theme.faint if baseline else theme.ink,
                  transform=axis.get_yaxis_transform())  # fmt: skip


def _mark(kind: str, kinds: dict[str, tuple[str, str]], theme: Theme) -> dict[str, Any]:
    """Return the properties of a mark; marks of baselines are hollow."""
    colour, marker = kinds[kind]
    properties = {"marker": marker, "color": colour, "markersize": 5.5, "markeredgewidth": 0.6}
    if kind == BASELINE:
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


# --- accuracy -----------------------------------------------------------------------------------


@register_figure("accuracy", section=BY_SCENARIO, heading="Accuracy", order=10)
def accuracy(inputs: ReportInputs) -> Plot:
    """Return accuracy by scenario and model."""
    comparison = inputs.comparison
    caption = "Fraction of answers that equal the official outcome, with 95 % intervals."
    if comparison.has_people:
        caption += " Dashed: people on the stimuli that any model predicts."
        if comparison.people["zone_low"].notna().any():
            caption += " Grey: the middle 95 % of participants."
        caption += BAND
    table = tables.accuracy_table(comparison)
    draw = partial(measure_figure, measure="accuracy")
    return Plot("accuracy", f"{caption} Dotted: chance.", table, draw)


# --- correlation with the average person --------------------------------------------------------


@register_figure("r", section=BY_SCENARIO, heading="Correlation with the average person", order=20)
def correlation(inputs: ReportInputs) -> Plot | None:
    """Return Pearson's r with the average person, by scenario and model."""
    if not inputs.comparison.has_people:
        return None
    zones = None if inputs.with_people is None else inputs.with_people.zones
    caption = (
        "Pearson's r of P(contact) with the fraction of people who say yes, with intervals by "
        "drawing stimuli. Dashed: the noise ceiling, which a model that knows the true fractions "
        "is expected to reach."
    )
    if zones is not None:
        caption += (
            " Grey: the middle 95 % of r between random halves of the people, as in the paper; "
            "hatched, in the mean: the mean of its bounds over scenarios. Single participants, "
            "each with the average of the others, reach less, as they answer only yes or no: see "
            "tables/zones.csv."
        )
    table = tables.r_table(inputs.comparison, zones)
    return Plot("r", caption, table, partial(measure_figure, measure="r"))


# --- agreement with single participants ---------------------------------------------------------


@register_figure(
    "kappa", section=BY_SCENARIO, heading="Agreement with single participants", order=30
)
def kappa(inputs: ReportInputs) -> Plot | None:
    """Return Cohen's kappa with participants, by scenario and model."""
    if inputs.with_people is None:
        return None
    caption = (
        "Cohen's kappa of a model with each participant, mean over participants; intervals draw "
        "people and stimuli. Dashed: the mean kappa of people with each other; grey: the middle "
        "95 % of participants, each by the mean kappa with the others." + BAND
    )
    table = tables.kappa_table(inputs.comparison, inputs.with_people)
    return Plot("kappa", caption, table, partial(measure_figure, measure="kappa"))


# --- error of imagined motion over time ---------------------------------------------------------

_DASHES = ("-", (0, (6, 1.5)), "-.", (0, (1, 1)))
"""Lines of models, so that they differ without colour."""


@register_figure("rollout_error", section=BY_SCENARIO, heading="Error of imagined motion", order=35)
def rollout_error(inputs: ReportInputs) -> Plot | None:
    """Return the error of rollouts over time by scenario and model."""
    table = inputs.rollout_errors
    if table is None or table.empty:
        return None
    caption = (
        "Distance of the centres of objects between imagined and true motion, mean over objects "
        "and trials, over the time after the last observed frame. Bands: 95 % intervals, "
        f"which draw trials. Dotted: {CONSTANT_VELOCITY} from the last two observed steps, cut off "
        "where it leaves the panel. The panels have different scales."
    )
    return Plot("rollout_error", caption, table, draw_rollout_error)


def draw_rollout_error(table: pd.DataFrame, theme: Theme) -> Figure:
    """Draw curves with bands, one panel per scenario; ``table``: see `rollout_errors.COLUMNS`."""
    names = list(table["panel"].unique())
    models = list(table.loc[table["kind"] == "model", "model"].unique())
    lines: dict[str, dict[str, Any]] = {
        model: {"color": theme.mark(place)[0], "linestyle": _DASHES[place % len(_DASHES)]}
        for place, model in enumerate(models)
    }
    lines[CONSTANT_VELOCITY] = {"color": theme.ink, "linestyle": ":"}
    with matplotlib.rc_context(style(theme)):
        figure, axes = panels(len(names), min(3, len(names)), (3.6, 2.2), sharex=True)
        for axis, name in zip(axes, names, strict=True):
            rows = table[table["panel"] == name]
            for model, line in lines.items():
                own = rows[rows["model"] == model].sort_values("seconds")
                axis.plot(own["seconds"], own["value"], linewidth=1.5, **line)
                axis.fill_between(
                    own["seconds"], own["low"], own["high"], color=line["color"], alpha=0.18,
                    linewidth=0,
                )  # fmt: skip
            top = rows.loc[rows["kind"] == "model", ["value", "high"]].max().max()
            base = rows.loc[rows["kind"] == "baseline", "value"].max()
            axis.set_ylim(0, 1.05 * max(top, min(base, 2 * top), 1e-3))
            axis.set_xlim(0, table["seconds"].max())
            title(axis, "mean over scenarios" if name == MEAN else str(name))
        figure.supxlabel("seconds of physics after the last observed frame", fontsize=10)
        figure.supylabel("error (m)", fontsize=10)
        handles = [Line2D([], [], label=label(model), **line) for model, line in lines.items()]
        legend(figure, handles, 3)
    return figure


# --- accuracy of models against people, one point per scenario ----------------------------------


@register_figure(
    "people_and_models", section=BY_SCENARIO, heading="People against models", order=33
)
def people_and_models(inputs: ReportInputs) -> Plot | None:
    """Return the accuracies of people against each model's, by scenario."""
    comparison = inputs.comparison
    if not comparison.has_people or comparison.stimuli["scenario"].nunique() < 2:
        return None
    caption = (
        "Accuracy of people against the accuracy of each model, one point per scenario, on the "
        "stimuli that both answered; hollow: the mean. Below the diagonal the model is more "
        "accurate than people."
    )
    table = tables.people_and_models_table(comparison, inputs.scatter_models())
    return Plot("people_and_models", caption, table, model_and_people_figure)


def model_and_people_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw the accuracy of people against the accuracy of each model by scenario, with the
    diagonal.

    ``table``: ``model``, ``scenario`` (with the mean, which is hollow), ``accuracy``, ``people``.
    One panel per model. The key names the marks: names next to points would overlap where scenarios
    are alike.
    """
    models = list(table["model"].unique())
    names = list(table["scenario"].unique())
    marks: dict[str, dict[str, Any]] = {
        name: {"linestyle": "", "markersize": 7, "marker": marker, "color": colour,
               "markeredgecolor": theme.ink, "markeredgewidth": 0.6}
        for name, (colour, marker) in zip(names, map(theme.mark, range(len(names))), strict=True)
    }  # fmt: skip
    if MEAN in marks:
        marks[MEAN] |= {"marker": "o", "color": theme.ink, "markerfacecolor": "none"}
    values = table[["accuracy", "people"]]
    low = min(0.5, float(values.min(axis=None)) - 0.02)
    high = min(1.0, float(values.max(axis=None)) + 0.05)
    with matplotlib.rc_context(style(theme)):
        columns = 2 if len(models) == 1 else 3
        figure, axes = panels(len(models), columns, (11 / columns, 9.2 / columns), above=0.5)
        for axis, model in zip(axes, models, strict=True):
            rows = table[table["model"] == model]
            axis.plot([low, high], [low, high], color=theme.faint, linewidth=1, zorder=0)
            for name, x, y in rows[["scenario", "accuracy", "people"]].itertuples(index=False):
                axis.plot(x, y, **marks[name])
            axis.set_xlim(low, high)
            axis.set_ylim(low, high)
            axis.set_aspect("equal")
            axis.set_xlabel(f"accuracy of {label(str(model), 40)}")
            axis.set_ylabel("accuracy of people")
        words = {name: "mean over scenarios" if name == MEAN else name for name in names}
        legend(figure, [Line2D([], [], label=words[name], **marks[name]) for name in names], 5)
    return figure
