"""Parts of the page about people: accuracy, agreement, biases, difficulty, sessions left out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from physion.analysis.comparison import Comparison
from physion.analysis.metrics import measure_metrics
from physion.analysis.people.effects import HYPOTHESES, below_chance_level
from physion.analysis.people.exclusions import RULES, ExclusionRules, streak_limit
from physion.analysis.people.results import (
    PeopleResults,
)
from physion.analysis.scores import TWO_PEOPLE
from physion.analysis.tables import MEAN, in_order
from physion.core.html import Markup, joined
from physion.report.html import (
    BASELINES,
    PageColumn,
    details,
    heading,
    interval,
    notes,
    number,
    paragraph,
    rows_table,
    spread,
    stimulus_link,
    table,
    undefined,
)
from physion.report.inputs import ReportInputs

# --- accuracy, agreement, biases, difficulty ----------------------------------------------------

_NO_ZONE = "known only of scenarios of which all stimuli that single participants saw are predicted"


def averages(comparison: Comparison) -> Markup:
    """Return the table of people by scenario."""
    header = ["scenario", "stimuli", "people", "base rate", "say yes", "accuracy"]
    header += ["participants drawn", "zone"]
    rows = []
    for _, row in comparison.people.assign(reason="").iterrows():
        zone = f"{number(row['zone_low'])} to {number(row['zone_high'])}"
        rows.append(
            [
                str(row["scenario"]),
                str(row["stimuli"]),
                number(row["people"], 0),
                number(row["base_rate"]),
                number(row["yes"]),
                interval(row, "accuracy"),
                spread(row["bootstrap_low"], row["bootstrap_high"])
                if np.isfinite(row["bootstrap_low"])
                else undefined(_NO_ZONE),
                zone if np.isfinite(row["zone_low"]) else undefined(_NO_ZONE),
                number(row["reliability"], 3),
                number(row["ceiling"], 3),
            ]
        )
    words = "People; intervals of the accuracy by drawing stimuli, and by drawing participants"
    return table([*header, "reliability", "ceiling of r"], rows, words)


MORE = "every scenario, and why an interval is missing, is in tables/measures.csv"


def people(inputs: ReportInputs) -> Markup:
    """Return accuracy of and agreement among people."""
    if not inputs.comparison.has_people:
        return Markup()
    parts = [averages(inputs.comparison)]
    if inputs.people is None:
        return joined(parts)
    zones = Markup() if inputs.with_people is None else _zones(inputs.with_people.zones)
    on_predicted = averages(inputs.comparison)
    return joined([
        people_only(inputs.people, zones),
        details("People on the stimuli that any model predicts", on_predicted),
    ])  # fmt: skip


def people_only(people: PeopleResults, zones: str = "") -> Markup:
    """Return the parts that need no predictions; ``zones``: table of what single people reach."""
    tables = people.tables
    return joined([
        _accuracy(tables),
        _conditions(tables),
        _agreement(tables),
        *([details("What single people reach", zones)] if zones else []),
        heading("Inclinations, practice, background"),
        _biases(tables),
        heading("What makes a stimulus hard"),
        _hypotheses(people),
        details("Stimuli as items of a test", _items(tables["items"])),
    ])  # fmt: skip


def _conditions(tables: Mapping[str, pd.DataFrame]) -> Markup:
    """Return the table of between-subject conditions, or nothing without any."""
    if tables["by_condition"].empty:
        return Markup()
    columns = [
        PageColumn("condition", "condition", "text"),
        PageColumn("scenario", "scenario", "text"),
        PageColumn("people", "people", "count"),
        PageColumn("accuracy", "accuracy", "interval", 3),
        PageColumn("sd over people", "sd", digits=3),
    ]
    words = "Accuracy by condition; its test is under “Accuracy by who people are”"
    return rows_table(tables["by_condition"], columns, words)


def _accuracy(tables: Mapping[str, pd.DataFrame]) -> Markup:
    columns = [
        PageColumn("scenario", "scenario", "text"),
        PageColumn("people", "people", "count"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn("accuracy", "accuracy", "interval", 3),
        PageColumn("sd over people", "sd", digits=3),
        PageColumn("t", "t", digits=1),
        PageColumn("df", "df", "count"),
        PageColumn("p", "p", "p"),
        PageColumn("lowest 2.5 %", "zone_low", digits=3),
        PageColumn("highest 2.5 %", "zone_high", digits=3),
        PageColumn("consistency", "consistency", digits=3),
    ]
    words = (
        "Accuracy of people, flagged sessions left out: mean over people, interval by drawing "
        "people; t against 0.5; consistency is the mean fraction of people who give a stimulus' "
        "more frequent answer"
    )
    rows = tables["by_scenario"]
    # Spread, test and zone are of the people of one scenario: the mean has none.
    cells = [
        ["" if row["scenario"] == MEAN and pd.isna(row[c.key]) else c.cell(row) for c in columns]
        for _, row in rows.iterrows()
    ]
    return table([column.heading for column in columns], cells, words)


_ALIKE = {
    "kappa": "kappa, pairs",
    "correlation": "r, pairs",
    "split_half": "r, halves",
    "spearman_brown": "r, halves, Spearman-Brown",
}


def _agreement(tables: Mapping[str, pd.DataFrame]) -> Markup:
    """Return one row per scenario: mean over pairs or halves, central 95 % range, confidence
    interval.
    """
    rows = tables["agreement"]
    cells, reasons = [], []
    for name in in_order(rows["scenario"]):
        line = [str(name)]
        for measure in _ALIKE:
            row = rows[(rows["scenario"] == name) & (rows["measure"] == measure)].iloc[0]
            line.append(PageColumn("", "mean", "interval", 3, "low", "high").cell(row))
            if measure in ("kappa", "correlation"):
                line.append(spread(row["mean_low"], row["mean_high"], 3))
            if row["reason"]:
                reasons.append(f"{name}, {_ALIKE[measure]}: {row['reason']}")
        cells.append(line)
    header = [
        "scenario",
        "kappa, pairs",
        "interval of the mean",
        "r, pairs",
        "interval of the mean",
        "r, halves",
        "r, halves, Spearman-Brown",
    ]
    words = (
        "How alike people answer: mean and middle 95 % over all pairs of participants and over "
        "1000 random halves of them; the interval of the mean draws people"
    )
    return table(header, cells, words) + notes(reasons)


def _items(rows: pd.DataFrame) -> Markup:
    """Return item statistics by scenario, and the stimuli with the lowest item-rest correlation."""
    groups = rows.assign(low=rows["item_rest"] < 0).groupby("scenario", sort=False)
    summary = groups.agg(
        stimuli=("stimulus", "size"),
        difficulty=("difficulty", "mean"),
        item_rest=("item_rest", "mean"),
        low=("low", "sum"),
    ).reset_index()
    columns = [
        PageColumn("scenario", "scenario", "text"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn("difficulty", "difficulty", digits=3),
        PageColumn("item-rest r", "item_rest", digits=3),
        PageColumn("below 0", "low", "count"),
    ]
    words = (
        "Difficulty: fraction who are right. Item-rest r: over people, of being right at a "
        "stimulus with the fraction of right answers elsewhere; means over stimuli. Every "
        "stimulus: tables/people_items.csv"
    )
    each = [
        PageColumn("stimulus", "stimulus", "text"),
        PageColumn("people", "people", "count"),
        *columns[2:4],
    ]
    lowest = rows[rows["item_rest"] < 0].sort_values(["item_rest", "stimulus"]).head(10)
    listing = rows_table(lowest, each, "The lowest item-rest r below 0, at most ten")
    return rows_table(summary, columns, words) + (listing if len(lowest) else "")


def _zones(rows: pd.DataFrame) -> Markup:
    columns = [
        PageColumn("scenario", "scenario", "text"),
        PageColumn("measure", "measure", "text"),
        PageColumn("of", "of", "text"),
        PageColumn("values", "values", "count"),
        PageColumn("mean", "mean", digits=3),
        PageColumn("2.5 %", "low", digits=3),
        PageColumn("97.5 %", "high", digits=3),
        PageColumn("undefined", "undefined", "count"),
    ]
    return rows_table(rows, columns)


def _biases(tables: Mapping[str, pd.DataFrame]) -> Markup:
    yes = [
        PageColumn("scenario", "scenario", "text"),
        PageColumn("people", "people", "count"),
        PageColumn("contact", "base_rate", digits=3),
        PageColumn("say yes", "yes", digits=3),
        PageColumn("yes less contact", "bias", "interval", 3),
        PageColumn("d′", "d_prime", "interval"),
        PageColumn("criterion", "criterion", "interval"),
    ]
    side = [
        PageColumn("scenario", "scenario", "text"),
        PageColumn("yes on the left", "yes_left", "count"),
        PageColumn("yes on the right", "yes_right", "count"),
        PageColumn("order unknown", "unknown", "count"),
        PageColumn("left presses", "left", "interval", 3),
        PageColumn("p", "p", "p"),
    ]
    questions = [
        PageColumn("question", "question", "text"),
        PageColumn("sessions", "sessions", "count"),
        PageColumn("test", "test", "text"),
        PageColumn("statistic", "statistic"),
        PageColumn("p", "p", "p"),
    ]
    background = [
        PageColumn("question", "question", "text"),
        PageColumn("answer", "answer", "text"),
        PageColumn("sessions", "sessions", "count"),
        PageColumn("fraction", "fraction", "percent"),
    ]
    return (
        rows_table(tables["yes_bias"], yes, "Saying yes; a criterion below 0 leans to it")
        + rows_table(tables["side_bias"], side, "Pressing the left button")
        + rows_table(
            tables["background_tests"],
            questions,
            "Accuracy by who people are: exploratory, p not corrected",
        )
        + details("Who took part", rows_table(tables["background"], background))
    )


def describe_attributes(people: PeopleResults) -> str:
    """Describe where the attributes of the stimuli come from."""
    sources = people.tables["attributes"]["source"].value_counts()
    stimuli = len(people.tables["by_stimulus"])
    return (
        f"of {stimuli} stimuli {sources.get('table', 0)} by the table that was given, "
        f"{sources.get('name', 0)} by their official names, {stimuli - sources.sum()} not known"
    )


def _hypotheses(results: PeopleResults) -> Markup:
    tables = results.tables
    rows = tables["hypotheses"].assign(
        about=tables["hypotheses"]["hypothesis"].map({k: v.about for k, v in HYPOTHESES.items()})
    )
    columns = [
        PageColumn("hypothesis", "hypothesis", "text"),
        PageColumn("scenario", "scenario", "text"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn("left out", "left_out", "count"),
        PageColumn("b", "b", "interval", 3, "low", "high"),
        PageColumn("t", "t"),
        PageColumn("df", "df", "count"),
        PageColumn("p", "p", "p"),
        PageColumn("r", "r"),
        PageColumn("as predicted", "as_predicted", "text"),
    ]
    names = "; ".join(f"{name}: {h.about.lower()}" for name, h in HYPOTHESES.items())
    words = (
        f"The preregistered hypotheses by stimulus ({names}). Linear regression with an intercept "
        "for each scenario, standard errors HC3. As predicted: yes if b has the predicted sign and "
        "p < 0.05, opposite if it has the other sign and p < 0.05, else not shown; p are not "
        f"corrected for the number of tests. Attributes: {describe_attributes(results)}."
    )
    main = rows[rows["scenario"] == "all"] if (rows["scenario"] == "all").any() else rows
    whole = details("By scenario", rows_table(rows, columns)) if len(main) < len(rows) else ""
    return paragraph(words) + rows_table(main, columns) + whole + _attributes(tables)


def _attributes(tables: Mapping[str, pd.DataFrame]) -> Markup:
    """Return accuracy by every attribute, by itself and together, over all scenarios."""
    rows = tables["attribute_effects"]
    main = rows[rows["scenario"] == "all"] if (rows["scenario"] == "all").any() else rows
    columns = [
        PageColumn("attribute", "attribute", "text"),
        PageColumn("level", "level", "text"),
        PageColumn("scenario", "scenario", "text"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn("b", "b", "interval", 3, "low", "high"),
        PageColumn("by one sd", "b_sd", digits=3),
        PageColumn("t", "t"),
        PageColumn("p, all levels", "p_term", "p"),
        PageColumn("Holm", "p_holm", "p"),
        PageColumn("R²", "r2"),
    ]
    parts = []
    for fit, words in (
        ("single", "Each attribute by itself"),
        ("together", "All attributes together: their linear combination"),
    ):
        own = main[main["fit"] == fit]
        parts.append(rows_table(own, columns, f"{words}; every scenario: {_ATTRIBUTE_EFFECTS}"))
    words = (
        "Exploratory, as preregistered: people's accuracy on a stimulus by every attribute that is "
        "known, with an intercept for each scenario and standard errors HC3; R² of the differences "
        "within scenarios; p corrected over the attributes by Holm."
    )
    return details("Accuracy by attributes of stimuli", joined([paragraph(words), *parts]))


_ATTRIBUTE_EFFECTS = "tables/people_attribute_effects.csv"


def measures(inputs: ReportInputs) -> Markup:
    """Return every measure of every model with its three intervals, and kappa among models."""
    if inputs.with_people is None:
        return Markup()
    scores = inputs.with_people.scores
    labels = {metric.name: metric.label for metric in measure_metrics()}
    rows = scores.assign(measure=scores["measure"].map(labels))
    rows = rows[rows["measure"] != ""]
    columns = [
        PageColumn("model", "model", "text"),
        PageColumn("scenario", "scenario", "text"),
        PageColumn("measure", "measure", "text"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn(
            "value (people and stimuli drawn)", "value", "interval", 3, "low_both", "high_both"
        ),
        PageColumn("people drawn", "value", "interval", 3, "low_people", "high_people"),
        PageColumn("stimuli drawn", "value", "interval", 3, "low_stimuli", "high_stimuli"),
        PageColumn(
            "bootstrap of people", "value", "interval", 3, "low_bootstrap", "high_bootstrap"
        ),
        PageColumn("lowest 2.5 % of people", "zone_low", digits=3),
        PageColumn("highest 2.5 %", "zone_high", digits=3),
        PageColumn("in zone", "in_zone", "text"),
    ]
    last = rows["scenario"].iloc[-1]
    shown = rows[rows["scenario"] == last].drop(columns="reason")
    words = "Measures with single participants: "
    words += f"mean over scenarios; {MORE}" if last == MEAN else last
    pairs = _mean_pairs(inputs.with_people.pairs)
    return details("Every measure as a table", rows_table(shown, columns, words)) + details(
        "Cohen's kappa of models with each other", pairs
    )


def _mean_pairs(pairs: pd.DataFrame) -> Markup:
    """Return kappa of every two models, mean over scenarios, as a matrix."""
    if pairs.empty:
        return paragraph("One model makes no pair.")
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
        rows.append([f"{marks[at]} {name}", *cells])
    return table(["", *marks], rows, "Mean over the scenarios in which it is defined")


# --- stimuli that fool people -------------------------------------------------------------------


def fooled(inputs: ReportInputs, links: Mapping[str, str]) -> Markup:
    """Return the stimuli that people get wrong more often than by guessing, with links to
    movies.
    """
    if inputs.people is not None:
        return fooled_by(inputs.people.tables["by_stimulus"], links)
    rows = inputs.comparison.stimuli.drop_duplicates("stimulus")
    return fooled_by(rows.rename(columns={"human_accuracy": "accuracy"}), links)


def fooled_by(rows: pd.DataFrame, links: Mapping[str, str]) -> Markup:
    """Return the stimuli among these that people get wrong more often than by guessing."""
    tail = below_chance_level(rows.reset_index(drop=True))
    counts = [
        [
            str(name),
            str(len(subset)),
            str(int(subset["released"].sum())),
            str(int(subset["exact"].sum())),
        ]
        for name in in_order(tail["scenario"])
        if len(subset := tail[tail["scenario"] == name])
    ]
    counts.append(
        ["all", str(len(tail)), str(int(tail["released"].sum())), str(int(tail["exact"].sum()))]
    )
    header = ["scenario", "stimuli", "below chance, study's rule", "below chance, corrected"]
    low = tail[tail["released"] | tail["exact"]].sort_values(["accuracy", "stimulus"])
    cells = []
    for _, row in low.iterrows():
        cells.append(
            [
                stimulus_link(row["stimulus"], links),
                str(row["scenario"]),
                number(row["accuracy"]),
                str(int(row["count"])),
                "yes" if row["exact"] else "no",
            ]
        )
    listing = table(["stimulus", "scenario", "accuracy", "people", "after correction"], cells)
    one_by_one = details(f"The {len(cells)} stimuli one by one", listing) if cells else ""
    return table(header, counts) + one_by_one


# --- sessions: which were flagged, and the effect of leaving them out ---------------------------


def sessions(inputs: ReportInputs) -> Markup:
    """Return which sessions were flagged, by which rule, and the effect of flagged sessions."""
    if inputs.people is None:
        return Markup()
    return sessions_only(inputs.people, _models_with_and_without(inputs))


def sessions_only(people: PeopleResults, models: str = "") -> Markup:
    """Return the same without models; ``models``: their scores without and with these sessions."""
    result = people.tables
    parts = [paragraph(describe_rules(people.rules))]
    parts.append(_flag_counts(result["flag_counts"]))
    parts.append(_with_and_without(people) + models)
    return joined(parts)


def _flag_counts(counts: pd.DataFrame) -> Markup:
    rules = list(dict.fromkeys(counts["rule"]))
    rules = [name for name in rules if name not in ("flagged", "kept", "all")]
    rules += ["flagged", "kept", "all"]
    wide = counts.pivot(index="scenario", columns="rule", values="sessions").fillna(0)
    names = in_order(counts["scenario"])
    rows = [[str(name), *(str(int(wide.loc[name, rule])) for rule in rules)] for name in names]
    rows.append(["all", *(str(int(wide[rule].sum())) for rule in rules)])
    heads = [name.replace("_", " ") for name in rules]
    words = "Sessions that each rule flags; one session can be flagged by several rules"
    return table(["scenario", *heads], rows, words)


def _with_and_without(people: PeopleResults) -> Markup:
    """Return people's accuracy without and with the flagged sessions."""
    rows = people.tables["with_and_without"]
    columns = [
        PageColumn("people", "people", "count"),
        PageColumn("accuracy", "accuracy", "interval", 3),
    ]
    cells = []
    for name in dict.fromkeys(rows["scenario"]):
        line = [str(name)]
        for which in ("unflagged", "complete"):
            subset = rows[(rows["scenario"] == name) & (rows["sessions"] == which)]
            line += (
                [c.cell(subset.iloc[0]) for c in columns]
                if len(subset)
                else [undefined("none"), ""]
            )
        cells.append(line)
    header = ["scenario", "people, unflagged", "accuracy", "people, all complete", "accuracy"]
    return table(header, cells, "Accuracy of people without flagged sessions and with them")


def _models_with_and_without(inputs: ReportInputs) -> Markup:
    """Return the models' scores without and with the flagged sessions."""
    if inputs.comparison_all is None:
        return Markup()
    with_all = inputs.comparison_all.all_scores
    grouped: dict[str, list[list[str]]] = {"model": [], "baseline": []}
    for _, row in inputs.comparison.all_scores.iterrows():
        if row["scenario"] != MEAN or row["model"] == TWO_PEOPLE:
            continue
        other = with_all[(with_all["model"] == row["model"]) & (with_all["scenario"] == MEAN)]
        line = [str(row["model"])]
        for key in ("difference", "r"):
            column = PageColumn("", key, "interval")
            line += [column.cell(subset) for subset in (row, other.iloc[0])]
        grouped[row["kind"]].append(line)
    header = [
        "model",
        "less people, unflagged",
        "with all complete",
        "r, unflagged",
        "with all complete",
    ]
    return table(
        header,
        grouped["model"],
        "Models, mean over scenarios: accuracy less people's, and r",
        (BASELINES, grouped["baseline"]),
    )


def describe_rules(rules: ExclusionRules) -> str:
    """Describe the rules of a set with their thresholds."""
    words = []
    if rules.streak_percentile is not None:
        limits = ", ".join(
            f"{streak_limit(n, rules.streak_percentile)} for {n} trials" for n in (150, 60)
        )
        words.append(
            "a streak of one answer longer than in "
            f"{rules.streak_percentile:g} % of as many fair coin tosses (over {limits})"
        )
    if rules.alternation is not None:
        words.append(f"{rules.alternation} or more alternating answers in a row")
    if rules.familiarization_fraction is not None:
        words.append(f"{rules.familiarization_fraction:.0%} or fewer of the practice trials right")
    if rules.accuracy_sd is not None:
        words.append(f"accuracy {rules.accuracy_sd:g} sd below the {rules.accuracy_centre}")
    if rules.rt_sd is not None:
        words.append(f"{rules.rt_summary} log response time {rules.rt_sd:g} sd above the median")
    if rules.server:
        words.append(
            "implausible, replayed or failing checks, as the experiment's server found (not "
            "preregistered)"
        )
    return (
        f"Rules “{rules.name}”: {'; '.join(words)}; not all trials answered; not the participant's "
        "first session. Rules flag; the main analysis leaves flagged sessions out, and the tables "
        "below say what changes with them. Centres and standard deviations are taken over the "
        f"scenario's complete sessions (sd with {'n − 1' if rules.ddof else 'n'})."
    )


def dropped(result: PeopleResults) -> Markup:
    """Return counts of excluded answers, by step and reason."""
    rows = result.tables["left_out"]
    if rows.empty:
        return paragraph("Nothing.")
    keys = ["step", "reason"]
    totals = rows.groupby(keys, sort=False)[["sessions", "rows"]].sum().reset_index()
    columns = [
        PageColumn("step", "step", "text"),
        PageColumn("reason", "reason", "text"),
        PageColumn("sessions", "sessions", "count"),
        PageColumn("answers", "rows", "count"),
    ]
    cells = [[column.cell(row) for column in columns] for _, row in totals.iterrows()]
    return table([column.heading for column in columns], cells)


def rules_text(people: PeopleResults) -> dict[str, str]:
    """Return the exclusion rules as text."""
    return {
        "Exclusions": describe_rules(people.rules),
        "Rules applied": ", ".join(name.replace("_", " ") for name in RULES),
    }
