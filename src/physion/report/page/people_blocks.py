"""Parts of the page about people: accuracy, agreement, biases, difficulty."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np
import pandas as pd

from physion.analysis.metrics import measure_metrics
from physion.analysis.people.difficulty import below_chance
from physion.analysis.people.hypotheses import HYPOTHESES
from physion.analysis.tables.stimuli import MEAN, in_order
from physion.report.inputs import ReportInputs
from physion.report.page.blocks import Column, details, paragraph, rows_table, stimulus_link, table
from physion.report.page.blocks import people as averages
from physion.report.words import number

MORE = "every scenario, and why an interval is missing, is in tables/measures.csv"


def people(inputs: ReportInputs, shown: Mapping[str, str]) -> str:
    """Return accuracy of and agreement among people."""
    if not inputs.comparison.has_people:
        return ""
    parts = [averages(inputs.comparison)]
    if inputs.people is None:
        return "".join(parts)
    found = inputs.people.tables
    parts = [
        _accuracy(found),
        _agreement(found),
    ]
    if inputs.beside is not None:
        parts.append(details("What single people reach", _zones(inputs.beside.zones)))
    parts += ["<h3>Inclinations, practice, background</h3>", _biases(found)]
    parts += ["<h3>What makes a stimulus hard</h3>", _hypotheses(found)]
    parts.append(
        details("People on the stimuli that any model predicts", averages(inputs.comparison))
    )
    return "\n".join(parts)


def _accuracy(found: Mapping[str, pd.DataFrame]) -> str:
    columns = [
        Column("scenario", "scenario", "text"), Column("people", "people", "count"),
        Column("stimuli", "stimuli", "count"),
        Column("accuracy", "accuracy", "interval", 3),
        Column("sd over people", "sd", digits=3), Column("t", "t", digits=1),
        Column("df", "df", "count"), Column("p", "p", "p"),
        Column("lowest 2.5 %", "zone_low", digits=3),
        Column("highest 2.5 %", "zone_high", digits=3),
        Column("consistency", "consistency", digits=3),
    ]  # fmt: skip
    words = (
        "Accuracy of people, flagged sessions left out: mean over people, interval by drawing "
        "people; t against 0.5; consistency is the mean share of people who give a stimulus' "
        "more frequent answer"
    )
    return rows_table(found["by_scenario"], columns, words)


_ALIKE = {
    "kappa": "kappa, pairs",
    "correlation": "r, pairs",
    "split_half": "r, halves",
    "spearman_brown": "r, halves, Spearman-Brown",
}


def _agreement(found: Mapping[str, pd.DataFrame]) -> str:
    """Return a row a scenario: mean over pairs or halves, their middle 95 %, the interval of the
    mean.
    """
    rows = found["agreement"]
    cells, reasons = [], []
    for name in in_order(rows["scenario"]):
        line = [escape(name)]
        for measure in _ALIKE:
            row = rows[(rows["scenario"] == name) & (rows["measure"] == measure)].iloc[0]
            line.append(Column("", "mean", "interval", 3, "low", "high").cell(row))
            if measure in ("kappa", "correlation"):
                line.append(Column("", "mean", "interval", 3).cell(row).split(" ", 1)[-1])
            if row["reason"]:
                why = f"{name}, {_ALIKE[measure]}: {row['reason']}"
                reasons.append(f"<li>{escape(why)}</li>")
        cells.append(line)
    header = ["scenario", "kappa, pairs", "interval of the mean", "r, pairs",
              "interval of the mean", "r, halves", "r, halves, Spearman-Brown"]  # fmt: skip
    words = (
        "How alike people answer: mean and middle 95 % over all pairs of participants and over "
        "1000 random halves of them; the interval of the mean draws people"
    )
    notes = f'<ul class="notes">{"".join(reasons)}</ul>' if reasons else ""
    return table(header, cells, words) + notes


def _zones(rows: pd.DataFrame) -> str:
    columns = [
        Column("scenario", "scenario", "text"), Column("measure", "measure", "text"),
        Column("of", "of", "text"), Column("values", "values", "count"),
        Column("mean", "mean", digits=3), Column("2.5 %", "low", digits=3),
        Column("97.5 %", "high", digits=3), Column("undefined", "undefined", "count"),
    ]  # fmt: skip
    return rows_table(rows, columns)


def _biases(found: Mapping[str, pd.DataFrame]) -> str:
    yes = [
        Column("scenario", "scenario", "text"), Column("people", "people", "count"),
        Column("contact", "base_rate", digits=3), Column("say yes", "yes", digits=3),
        Column("yes less contact", "bias", "interval", 3), Column("d′", "d_prime", "interval"),
        Column("criterion", "criterion", "interval"),
    ]  # fmt: skip
    side = [
        Column("scenario", "scenario", "text"), Column("yes on the left", "yes_left", "count"),
        Column("yes on the right", "yes_right", "count"),
        Column("order unknown", "unknown", "count"),
        Column("left presses", "left", "interval", 3), Column("p", "p", "p"),
    ]  # fmt: skip
    practice = [
        Column("scenario", "scenario", "text"), Column("answers", "rows", "count"),
        Column("first half", "first_half", digits=3),
        Column("second half", "second_half", digits=3),
        Column("log odds per 100 trials", "b", "interval", 3, "low", "high"),
        Column("z", "z"), Column("p", "p", "p"),
    ]  # fmt: skip
    asked = [
        Column("question", "question", "text"), Column("sessions", "sessions", "count"),
        Column("test", "test", "text"), Column("statistic", "statistic"), Column("p", "p", "p"),
    ]  # fmt: skip
    who = [
        Column("question", "question", "text"), Column("answer", "answer", "text"),
        Column("sessions", "sessions", "count"), Column("share", "share", "percent"),
    ]  # fmt: skip
    return (
        rows_table(found["yes_bias"], yes, "Saying yes; a criterion below 0 leans to it")
        + rows_table(found["side_bias"], side, "Pressing the left button")
        + rows_table(found["learning"], practice, "Practice: being right, over the test trials")
        + rows_table(found["background_tests"], asked,
                     "Accuracy by who people are: exploratory, p not corrected")
        + details("Who took part", rows_table(found["background"], who))
    )  # fmt: skip


def _hypotheses(found: Mapping[str, pd.DataFrame]) -> str:
    rows = found["hypotheses"].assign(
        about=found["hypotheses"]["hypothesis"].map({k: v.about for k, v in HYPOTHESES.items()})
    )
    columns = [
        Column("hypothesis", "hypothesis", "text"), Column("scenario", "scenario", "text"),
        Column("stimuli", "stimuli", "count"), Column("left out", "left_out", "count"),
        Column("b", "b", "interval", 3, "low", "high"), Column("t", "t"),
        Column("df", "df", "count"), Column("p", "p", "p"), Column("r", "r"),
        Column("as predicted", "as_predicted", "text"),
    ]  # fmt: skip
    names = "; ".join(f"{name}: {h.about.lower()}" for name, h in HYPOTHESES.items())
    words = (
        f"The preregistered hypotheses by stimulus ({names}). Linear regression with an intercept "
        "for each scenario, standard errors HC3; the attributes are read off official names."
    )
    main = rows[rows["scenario"] == "all"] if (rows["scenario"] == "all").any() else rows
    whole = details("By scenario", rows_table(rows, columns)) if len(main) < len(rows) else ""
    return paragraph(words) + rows_table(main, columns) + whole


def measures(inputs: ReportInputs) -> str:
    """Return every measure of every model with its three intervals, and kappa among models."""
    if inputs.beside is None:
        return ""
    scores = inputs.beside.scores
    labels = {metric.name: metric.label for metric in measure_metrics()}
    rows = scores.assign(measure=scores["measure"].map(labels))
    rows = rows[rows["measure"] != ""]
    columns = [
        Column("model", "model", "text"), Column("scenario", "scenario", "text"),
        Column("measure", "measure", "text"), Column("stimuli", "stimuli", "count"),
        Column("value (people and stimuli drawn)", "value", "interval", 3, "low_both", "high_both"),
        Column("people drawn", "value", "interval", 3, "low_people", "high_people"),
        Column("stimuli drawn", "value", "interval", 3, "low_stimuli", "high_stimuli"),
        Column("lowest 2.5 % of people", "zone_low", digits=3),
        Column("highest 2.5 %", "zone_high", digits=3), Column("in zone", "in_zone", "text"),
    ]  # fmt: skip
    last = rows["scenario"].iloc[-1]
    shown = rows[rows["scenario"] == last].drop(columns="reason")
    words = "Measures with single participants: "
    words += f"mean over scenarios; {MORE}" if last == MEAN else last
    pairs = _mean_pairs(inputs.beside.pairs)
    return details("Every measure as a table", rows_table(shown, columns, words)) + details(
        "Cohen's kappa of models with each other", pairs
    )


def _mean_pairs(pairs: pd.DataFrame) -> str:
    """Return kappa of every two models, mean over scenarios, as a matrix."""
    if pairs.empty:
        return paragraph("One model alone makes no pair.")
    mean = pairs.groupby(["first", "second"], sort=False)["kappa"].mean()
    names = list(dict.fromkeys([*pairs["first"], *pairs["second"]]))
    marks = [chr(ord("A") + at) if at < 26 else str(at) for at in range(len(names))]
    rows = []
    for at, name in enumerate(names):
        cells = []
        for other in names:
            key = (name, other) if (name, other) in mean.index else (other, name)
            value = mean.get(key, np.nan)
            cells.append("" if name == other else number(value))
        rows.append([f"{marks[at]} {escape(name)}", *cells])
    return table(["", *marks], rows, "Mean over the scenarios in which it is defined")


# --- stimuli that fool people -------------------------------------------------------------------


def fooled(inputs: ReportInputs, links: Mapping[str, str]) -> str:
    """Return the stimuli that people get wrong more often than by guessing, with links to
    movies.
    """
    if inputs.people is not None:
        rows = inputs.people.tables["by_stimulus"]
    else:
        rows = inputs.comparison.stimuli.drop_duplicates("stimulus")
        rows = rows.rename(columns={"human_accuracy": "accuracy"})
    tail = below_chance(rows.reset_index(drop=True))
    counts = [
        [escape(name), str(len(own)), str(int(own["released"].sum())), str(int(own["exact"].sum()))]
        for name in in_order(tail["scenario"])
        if len(own := tail[tail["scenario"] == name])
    ]
    counts.append(["all", str(len(tail)), str(int(tail["released"].sum())),
                   str(int(tail["exact"].sum()))])  # fmt: skip
    header = ["scenario", "stimuli", "below chance, study's rule", "below chance, corrected"]
    low = tail[tail["released"] | tail["exact"]].sort_values(["accuracy", "stimulus"])
    cells = []
    for _, row in low.iterrows():
        cells.append([stimulus_link(row["stimulus"], links), escape(row["scenario"]),
                      number(row["accuracy"]), str(int(row["count"])),
                      "yes" if row["exact"] else "no"])  # fmt: skip
    listing = table(["stimulus", "scenario", "accuracy", "people", "after correction"], cells)
    one_by_one = details(f"The {len(cells)} stimuli one by one", listing) if cells else ""
    return table(header, counts) + one_by_one
