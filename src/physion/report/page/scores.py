"""Tables of scores, anchors below the models: scores, beyond the outcome, by scenario."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import pandas as pd

from physion.analysis.metrics import Metric, score_metrics
from physion.analysis.metrics.beyond_outcome import BEYOND_OUTCOME
from physion.analysis.models.anchors import TWO_PEOPLE
from physion.analysis.models.comparison import Comparison
from physion.analysis.models.observed_contact import SETTING
from physion.analysis.tables.stimuli import MEAN, POOLED, in_order
from physion.report.page.blocks import (
    ANCHORS,
    definition_list,
    details,
    interval,
    paragraph,
    table,
    undefined,
)
from physion.report.words import number

_SAME_EVENT = ("accuracy_simulated", "r_same")
"""Metrics that say something only where a simulated outcome is not the official one."""

_LIKENESS = ("r", "kappa_from_averages")
"""Metrics of likeness to people, which those beyond the outcome are read next to."""

_ANCHORS = (
    "The recorded outcome answers as a perfect simulator would. The majority of people answers "
    "what most of them did: no yes or no agrees with them more often, so its kappa is the ceiling. "
    "One person with another: what a person reaches."
)

_BEYOND = (
    "Whoever predicts outcomes well resembles people, because people predict them well too. These "
    "numbers take out that part: a model that resembles people by the outcome alone has 0. Kappa "
    "beyond the outcome supposes that half of the answers are yes, and is too low where most "
    "outcomes are alike; kappa within outcomes is right there too."
)


def scores(comparison: Comparison) -> str:
    """Return all tables of scores: mean over scenarios and pooled, beyond the outcome, later."""
    plain = shown_metrics(comparison, beyond=False)
    parts = [
        paragraph(_ANCHORS) if comparison.has_people else "",
        scores_table(comparison.all_scores, MEAN, plain, "Mean over scenarios"),
        details("All stimuli pooled", scores_table(comparison.all_scores, POOLED, plain)),
    ]
    if comparison.has_people:
        parts += ["<h3>Beyond the outcome</h3>", paragraph(_BEYOND), *_beyond(comparison)]
    parts += ["<h3>Without contacts in the observed part</h3>", _later(comparison)]
    return "\n".join(part for part in parts if part)


def _beyond(comparison: Comparison) -> list[str]:
    beyond = shown_metrics(comparison, beyond=True)
    tables = [
        scores_table(comparison.all_scores, MEAN, beyond, "Mean over scenarios"),
        details("All stimuli pooled", scores_table(comparison.all_scores, POOLED, beyond)),
    ]
    for metric in score_metrics():
        if metric.name in BEYOND_OUTCOME:
            title = f"By scenario: {metric.heading}"
            tables.append(details(title, matrix(comparison, metric.name)))
    return tables


def _later(comparison: Comparison) -> str:
    """Return the scores without observed contacts, or why there are none."""
    left_out = comparison.settings[SETTING]
    if comparison.later.empty:
        return paragraph(f"{left_out[0].upper()}{left_out[1:]}.")
    words = (
        "Where agent and patient touch in the observed part there is nothing left to predict. "
        f"Left out: {left_out}."
    )
    several = comparison.has_people
    names = (
        ("accuracy", "human_accuracy", *_LIKENESS, *BEYOND_OUTCOME) if several else ("accuracy",)
    )
    chosen = [metric for metric in score_metrics() if metric.name in names]
    return paragraph(words) + scores_table(comparison.later, MEAN, chosen, "Mean over scenarios")


def shown_metrics(comparison: Comparison, beyond: bool) -> list[Metric]:
    """Return the metrics of a table that say something about this comparison.

    ``beyond``: those beyond the outcome with those of likeness, or all others. Without people those
    that need them are left out, and those about simulated outcomes if all simulated outcomes are
    the official ones.
    """
    names = (*_LIKENESS, *BEYOND_OUTCOME)
    return [
        metric
        for metric in score_metrics()
        if (comparison.has_people or metric.needs == "outcome")
        and (metric.name in names if beyond else metric.name not in BEYOND_OUTCOME)
        and not (comparison.changed.empty and metric.name in _SAME_EVENT)
    ]


def scores_table(
    scores: pd.DataFrame, which: str, metrics: Sequence[Metric], caption: str = ""
) -> str:
    """Return a table of scores: a row a model, the metrics, and after r its noise ceiling.

    Parameters
    ----------
    scores
        As `Comparison.all_scores`; anchors follow the models as a group.
    which
        A scenario, `MEAN` or `POOLED`.
    metrics
        The columns. Reasons of what is undefined in them are listed below the table.
    caption
        Text above the table.
    """
    rows = scores[scores["scenario"] == which]
    header = ["model", "readout", "stimuli"]
    for metric in metrics:
        header += [metric.heading, "ceiling of r"] if metric.name == "r" else [metric.heading]
    lines: dict[str, list[list[str]]] = {"model": [], "anchor": []}
    for _, row in rows.iterrows():
        line = [escape(_describe_model(row)), escape(row["readout"]), str(row["stimuli"])]
        for metric in metrics:
            line.append(_cell(row, metric))
            if metric.name == "r":
                line.append(number(row["ceiling"]))
        lines[row["kind"]].append(line)
    listing = table(header, lines["model"], caption, (ANCHORS, lines["anchor"]))
    return listing + _reasons(rows, metrics)


def _cell(row: pd.Series, metric: Metric) -> str:
    """Return a score with its interval; empty where it has no meaning for two people."""
    if row["agent"] == TWO_PEOPLE and metric.two_people is None:
        return ""
    return interval(row, metric.name)


def _reasons(rows: pd.DataFrame, metrics: Sequence[Metric]) -> str:
    """Return the reasons that are about columns of the table, as a list."""
    others = {metric.label for metric in score_metrics()} - {metric.label for metric in metrics}
    items = []
    for _, row in rows.iterrows():
        parts = [part for part in str(row["reason"]).split("; ") if part]
        about = [part for part in parts if part.partition(":")[0] not in others]
        if about:
            items.append(f"<li>{escape(row['agent'])}: {escape('; '.join(about))}</li>")
    return f'<ul class="notes">{"".join(items)}</ul>' if items else ""


def _describe_model(row: pd.Series) -> str:
    """Return the model's name with what distinguishes it from others, but without the readout."""
    head = " · ".join(name for name in (row["model"], row["readout"]) if name)
    return str(row["model"]) + str(row["agent"]).removeprefix(head)


def matrix(comparison: Comparison, key: str) -> str:
    """Return a score by model (rows) and scenario (columns), people on top, anchors below."""
    columns = [*in_order(comparison.stimuli["scenario"]), MEAN, POOLED]
    first = []
    if comparison.has_people and key in _PEOPLE:
        first.append([f"<em>{_PEOPLE[key]}</em>", *_people_cells(comparison, key, columns)])
    lines: dict[str, list[list[str]]] = {"model": first, "anchor": []}
    for agent, rows in comparison.all_scores.groupby("agent", sort=False):
        subset = rows.set_index("scenario")
        if agent == TWO_PEOPLE and (key in _PEOPLE or subset[key].isna().all()):
            continue
        cells = [
            interval(subset.loc[name], key) if name in subset.index else undefined("no predictions")
            for name in columns
        ]
        lines[subset["kind"].iloc[0]].append([escape(str(agent)), *cells])
    return table(["", *columns], lines["model"], below=(ANCHORS, lines["anchor"]))


_PEOPLE = {"accuracy": "people", "r": "ceiling"}
"""Title of the row on top, by metric."""


def _people_cells(comparison: Comparison, key: str, columns: Sequence[str]) -> list[str]:
    people = comparison.people.set_index("scenario").assign(reason="")
    if key == "accuracy":
        return [interval(people.loc[name], key) if name in people.index else "" for name in columns]
    return [number(people.loc[name, "ceiling"]) if name in people.index else "" for name in columns]


def definitions(comparison: Comparison) -> str:
    """Return the definitions of the columns of the tables of scores."""
    chosen = [*shown_metrics(comparison, beyond=False)]
    if comparison.has_people:
        chosen += [one for one in score_metrics() if one.name in BEYOND_OUTCOME]
    meaning = {metric.heading: metric.definition for metric in chosen}
    meaning |= {
        "NaN": "undefined; the reason is below the table or shown on hovering",
        "all, all-but, only": "a model's training: on all scenarios, on all but the tested one, on "
        "the tested one alone; in the files the last two are “all but this” and “same”",
    }
    return f"<h3>What the numbers mean</h3>{definition_list(meaning)}"
