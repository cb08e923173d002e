"""Parts of the page that show trials: one of each scenario, and the largest disagreements."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from physion.report.inputs import ReportInputs
from physion.report.page.blocks import paragraph, table
from physion.report.page.cards import KEY, READOUT_KEY, card, describe
from physion.report.page.choose_trials import (
    OPENING_RULE,
    OPENING_RULE_ALONE,
    opening_trials,
    opinions,
    who_was_right,
    widest_gaps,
)
from physion.report.page.movies import PageMovies
from physion.report.words import listed

INDEX = "trials/index.html"
"""Address of the list of trial pages, relative to the report."""


def shown_stimuli(inputs: ReportInputs) -> list[str]:
    """Return the stimuli whose movies the page or the trial pages show."""
    if inputs.trial_pages:
        return list(dict.fromkeys(inputs.comparison.stimuli["stimulus"]))
    found = opening_trials(inputs.comparison, inputs.movies)
    if inputs.comparison.has_people:
        found += list(widest_gaps(inputs.comparison, inputs.movie_count)["stimulus"])
    return list(dict.fromkeys(found))


def opening(inputs: ReportInputs, movies: PageMovies, links: Mapping[str, str]) -> str:
    """Return a card for one stimulus of each scenario, with its movie playing."""
    stimuli = inputs.comparison.stimuli
    cards = []
    for stimulus in opening_trials(inputs.comparison, inputs.movies):
        rows = stimuli[stimuli["stimulus"] == stimulus]
        cards.append(card(rows, movies.show(stimulus, describe(rows)), links))
    people = inputs.comparison.has_people
    note = [OPENING_RULE if people else OPENING_RULE_ALONE, KEY, READOUT_KEY]
    if inputs.trial_pages:
        listing = f'<p><a href="{INDEX}">A page for every stimulus</a></p>'
    else:
        listing = ""
    return (
        f"<p>{escape(_question(inputs))}</p>{_grid(cards)}"
        f'<p class="note">{escape(" ".join(note))}</p>{listing}'
    )


def _question(inputs: ReportInputs) -> str:
    who = "People and models" if inputs.comparison.has_people else "The models"
    shown = ", and the movies go on to show it" if inputs.movies else ""
    return (
        f"{inputs.question} {who} answer from the first 1.5 seconds; the label says what "
        f"happened{shown}."
    )


def gaps(inputs: ReportInputs, movies: PageMovies, links: Mapping[str, str]) -> str:
    """Return who was right how often, and a card for each of the largest differences."""
    if not inputs.comparison.has_people:
        return ""
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
        cards.append(card(rows, movie, links, named=row["agent"]))
    words = (
        "The stimuli whose P(contact) is farthest from the fraction of people who say yes, at "
        "least by one half; the models, in bold, take turns. Only stimuli whose simulated outcome "
        "is the official one." + _silent(inputs)
    )
    return f"{counts}{paragraph(words)}{_grid(cards)}"


def _silent(inputs: ReportInputs) -> str:
    """Return which models add no stimulus, and why."""
    speaking = set(opinions(inputs.comparison)["model"])
    models = dict.fromkeys(inputs.comparison.stimuli["model"])
    silent = [str(name) for name in models if name not in speaking]
    if not silent:
        return ""
    return (
        f" No turn for {listed(silent)}: shown the outcome, or of one P(contact) for all stimuli "
        "of a scenario."
    )


def _counts(inputs: ReportInputs) -> str:
    rows = who_was_right(inputs.comparison)
    heads = {
        "stimuli": "stimuli",
        "both": "both right",
        "people": "only people right",
        "model": "only the model right",
        "neither": "both wrong",
    }
    if rows["divided"].any():
        heads["divided"] = "people divided"
    cells = [
        [escape(str(row["agent"])), *(str(row[key]) for key in heads)] for _, row in rows.iterrows()
    ]
    return table(["model", *heads.values()], cells, "The majority of people and each model")


def _grid(cards: list[str]) -> str:
    return f'<div class="cards">{"".join(cards)}</div>'
