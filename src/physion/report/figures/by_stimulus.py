"""Figures by stimulus: models against people, thirds, difficulty, response times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from physion.analysis import figure_tables as tables
from physion.analysis.statistics.agreement import pearson
from physion.analysis.tables import in_order
from physion.core.errors import BadInputError
from physion.report.figures.by_scenario import measure_figure
from physion.report.figures.theme import (
    BY_STIMULUS,
    HATCHES,
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
from physion.scenes.scene import OBSERVED_FRAMES

SQUARE = 1.16
"""Distance between the left edges of two scenarios' squares; a square is 1 wide."""


@register_figure("scatter", section=BY_STIMULUS, heading="Models against people", order=60)
def scatter(inputs: ReportInputs) -> Plot | None:
    """Return P(contact) against the fraction of people who say yes."""
    comparison, shown = inputs.comparison, inputs.scatter_models()
    if not comparison.has_people:
        return None
    caption = (
        "P(contact) of each model (rows) against the fraction of people who say yes, by scenario; "
        "one point for each stimulus."
    )
    if len(comparison.changed):
        caption += " Hollow: the simulated outcome is not the official one."
    rest = [name for name in comparison.models if name not in shown]
    if rest:
        caption += f" Not drawn, but in tables/stimuli.csv: {', '.join(map(str, rest))}."
    return Plot("scatter", caption, tables.scatter_table(comparison, shown), scatter_figure)


@register_figure(
    "right_answers", section=BY_STIMULUS, heading="Accuracy of people and models", order=65
)
def right_answers(inputs: ReportInputs) -> Plot | None:
    """Return the accuracies of people against each model's, by stimulus."""
    comparison, shown = inputs.comparison, inputs.scatter_models()
    if not comparison.has_people:
        return None
    caption = (
        "Accuracy of people against the accuracy of each model (rows), by scenario; one point for "
        "each stimulus. Of a model it is the probability that it gives to the recorded outcome, so "
        "0 or 1 if it predicts without doubt."
    )
    table = tables.right_answers_table(comparison, shown)
    axes = ("p_right", "human_accuracy", "accuracy of the model", "accuracy of people")
    return Plot("right_answers", caption, table, partial(scatter_figure, axes=axes))


P_AND_YES = ("p_yes", "p_contact", "fraction of people who say yes", "P(contact) of the model")


def scatter_figure(
    table: pd.DataFrame, theme: Theme = LIGHT, *, axes: tuple[str, str, str, str] = P_AND_YES
) -> Figure:
    """Draw two values from 0 to 1 of models and people against each other, by stimulus.

    One panel per model, in it one square per scenario, so that no colour is needed; hollow points
    are stimuli whose simulated outcome is not the official one.

    Parameters
    ----------
    table
        See `figure_tables.scatter_table` and `figure_tables.right_answers_table`.
    theme
        Colours.
    axes
        Column of the table to the right, column upwards, and their labels.
    """
    right, up, *words = axes
    models = list(table["model"].unique())
    scenarios = in_order(table["scenario"])
    columns = max(1, min(4, 8 // len(scenarios)))
    width = 11 / columns
    height = (width - 0.4) / (SQUARE * len(scenarios))
    with matplotlib.rc_context(style(theme)):
        figure, places = panels(
            len(models), columns, (width, height + 0.52), above=0.4, sharex=True, sharey=True
        )
        points = table.assign(x=table[right], y=table[up])
        for axis, model in zip(places, models, strict=True):
            _squares(axis, points[points["model"] == model], scenarios, theme)
        figure.supxlabel(words[0], fontsize=10)
        figure.supylabel(words[1], fontsize=10)
        if (table["label"] != table["simulated"]).any():
            legend(figure, _scatter_handles(theme), 2)
    return figure


def _squares(axis: Axes, rows: pd.DataFrame, scenarios: Sequence[str], theme: Theme) -> None:
    """Draw the squares of one model next to each other on one axis, which is fast."""
    left = SQUARE * np.arange(len(scenarios))
    frame = np.array([(0, 0), (1, 1), (np.nan, np.nan), (0, 1), (0, 0), (1, 0), (np.nan, np.nan)])
    lines = np.concatenate([frame + np.array([x, 0]) for x in left])
    axis.plot(*lines.T, color=theme.faint, linewidth=0.8, zorder=0)
    x = rows["x"] + rows["scenario"].map(dict(zip(scenarios, left, strict=True)))
    changed = rows["label"] != rows["simulated"]
    for hollow in (False, True):
        if (changed == hollow).any():
            # A line with markers is fast to draw and small in SVG.
            axis.plot(x[changed == hollow], rows["y"][changed == hollow],
                      **_point(hollow, theme))  # fmt: skip
    for index, scenario in zip(left, scenarios, strict=True):
        subset = rows[rows["scenario"] == scenario]
        words = f"{scenario}, {_describe_r(subset['x'], subset['y'])}"
        axis.text(index, 1.05, words, fontsize=7.5, va="bottom")
    pooled = f"{_describe_r(rows['x'], rows['y'])} pooled, {len(rows)} stimuli"
    join = ", " if len(scenarios) > 3 else "\n"
    axis.set_title(f"{label(rows['model'].iloc[0], 90)}{join}{pooled}", fontsize=8.5, loc="left",
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


# --- correlation within hard, chance and easy stimuli -------------------------------------------


@register_figure("thirds", section=BY_STIMULUS, heading="Hard, chance and easy stimuli", order=70)
def thirds(inputs: ReportInputs) -> Plot | None:
    """Return r within hard, chance and easy stimuli."""
    if not inputs.comparison.has_people:
        return None
    caption = (
        "Pearson's r with the average person within the stimuli on which people are right up to a "
        "third of the time (hard), from two thirds on (easy), and between (chance): mean over the "
        "scenarios in which it is defined, with intervals by drawing scenarios, as in the paper. "
        "Within hard and easy stimuli the answers of people nearly determine the outcome, so a "
        "model that is always right has r below 0 in hard ones."
    )
    answers = None if inputs.people is None else inputs.people.kept.test
    if answers is not None:
        caption += (
            " Dashed: mean r between random halves of the people within the same stimuli; hatched: "
            "the middle 95 % of these r, its bounds averaged over scenarios. A half is a noisier "
            "average than all people, with whom models are correlated."
        )
    table = tables.thirds_table(inputs.comparison, answers)
    draw = partial(measure_figure, measure="r")
    return Plot("thirds", f"{caption} Dotted: chance.", table, draw)


# --- accuracy of people, with the stimuli that mislead them -------------------------------------

BINS = np.linspace(0, 1, 21)
"""Edges of the bars in the distribution of accuracy."""

TAIL = (
    ("not below chance", 0),
    ("below chance only by the study's rule", 4),
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

    ``table``: from `effects.below_chance_level`.
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
    released = rows["released"].to_numpy(dtype=bool) & ~corrected
    below = np.zeros(len(BINS) - 1)
    for (_, index), subset in zip(
        TAIL, (~(released | corrected), released, corrected), strict=True
    ):
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


# --- the stimuli that mislead people most, as frames ----------------------------------------------

SHOWN_MISLEADING = 3
"""Stimuli of a scenario whose frames are drawn."""

_FRAME_SIDE = 160
"""Height and width of a drawn frame in pixels."""

MISLEADING_CAPTION = (
    "Stimuli that people get wrong more often than by guessing, of each scenario the ones with the "
    "lowest accuracy: the last frame that people saw before they answered, and the last frame of "
    "the movie. Left: the accuracy of people on all stimuli of the scenario; filled: those below "
    "chance by the study's rule or an exact test corrected for the number of stimuli."
)


@register_figure(
    "misleading", section=BY_STIMULUS, heading="Frames of stimuli that mislead people", order=95
)
def misleading(inputs: ReportInputs) -> Plot | None:
    """Return frames of the stimuli on which people are below chance, if their movies are given."""
    if not inputs.comparison.has_people:
        return None
    by_stimulus = None if inputs.people is None else inputs.people.tables["by_stimulus"]
    return misleading_plot(tables.difficulty_table(inputs.comparison, by_stimulus), inputs.movies)


def misleading_plot(difficulty: pd.DataFrame, movies: Mapping[str, Path]) -> Plot | None:
    """Return the figure of misleading stimuli; None without a movie of any.

    ``difficulty``: from `below_chance_level`; its column ``shown`` says in the figure's table which
    place a stimulus has, from 1; 0: it is not drawn.
    """
    tail = difficulty[difficulty["released"] | difficulty["exact"]]
    tail = tail.sort_values(["accuracy", "stimulus"])
    frames = {}
    shown = pd.Series(0, index=difficulty.index)
    for _, rows in tail.groupby("scenario"):
        with_movie = rows.index[rows["stimulus"].isin(set(movies))]
        for place, row in enumerate(with_movie[:SHOWN_MISLEADING]):
            stimulus = str(rows["stimulus"][row])
            found = read_two_frames(movies[stimulus])
            if found is not None:
                frames[stimulus] = found
                shown[row] = place + 1
    if not frames:
        return None
    draw = partial(misleading_figure, frames=frames)
    return Plot("misleading", MISLEADING_CAPTION, difficulty.assign(shown=shown), draw)


def read_two_frames(path: Path) -> npt.NDArray[np.uint8] | None:
    """Return the last observed and the last frame of a movie; None if it is not a movie."""
    from physion.trials.video import count_frames, read_chosen

    try:
        last = count_frames(path) - 1
        at = [min(OBSERVED_FRAMES - 1, last), last]
        return read_chosen(path, at, size=(_FRAME_SIDE, _FRAME_SIDE))
    except BadInputError:
        return None


def misleading_figure(
    table: pd.DataFrame, theme: Theme = LIGHT, *, frames: Mapping[str, npt.NDArray[np.uint8]]
) -> Figure:
    """Draw the distribution of people's accuracy and frames of misleading stimuli, by scenario.

    Parameters
    ----------
    table
        See `misleading_plot`.
    theme
        Colours.
    frames
        Two frames of each stimulus that is shown.
    """
    drawn = table[table["shown"] > 0]
    scenarios = in_order(drawn["scenario"])
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(11, 1.62 * len(scenarios) + 0.3), layout="constrained")
        grid = figure.add_gridspec(
            len(scenarios), 1 + 2 * SHOWN_MISLEADING, width_ratios=[1.5] + [1] * 6
        )
        for row, scenario in enumerate(scenarios):
            axis = figure.add_subplot(grid[row, 0])
            own = table[table["scenario"] == scenario]
            low = own["accuracy"][own["released"] | own["exact"]]
            axis.hist(own["accuracy"], list(BINS), color=theme.zone)
            axis.hist(low, list(BINS), color=theme.palette[5])
            axis.axvline(0.5, color=theme.ink, linestyle=":", linewidth=1)
            axis.set_xlim(0, 1)
            title(axis, f"{scenario}, {len(low)} of {len(own)}")
            if row == len(scenarios) - 1:
                axis.set_xlabel("accuracy of people")
            shown = drawn[drawn["scenario"] == scenario].sort_values("shown")
            for place, (_, stimulus) in enumerate(shown.iterrows()):
                for which, picture in enumerate(frames[stimulus["stimulus"]]):
                    axis = figure.add_subplot(grid[row, 1 + 2 * place + which])
                    axis.imshow(picture)
                    axis.set_axis_off()
                    right = f"{stimulus['accuracy']:.0%} of {stimulus['count']:.0f} right"
                    axis.set_title(("end", right)[which == 0], fontsize=7.5, loc="left")
    return figure


# --- response times of people against their accuracy --------------------------------------------

RESPONSE_TIME_CAPTION = (
    "Mean over people of the natural logarithm of their response times to a stimulus, against the "
    "accuracy of people on it, with the least-squares line. Preregistered: the less accurate, the "
    "slower."
)


@register_figure("response_time", section=BY_STIMULUS, heading="Response times", order=100)
def response_time(inputs: ReportInputs) -> Plot | None:
    """Return response times against accuracy."""
    if inputs.people is None:
        return None
    table = tables.response_time_table(inputs.people.tables["by_stimulus"])
    if table["mean_log_rt"].isna().all():
        return None
    return Plot("response_time", RESPONSE_TIME_CAPTION, table, response_time_figure)


def response_time_figure(table: pd.DataFrame, theme: Theme = LIGHT) -> Figure:
    """Draw the mean log response time of a stimulus against its accuracy, by scenario, with a line.

    ``table``: see `figure_tables.response_time_table`.
    """
    scenarios = in_order(table["scenario"])
    with matplotlib.rc_context(style(theme)):
        size = (11 / 4, 2.5)
        figure, axes = panels(len(scenarios), 4, size, above=0.3, sharex=True, sharey=True)
        for index, (axis, scenario) in enumerate(zip(axes, scenarios, strict=True)):
            rows = table[(table["scenario"] == scenario) & table["mean_log_rt"].notna()]
            x = rows["accuracy"].to_numpy(dtype=np.float64)
            y = rows["mean_log_rt"].to_numpy(dtype=np.float64)
            colour, marker = theme.mark(index)
            axis.plot(x, y, linestyle="", marker=marker, color=colour, markersize=3.6, alpha=0.7,
                      markeredgewidth=0)  # fmt: skip
            r = pearson(x, y)
            if np.isfinite(r):
                slope, level = np.polyfit(x, y, 1)
                ends = np.array([x.min(), x.max()])
                axis.plot(ends, level + slope * ends, color=theme.ink, linewidth=1.3)
            title(axis, scenario)
            axis.set_title(f"r = {number(r)}", fontsize=8.5, loc="right")
            axis.set_xlim(-0.03, 1.03)
            axis.set_xticks([0, 0.5, 1])
        figure.supxlabel("accuracy of people on a stimulus", fontsize=10)
        figure.supylabel("mean log response time (log ms)", fontsize=10)
    return figure
