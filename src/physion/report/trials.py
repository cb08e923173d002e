"""Trials on a page: choice of those to show, cards, answers."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from physion.analysis.comparison import Comparison
from physion.analysis.scores import kind_of
from physion.analysis.tables import in_order
from physion.core.html import Markup, joined, macros_of
from physion.report.html import (
    PageMovies,
    listed,
    number,
    paragraph,
    percent,
    plural,
    stimulus_link,
    table,
)
from physion.report.inputs import ReportInputs

ACCURACY_STEP = 0.05
"""Stimuli whose accuracies of people lie in one such step count as equally clear to people."""

OPENING_RULE = (
    "Of each scenario the stimulus that most people judged rightly is shown (accuracies within the "
    "same 5 % count as equal) and, of these, the one that the models missed most; scenarios with "
    "and without contact alternate where people allow it. So these trials are clear to people, and "
    "no sample of all."
)
OPENING_RULE_ALONE = (
    "Of each scenario the stimulus that the models missed most is shown; scenarios with and "
    "without contact alternate."
)


WIDE = 0.5
"""Smallest |P(contact) - P(yes)| that counts as a disagreement."""


def opening_trials(comparison: Comparison, movies: Container[str] = ()) -> list[str]:
    """Return one stimulus of each scenario, in the order of the scenarios.

    In turn, the best by: a movie in ``movies``; a simulated outcome that is the official one;
    the number of models that answered; a majority of people that was right; contact in the first,
    third, ... scenario and none in the others; people's accuracy in steps of `ACCURACY_STEP`; the
    mean distance of the models' P(contact) from the outcome; the first name. Without people their
    part is left out.
    """
    found = []
    for position, scenario in enumerate(in_order(comparison.stimuli["scenario"])):
        rows = comparison.stimuli[comparison.stimuli["scenario"] == scenario]
        found.append(_best(rows, movies, contact=position % 2 == 0))
    return found


def _best(rows: pd.DataFrame, movies: Container[str], contact: bool) -> str:
    rows = rows.assign(miss=(rows["p_contact"] - rows["label"].astype(float)).abs())
    table = rows.groupby("stimulus", as_index=False).agg(
        models=("model", "size"),
        label=("label", "first"),
        simulated=("simulated", "first"),
        accuracy=("human_accuracy", "first"),
        miss=("miss", "mean"),
    )
    accuracy = table["accuracy"].astype(float)
    # A little is added so that 0.95 is not counted below 19 steps of 0.05.
    steps = np.floor(accuracy / ACCURACY_STEP + 1e-9)
    table = table.assign(
        movie=[name in movies for name in table["stimulus"]],
        same=table["label"] == table["simulated"],
        right=accuracy > 0.5,
        turn=table["label"].astype(bool) == contact,
        step=steps.fillna(0.0),
    )
    order = ["movie", "same", "models", "right", "turn", "step", "miss", "stimulus"]
    best = table.sort_values(order, ascending=[False] * 7 + [True], kind="stable")
    return str(best["stimulus"].iloc[0])


def opinions(comparison: Comparison) -> pd.DataFrame:
    """Return the rows of ``comparison.stimuli`` of models that predict something themselves.

    Left out are models that were shown the outcome (readout *full*) and those that give all
    stimuli of every scenario the same P(contact); if none is left, all rows are returned.
    """
    rows = comparison.stimuli
    values = rows.groupby(["model", "scenario"])["p_contact"].nunique()
    varied = values[values > 1].reset_index()["model"].unique()
    kept = rows[rows["model"].isin(varied) & (rows["readout"] != "full")]
    return rows if kept.empty else kept


def widest_gaps(comparison: Comparison, count: int) -> pd.DataFrame:
    """Return the stimuli on which a model and people differ most, at most ``count`` rows.

    Models alternate, each with all of its readouts (see `opinions` for models without a turn): each
    adds the stimulus with its largest |P(contact) - P(yes)|, at least `WIDE`, that is not yet
    chosen; ties are resolved by name. Stimuli whose simulated outcome is not the official one are
    skipped, since there the physics differs and not the model. The result has rows of
    ``comparison.stimuli`` with the column ``size``, each of the model that added it.
    """
    rows = opinions(comparison)
    rows = rows[(rows["label"] == rows["simulated"]) & (rows["gap"].abs() >= WIDE)]
    rows = rows.assign(size=rows["gap"].abs())
    ranked = rows.sort_values(["size", "stimulus"], ascending=[False, True], kind="stable")
    names = list(dict.fromkeys(rows["base_model"]))
    queues = [list(ranked.index[ranked["base_model"] == name]) for name in names]
    chosen: list[int] = []
    seen: set[str] = set()
    while len(chosen) < count and any(queues):
        for queue in queues:
            while queue and rows.loc[queue[0], "stimulus"] in seen:
                queue.pop(0)
            if queue and len(chosen) < count:
                chosen.append(queue.pop(0))
                seen.add(str(rows.loc[chosen[-1], "stimulus"]))
    return rows.loc[chosen]


def who_was_right(comparison: Comparison) -> pd.DataFrame:
    """Return how often the majority of people and each model were right on the same stimuli.

    One row per model with counts: ``stimuli``, ``both``, ``only_people``, ``only_model``,
    ``neither`` right, ``divided``: exactly half of the people were right. The outcome is the
    official one.
    """
    rows = comparison.stimuli
    people, divided = rows["human_accuracy"] > 0.5, rows["human_accuracy"] == 0.5
    model = rows["predicted"].astype(bool) == rows["label"].astype(bool)
    counted = rows.assign(
        both=people & model,
        only_people=people & ~model,
        only_model=~people & ~divided & model,
        neither=~people & ~divided & ~model,
        divided=divided,
    )
    keys = ["both", "only_people", "only_model", "neither", "divided"]
    sums = counted.groupby("model", sort=False)[keys].sum().astype(int)
    sums.insert(0, "stimuli", counted.groupby("model", sort=False).size())
    return sums.reset_index()


# --- cards: a stimulus with its movie, its outcome, and all answers -----------------------------

MOST_ANSWERS = 10
"""Largest number of models that a card shows at once; more of them open on a click."""
READOUT_ORDER = ("observed+simulated", "observed")
"""Readouts of which a card shows the first that a model has."""
KEY = (
    "Bars: the fraction of people who say yes, and each model's P(contact); the line marks one "
    "half. ✓: the majority, or the model's answer, is right; ✗: it is wrong."
)
READOUT_KEY = "Of a model with several readouts the cards show observed+simulated, else observed."


_MACROS = macros_of("physion.report", "trials.html")


def card(rows: pd.DataFrame, movie: Markup, links: Mapping[str, str], named: str = "") -> Markup:
    """Return one stimulus as a card.

    Parameters
    ----------
    rows
        The rows of ``comparison.stimuli`` of this stimulus.
    movie
        Its movie, see `PageMovies`.
    links
        Addresses by stimulus; the name links there.
    named
        Name of a model (``model``) that is shown in bold and with this readout.
    """
    first = rows.iloc[0]
    answered = answers(pick_readouts(rows, named), named)
    name = stimulus_link(first["stimulus"], links)
    return Markup(_MACROS.card(first["scenario"], outcome(first), movie, answered, name))


def pick_readouts(rows: pd.DataFrame, named: str = "") -> pd.DataFrame:
    """Return the rows of one readout of each model: the readout in ``named``, else by
    `READOUT_ORDER`. Baselines come last.

    Readouts that were shown the outcome (*full*) are left out where another one is there.
    """
    seen = rows[(rows["readout"] != "full") | (rows["model"] == named)]
    rows = rows if seen.empty else seen
    parts = []
    for _, own in rows.groupby("base_model", sort=False):
        if (own["model"] == named).any():
            parts.append(own[own["model"] == named])
            continue
        known = [name for name in READOUT_ORDER if (own["readout"] == name).any()]
        parts.append(own[own["readout"] == known[0]] if known else own)
    parts.sort(
        key=lambda own: kind_of(name := own["model"].iloc[0]) == "baseline" and name != named
    )
    return pd.concat(parts)


def outcome(row: pd.Series) -> Markup:
    """Return what happened as a label; with the simulated outcome if it differs."""
    kind = "contact" if row["label"] else "no contact"
    words = kind
    if bool(row["simulated"]) != bool(row["label"]):
        words += ", not in the movie" if row["label"] else ", but in the movie"
    return Markup(_MACROS.outcome(kind.replace(" ", "-"), words))


def describe(rows: pd.DataFrame) -> str:
    """Return a sentence about the movie of a stimulus, for readers who do not see it."""
    first = rows.iloc[0]
    happened = "they touch" if first["simulated"] else "they do not touch"
    return f"Movie of {first['stimulus']} ({first['scenario']}): {happened}"


@dataclass(frozen=True)
class _Answer:
    """Answer of people or of a model: a bar of ``fraction`` and whether it is right."""

    name: str
    title: str
    value: str
    fraction: float
    right: bool | None
    kind: str
    small: str = ""

    @property
    def word(self) -> str:
        return {True: "right", False: "wrong", None: "divided"}[self.right]

    @property
    def mark(self) -> str:
        return {True: "✓", False: "✗", None: "–"}[self.right]


def answers(rows: pd.DataFrame, named: str = "") -> Markup:
    """Return the answers of people, if there are any, and of the models as labelled bars."""
    first = rows.iloc[0]
    items = []
    if np.isfinite(first["p_yes"]):
        right = None if first["human_accuracy"] == 0.5 else first["human_accuracy"] > 0.5
        value, count = percent(first["p_yes"]), f"of {first['count']:.0f}"
        items.append(_Answer("people say yes", "", value, first["p_yes"], right, "human", count))
    for _, row in rows.iterrows():
        only = (rows["base_model"] == row["base_model"]).sum() == 1
        right = bool(row["predicted"]) == bool(row["label"])
        kind = "model named" if row["model"] == named else "model"
        name = str(row["base_model"] if only else row["model"])
        value = probability(row["p_contact"])
        items.append(_Answer(name, str(row["model"]), value, row["p_contact"], right, kind))
    # People come first and count as one.
    most = MOST_ANSWERS + len(items) - len(rows)
    more = plural(len(items) - most, "further model")
    return Markup(_MACROS.answers(items[:most], items[most:], more))


def probability(p: float) -> str:
    """Return P(contact) with the decimals that show on which side of one half it lies."""
    for digits in (2, 3, 4):
        text = number(p, digits)
        if p == 0.5 or float(text) != 0.5:
            return text
    return "> 0.5" if p > 0.5 else "< 0.5"


# --- sections: one trial of each scenario, and the largest disagreements ------------------------


def shown_stimuli(inputs: ReportInputs) -> list[str]:
    """Return the stimuli whose movies the page shows."""
    found = opening_trials(inputs.comparison, inputs.movies)
    if inputs.comparison.has_people:
        found += list(widest_gaps(inputs.comparison, inputs.movie_count)["stimulus"])
    return list(dict.fromkeys(found))


def opening(inputs: ReportInputs, movies: PageMovies, links: Mapping[str, str]) -> Markup:
    """Return a card for one stimulus of each scenario, with its movie playing."""
    stimuli = inputs.comparison.stimuli
    cards = []
    for stimulus in opening_trials(inputs.comparison, inputs.movies):
        rows = stimuli[stimuli["stimulus"] == stimulus]
        cards.append(card(rows, movies.show(stimulus, describe(rows)), links))
    people = inputs.comparison.has_people
    note = [OPENING_RULE if people else OPENING_RULE_ALONE, KEY, READOUT_KEY]
    return joined([paragraph(_question(inputs)), _grid(cards), paragraph(" ".join(note), "note")])


def _question(inputs: ReportInputs) -> str:
    who = "People and models" if inputs.comparison.has_people else "The models"
    shown = ", and the movies continue to show it" if inputs.movies else ""
    return (
        f"{inputs.question} {who} answer from the first 1.5 seconds; the label says what "
        f"happened{shown}."
    )


def gaps(inputs: ReportInputs, movies: PageMovies, links: Mapping[str, str]) -> Markup:
    """Return who was right how often, and a card for each of the largest differences."""
    if not inputs.comparison.has_people:
        return Markup()
    chosen = widest_gaps(inputs.comparison, inputs.movie_count)
    counts = _counts(inputs)
    if chosen.empty:
        return counts + paragraph(
            "No movie: no P(contact) is one half away from the fraction of people who say yes, "
            "where the simulated outcome is the official one."
        )
    stimuli = inputs.comparison.stimuli
    cards = []
    for _, row in chosen.iterrows():
        rows = stimuli[stimuli["stimulus"] == row["stimulus"]]
        movie = movies.show(row["stimulus"], describe(rows))
        cards.append(card(rows, movie, links, named=row["model"]))
    words = (
        "The stimuli whose P(contact) is farthest from the fraction of people who say yes, at "
        "least by one half; the models, in bold, take turns. Only stimuli whose simulated outcome "
        "is the official one." + _silent(inputs)
    )
    return joined([counts, paragraph(words), _grid(cards)])


def _silent(inputs: ReportInputs) -> str:
    """Return which models add no stimulus, and why."""
    speaking = set(opinions(inputs.comparison)["base_model"])
    models = dict.fromkeys(inputs.comparison.stimuli["base_model"])
    silent = [str(name) for name in models if name not in speaking]
    if not silent:
        return ""
    return (
        f" No turn for {listed(silent)}: shown the outcome, or of one P(contact) for all stimuli "
        "of a scenario."
    )


def _counts(inputs: ReportInputs) -> Markup:
    rows = who_was_right(inputs.comparison)
    heads = {
        "stimuli": "stimuli",
        "both": "both right",
        "only_people": "only people right",
        "only_model": "only the model right",
        "neither": "both wrong",
    }
    if rows["divided"].any():
        heads["divided"] = "people divided"
    cells = [[str(row["model"]), *(str(row[key]) for key in heads)] for _, row in rows.iterrows()]
    return table(["model", *heads.values()], cells, "The majority of people and each model")


def _grid(cards: list[Markup]) -> Markup:
    return Markup(_MACROS.cards(cards))
