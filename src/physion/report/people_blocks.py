"""The parts of the page about people: how well, how alike, who was left out and what it changes."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np
import pandas as pd

from physion.analysis.difficulty import below_chance
from physion.analysis.exclusions import RULES, ExclusionRules
from physion.analysis.hypotheses import HYPOTHESES
from physion.analysis.tables import MEAN, in_order
from physion.report.blocks import (
    Column,
    details,
    number,
    paragraph,
    rows_table,
    stimulus_link,
    table,
    undefined,
)
from physion.report.blocks import people as averages
from physion.report.inputs import ReportInputs
from physion.report.people_results import PeopleResults

MORE = "every scenario, and why an interval is missing, is in tables/measures.csv"

_MEASURES = {
    "accuracy": "accuracy",
    "difference": "accuracy less people's",
    "r": "r",
    "rmsd": "RMSD",
    "kappa": "kappa",
    "kappa_gap": "kappa less people's",
    "error_consistency": "error consistency",
}


def people(inputs: ReportInputs, shown: Mapping[str, str]) -> str:
    """How well and how alike people answer."""
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
    """A row a scenario: mean over pairs or halves, their middle 95 %, the interval of the mean."""
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
    """Every measure of every model with its three intervals, and models among themselves."""
    if inputs.beside is None:
        return ""
    scores = inputs.beside.scores
    rows = scores[scores["measure"].isin(_MEASURES)]
    rows = rows.assign(measure=rows["measure"].map(_MEASURES))
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
    """Kappa of every two models, mean over scenarios, as a matrix."""
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
    """The stimuli in the tail, with links to their movies."""
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


# --- sessions -----------------------------------------------------------------------------------


def sessions(inputs: ReportInputs) -> str:
    """Who was flagged, by which rule, and what changes with flagged sessions."""
    if inputs.people is None:
        return ""
    found = inputs.people.tables
    parts = [paragraph(rules_in_words(inputs.people.rules)), _flag_counts(found["flag_counts"])]
    parts.append(_with_and_without(inputs))
    if len(found["flag_effects"]):
        columns = [
            Column("rule", "term", "text"),
            Column("log odds of being right", "b", "interval", 3, "low", "high"),
            Column("z", "z"), Column("p", "p", "p"), Column("answers", "rows", "count"),
            Column("participants", "clusters", "count"),
        ]  # fmt: skip
        words = (
            "Effect of a flag on being right, over all sessions: logistic regression with an "
            "intercept for each scenario, standard errors clustered by participant. Low accuracy "
            "is itself a reason to be flagged, so its effect, and that of “flagged”, is there by "
            "construction"
        )
        parts.append(rows_table(found["flag_effects"], columns, words))
    return "\n".join(parts)


def _flag_counts(counts: pd.DataFrame) -> str:
    rules = list(dict.fromkeys(counts["rule"]))
    rules = [name for name in rules if name not in ("flagged", "kept", "all")]
    rules += ["flagged", "kept", "all"]
    wide = counts.pivot(index="scenario", columns="rule", values="sessions").fillna(0)
    names = in_order(counts["scenario"])
    rows = [[escape(name), *(str(int(wide.loc[name, rule])) for rule in rules)] for name in names]
    rows.append(["all", *(str(int(wide[rule].sum())) for rule in rules)])
    heads = [name.replace("_", " ") for name in rules]
    words = "Sessions that each rule flags; one session can be flagged by several rules"
    return table(["scenario", *heads], rows, words)


def _with_and_without(inputs: ReportInputs) -> str:
    """People's accuracy, and the models' scores, without and with the flagged sessions."""
    assert inputs.people is not None
    rows = inputs.people.tables["with_and_without"]
    columns = [Column("people", "people", "count"), Column("accuracy", "accuracy", "interval", 3)]
    cells = []
    for name in dict.fromkeys(rows["scenario"]):
        line = [escape(str(name))]
        for which in ("unflagged", "complete"):
            own = rows[(rows["scenario"] == name) & (rows["sessions"] == which)]
            line += [c.cell(own.iloc[0]) for c in columns] if len(own) else [undefined("none"), ""]
        cells.append(line)
    header = ["scenario", "people, unflagged", "accuracy", "people, all complete", "accuracy"]
    found = table(header, cells, "Accuracy of people without flagged sessions and with them")
    if inputs.comparison_all is None:
        return found
    with_all = inputs.comparison_all.scores
    cells = []
    for _, row in inputs.comparison.scores.iterrows():
        if row["scenario"] != MEAN:
            continue
        other = with_all[(with_all["agent"] == row["agent"]) & (with_all["scenario"] == MEAN)]
        line = [escape(str(row["agent"]))]
        for key in ("difference", "r"):
            for own in (row, other.iloc[0]):
                line.append(Column("", key, "interval").cell(own))
        cells.append(line)
    header = ["model", "less people, unflagged", "with all complete", "r, unflagged",
              "with all complete"]  # fmt: skip
    return found + table(
        header, cells, "Models, mean over scenarios: accuracy less people's, and r"
    )


def rules_in_words(rules: ExclusionRules) -> str:
    """The rules of a set with their thresholds."""
    words = []
    if rules.streak_percentile is not None:
        words.append(
            f"a streak longer than {rules.streak_percentile:g} % of simulated coin tosses have"
        )
    elif rules.streak_over is not None:
        words.append(f"a streak of one answer over {rules.streak_over:g}")
    if rules.alternation is not None:
        words.append(f"{rules.alternation} or more alternating answers in a row")
    if rules.familiarization_share is not None:
        words.append(f"{rules.familiarization_share:.0%} or fewer of the practice trials right")
    if rules.accuracy_sd is not None:
        words.append(f"accuracy {rules.accuracy_sd:g} sd below the {rules.accuracy_centre}")
    if rules.rt_sd is not None:
        words.append(f"{rules.rt_summary} log response time {rules.rt_sd:g} sd above the median")
    return (
        f"Rules “{rules.name}”: {'; '.join(words)}; not all trials answered; not the participant's "
        "first session. Rules flag; the main analysis leaves flagged sessions out, and the tables "
        "below say what changes with them. Centres and standard deviations are those of the "
        f"scenario's complete sessions (sd with {'n − 1' if rules.ddof else 'n'})."
    )


def dropped(found: PeopleResults) -> str:
    """Answers left out, by step and reason."""
    rows = found.tables["left_out"]
    if rows.empty:
        return paragraph("Nothing.")
    keys = ["step", "reason"]
    totals = rows.groupby(keys, sort=False)[["sessions", "rows"]].sum().reset_index()
    columns = [Column("step", "step", "text"), Column("reason", "reason", "text"),
               Column("sessions", "sessions", "count"),
               Column("answers", "rows", "count")]  # fmt: skip
    cells = [[column.cell(row) for column in columns] for _, row in totals.iterrows()]
    return table([column.heading for column in columns], cells)


def methods(inputs: ReportInputs) -> dict[str, str]:
    """The choices that participant-level answers bring, in words."""
    if inputs.people is None:
        return {}
    return {
        "Exclusions": rules_in_words(inputs.people.rules),
        "Rules applied": ", ".join(name.replace("_", " ") for name in RULES),
        "Intervals with participants": "by drawing participants, stimuli or both with replacement, "
        "1000 draws; tables/measures.csv has all three; figures and tables of kappa show both",
        "Human zone": "2.5th to 97.5th percentile of single participants of the scenario, each "
        "beside the others (r, kappa) or the outcomes (accuracy); only for scenarios of which all "
        "stimuli that people saw are predicted (accuracy)",
    }
