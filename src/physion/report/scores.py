"""Parts of the page about models: what they were given, scores, tests, outcomes that differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from physion.analysis.compare import tidy_scores
from physion.analysis.comparison import SETTING, Comparison
from physion.analysis.metrics import BEYOND_OUTCOME, Metric, score_metrics
from physion.analysis.model_tests import MixedTable, permutations_of
from physion.analysis.results import (
    MARKED,
    fitted_elsewhere,
    frames_with_benchmark,
    says_frames,
    scenarios_of_rows,
)
from physion.analysis.scores import AVERAGES, TWO_PEOPLE, runs_table, shown_average
from physion.analysis.tables import MEAN, POOLED, in_order
from physion.core.html import Markup, joined
from physion.report.html import (
    BASELINES,
    MACROS,
    NO_VALUE,
    PageColumn,
    compared,
    definition_list,
    details,
    heading,
    interval,
    listed,
    notes,
    number,
    paragraph,
    percent,
    plural,
    rows_table,
    stimulus_link,
    table,
    undefined,
)
from physion.report.inputs import ReportInputs

WITHOUT = "none"
"""Value of the column *Init* of models without weights."""
INPUT_WORDS = {
    "rgb": "the pixels of the movie",
    "ids": "which object every pixel belongs to",
    "depth": "the distance of every pixel",
    "boxes": "a box around every object",
    "camera": "the camera",
    "state": "the true state of the scene: shapes, motion and, for models that use them, masses",
    "outcomes": "the outcome itself",
    "answers of people": "the answers of people",
    "base rate": "nothing of the trial but how often contact occurs",
}
"""Words for the values of the column *Inputs* of the predictions."""


def inputs_sentence(inputs: ReportInputs) -> str:
    """Return what each model was given, the models of equal inputs together; "" if none says so."""
    groups: dict[str, list[str]] = {}
    for model in dict.fromkeys(inputs.comparison.stimuli["base_model"].astype(str)):
        groups.setdefault(inputs.model_inputs.get(model, ""), []).append(model)
    unknown = groups.pop("", [])
    if not groups:
        return ""
    parts = [f"{listed(models)}: {_describe(given)}" for given, models in groups.items()]
    if unknown:
        parts.append(f"{listed(unknown)}: not stated")
    people = "People saw the movie. " if inputs.comparison.has_people else ""
    return f"{people}What each model was given: {'; '.join(parts)}."


def weights_sentence(inputs: ReportInputs) -> str:
    """Return the initial weights of each model that has any; "" if there is none."""
    groups: dict[str, list[str]] = {}
    for model in dict.fromkeys(inputs.comparison.stimuli["base_model"].astype(str)):
        groups.setdefault(inputs.model_weights.get(model, WITHOUT), []).append(model)
    groups.pop(WITHOUT, None)
    if not groups:
        return ""
    parts = [f"{listed(models)}: {weights}" for weights, models in groups.items()]
    return f"Weights that each network started from: {'; '.join(parts)}."


def _describe(given: str) -> str:
    names = [name.strip() for name in given.split(",")]
    return listed([INPUT_WORDS.get(name, name) for name in names])


# --- the table of results ------------------------------------------------------------------------


def results(inputs: ReportInputs) -> Markup:
    """Return the table of results: people first, then all others by accuracy."""
    rows = inputs.results()
    measures = {
        "accuracy": "accuracy", "r with people": "r", "kappa": "kappa",
        "r beyond the outcome": "beyond",
    }  # fmt: skip
    chosen = measures if inputs.comparison.has_people else {"accuracy": "accuracy"}
    known = {"frames": frames_with_benchmark(rows)} if says_frames(rows) else {}
    known |= {"check": list(rows["check"])} if (rows["check"] != "").any() else {}
    known |= {"scenarios": partial} if (partial := scenarios_of_rows(rows)) else {}
    cells = [
        [str(row["row"]), str(row["given"]), *(of[k] for of in known.values()),
         *(_result(row, key) for key in chosen.values())]
        for k, (_, row) in enumerate(rows.iterrows())
    ]  # fmt: skip
    published = (rows["source"] != "").any()
    sources = "; ".join(dict.fromkeys(rows.loc[rows["source"] != "", "source"]))
    caption = AVERAGES[shown_average(inputs.comparison.all_scores)].capitalize()
    columns = ["", "given", *known, *chosen]
    listing = table(columns, cells, f"{caption}, by accuracy")
    notes = [f"{MARKED} ({sources})."] if published else []
    notes += [f"{line}." for line in fitted_elsewhere(rows)]
    return listing + Markup().join(paragraph(note, "note") for note in notes)


def _result(row: pd.Series, key: str) -> str:
    """Return a number of the table of results; of published ones the intervals are not known."""
    if row["source"]:
        return "" if pd.isna(row[key]) else number(row[key])
    return interval(row, key)


# --- scores, with baselines below the models ----------------------------------------------------

_SAME_EVENT = ("accuracy_simulated", "r_same")
"""Metrics that say something only where a simulated outcome is not the official one."""

_LIKENESS = ("r", "kappa_from_averages")
"""Metrics of likeness to people, which those beyond the outcome are read next to."""

_BASELINES = (
    "The recorded outcome answers as a perfect simulator would. The majority of people answers "
    "what most of them did: no yes or no agrees with them more often, so its kappa is the ceiling. "
    "One person with another: what a person reaches."
)

_BEYOND = (
    "Accurate models correlate with people simply because people are accurate. These "
    "numbers remove that part: a model that resembles people only by the outcome has 0. Kappa "
    "beyond the outcome supposes that half of the answers are yes, and is too low where most "
    "outcomes are alike; kappa within outcomes is right there too."
)


def scores(comparison: Comparison) -> Markup:
    """Return all tables of scores: averages, beyond the outcome, later contacts."""
    plain = shown_metrics(comparison, beyond=False)
    parts = [
        paragraph(_BASELINES) if comparison.has_people else Markup(),
        *_averages(comparison, plain),
    ]
    if comparison.has_people:
        parts += [heading("Beyond the outcome"), paragraph(_BEYOND), *_beyond(comparison)]
    parts += [heading("Without contacts in the observed part"), _later(comparison)]
    return joined(parts)


def _averages(comparison: Comparison, metrics: Sequence[Metric]) -> list[Markup]:
    """Return the average that is shown first, as on the terminal, then the other one, closed."""
    scores = comparison.all_scores
    first = shown_average(scores)
    (other,) = set(AVERAGES) - {first}
    return [
        scores_table(scores, first, metrics, AVERAGES[first].capitalize()),
        details(AVERAGES[other].capitalize(), scores_table(scores, other, metrics)),
    ]


def _beyond(comparison: Comparison) -> list[Markup]:
    beyond = shown_metrics(comparison, beyond=True)
    tables = [
        *_averages(comparison, beyond),
    ]
    for metric in score_metrics():
        if metric.name in BEYOND_OUTCOME:
            title = f"By scenario: {metric.heading}"
            tables.append(details(title, matrix(comparison, metric.name)))
    return tables


def _later(comparison: Comparison) -> Markup:
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
    first = shown_average(comparison.later)
    caption = AVERAGES[first].capitalize()
    return paragraph(words) + scores_table(comparison.later, first, chosen, caption)


def shown_metrics(comparison: Comparison, beyond: bool) -> list[Metric]:
    """Return the metrics of a table that say something about this comparison.

    ``beyond``: with the measures of likeness also the measures beyond the outcome, or all others.
    Without people the measures that need them are left out, and those about simulated outcomes if
    all simulated outcomes are the official ones.
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
) -> Markup:
    """Return a table of scores: one row per model, the metrics, and after r its noise ceiling.

    Parameters
    ----------
    scores
        As `Comparison.all_scores`; baselines follow the models as a group.
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
    lines: dict[str, list[list[str]]] = {"model": [], "baseline": []}
    for _, row in rows.iterrows():
        line = [str(_describe_model(row)), str(row["readout"]), str(row["stimuli"])]
        for metric in metrics:
            line.append(_cell(row, metric))
            if metric.name == "r":
                line.append(number(row["ceiling"]))
        lines[row["kind"]].append(line)
    listing = table(header, lines["model"], caption, (BASELINES, lines["baseline"]))
    return listing + _reasons(rows, metrics)


def _cell(row: pd.Series, metric: Metric) -> str:
    """Return a score with its interval; empty where it has no meaning for two people."""
    if row["model"] == TWO_PEOPLE and metric.two_people is None:
        return ""
    return interval(row, metric.name)


def _reasons(rows: pd.DataFrame, metrics: Sequence[Metric]) -> Markup:
    """Return the reasons that are about columns of the table, as a list."""
    others = {metric.label for metric in score_metrics()} - {metric.label for metric in metrics}
    items = []
    for _, row in rows.iterrows():
        parts = [part for part in str(row["reason"]).split("; ") if part]
        about = [part for part in parts if part.partition(":")[0] not in others]
        if about:
            items.append(f"{row['model']}: {'; '.join(about)}")
    return notes(items)


def _describe_model(row: pd.Series) -> str:
    """Return the model's name with what distinguishes it from others, but without the readout."""
    head = " · ".join(name for name in (row["base_model"], row["readout"]) if name)
    return str(row["base_model"]) + str(row["model"]).removeprefix(head)


RELIABLY = (
    "Bold: reliably better than people; italics: reliably worse, that is, the interval of the "
    "difference on the same stimuli excludes 0. Column reliably of tables/comparison.csv; "
    "people_interval there says whether a model is below, inside or above people's interval by "
    "drawing participants, as preregistered."
)
"""Caption of the table of accuracies by scenario, if people are known."""


OVER_RUNS = (
    "Mean over the runs of a model (readouts, trainings, seeds), with intervals by drawing runs, "
    "as in the paper's table by scenario."
)
"""Caption of the table of accuracies over runs."""


def accuracies(inputs: ReportInputs) -> Markup:
    """Return accuracy by model and scenario, with what is reliably better or worse than people."""
    if not inputs.comparison.has_people:
        return matrix(inputs.comparison, "accuracy")
    rows = tidy_scores(inputs)
    marks = rows.set_index(["model", "scenario"])["reliably"].to_dict()
    return matrix(inputs.comparison, "accuracy", marks, RELIABLY)


def accuracies_over_runs(comparison: Comparison) -> Markup:
    """Return the accuracies of `runs_table`, models by scenarios; nothing if there are none."""
    rows = runs_table(comparison.scores)
    if rows.empty:
        return Markup()
    columns = [*in_order(comparison.stimuli["scenario"]), MEAN]
    lines = []
    for model, own in rows.groupby("base_model", sort=False):
        cells = own.set_index("scenario")
        lines.append([str(model), str(cells["runs"].max()),
                      *(interval(cells.loc[name], "accuracy") if name in cells.index
                        else undefined("no predictions") for name in columns)])  # fmt: skip
    return details("Accuracy over runs", table(["", "runs", *columns], lines, OVER_RUNS))


def matrix(
    comparison: Comparison,
    key: str,
    reliably: Mapping[tuple[str, str], str] | None = None,
    caption: str = "",
) -> Markup:
    """Return a score by model (rows) and scenario (columns), people on top, baselines below.

    Parameters
    ----------
    comparison
        Scores of models and baselines.
    key
        Name of the metric.
    reliably
        *better* or *worse* by model and scenario, which marks the cell.
    caption
        Text above the table.
    """
    marks = reliably or {}
    columns = [*in_order(comparison.stimuli["scenario"]), MEAN, POOLED]
    first = []
    if comparison.has_people and key in _PEOPLE:
        first.append([_PEOPLE[key], *_people_cells(comparison, key, columns)])
    lines: dict[str, list[list[str]]] = {"model": first, "baseline": []}
    for model, rows in comparison.all_scores.groupby("model", sort=False):
        subset = rows.set_index("scenario")
        if model == TWO_PEOPLE and (key in _PEOPLE or subset[key].isna().all()):
            continue
        cells = [
            compared(interval(subset.loc[name], key), marks.get((str(model), name), ""))
            if name in subset.index
            else undefined("no predictions")
            for name in columns
        ]
        lines[subset["kind"].iloc[0]].append([str(model), *cells])
    return table(["", *columns], lines["model"], caption, (BASELINES, lines["baseline"]))


_PEOPLE = {"accuracy": "people", "r": "ceiling"}
"""Title of the row on top, by metric."""


def _people_cells(comparison: Comparison, key: str, columns: Sequence[str]) -> list[str]:
    people = comparison.people.set_index("scenario").assign(reason="")
    if key == "accuracy":
        return [interval(people.loc[name], key) if name in people.index else "" for name in columns]
    return [number(people.loc[name, "ceiling"]) if name in people.index else "" for name in columns]


def definitions(comparison: Comparison) -> Markup:
    """Return the definitions of the columns of the tables of scores."""
    chosen = [*shown_metrics(comparison, beyond=False)]
    if comparison.has_people:
        chosen += [one for one in score_metrics() if one.name in BEYOND_OUTCOME]
    meaning = {metric.heading: metric.definition for metric in chosen}
    meaning |= {
        NO_VALUE: "undefined; the reason is below the table or shown on hovering",
        "all, all-but, only": "a model's training: on all scenarios, on all but the tested one, "
        "only on the tested one",
    }
    return joined([heading("What the numbers mean"), definition_list(meaning)])


# --- populations of models and people -----------------------------------------------------------

_POPULATIONS = (
    "Seeds or checkpoints of a model as one population, people as the other. The consensus is the "
    "answer of the majority; where members are divided equally it is half right. Two members are "
    "different ones, drawn anew for each stimulus. Two majorities are of the two populations or, "
    "of one population with itself, of two random halves of it. Intervals are about other stimuli."
)


def populations(inputs: ReportInputs) -> Markup:
    """Return consensus, agreement and differences to people of populations; nothing without."""
    if inputs.population is None:
        return Markup()
    found = inputs.population
    consensus = [
        PageColumn("population", "population", "text"),
        PageColumn("members", "members", "count"),
        PageColumn("ties", "ties", "count"),
        PageColumn("accuracy of the consensus", "consensus", "interval"),
        PageColumn("of a member", "member", "interval"),
        PageColumn("SD of members", "member_sd", digits=3),
    ]
    agreement = [
        PageColumn("", "first", "text"),
        PageColumn("with", "second", "text"),
        PageColumn("members disagree", "disagreement_members", "interval"),
        PageColumn("majorities disagree", "disagreement_majorities", "interval"),
        PageColumn("kappa of members", "kappa_members", "interval"),
        PageColumn("kappa of majorities", "kappa_majorities", "interval"),
    ]
    scenario = PageColumn("scenario", "scenario", "text")
    differences = [consensus[0], scenario, *consensus[3:5]]
    parts = [paragraph(_POPULATIONS)]
    for rows, columns in ((found.consensus, consensus), (found.agreement, agreement)):
        several = rows["scenario"] != MEAN
        parts.append(rows_table(rows[~several], columns, AVERAGES[MEAN].capitalize()))
        parts.append(details("By scenario", rows_table(rows[several], [scenario, *columns])))
    caption = "Accuracy less people's, by the difference of the consensus"
    return joined([*parts, rows_table(found.differences, differences, caption)])


# --- tests: models against each other, mixed models -------------------------------------------


def tests(inputs: ReportInputs) -> Markup:
    """Return paired tests of models, then mixed models."""
    parts = []
    if inputs.paired is not None:
        parts += [heading("Models against each other"), _paired(inputs.paired)]
    if inputs.contrasts is not None and len(inputs.contrasts):
        parts += [heading("Groups of models"), _contrasts(inputs.contrasts)]
    if inputs.mixed:
        parts += [heading("Mixed models"), mixed_models(inputs.mixed), paragraph(_SHARED)]
    return joined(parts)


def mixed_models(fits: Sequence[MixedTable]) -> Markup:
    """Return every mixed model, or the reason why there is none."""
    return joined([paragraph(_MIXED), *(_mixed(model) for model in fits)])


def _contrasts(rows: pd.DataFrame) -> Markup:
    """Return the differences of every two groups of models."""
    columns = [
        PageColumn("grouped by", "column", "text"),
        PageColumn("first", "first", "text"),
        PageColumn("second", "second", "text"),
        PageColumn("first less second", "b", "interval", 3, "low", "high"),
        PageColumn("SE", "se", digits=3),
        PageColumn("t", "t"),
        PageColumn("df", "df", digits=1),
        PageColumn("p", "p", "p"),
        PageColumn("Holm", "p_holm", "p"),
        PageColumn("formula", "formula", "text"),
    ]
    words = (
        "Differences in accuracy between groups of models, by linear mixed models of accuracies by "
        "scenario, as in the study's Results. With an intercept of each model (base_model) the "
        "test is about other models of such groups; without it, as in the study, about these."
    )
    return paragraph(words) + rows_table(rows, columns)


_MIXED = (
    "Random intercepts as the formula says. Logistic models: maximum likelihood by "
    "Laplace approximation, Wald z. Linear models: restricted maximum likelihood, t with degrees "
    "of freedom by Satterthwaite. b of a logistic model is in log odds."
)
_SHARED = (
    "Rows of one model and scenario that differ in readout or training share their stimuli, which "
    "the models of accuracies do not know: their p are too small; the paired tests above do "
    "without that."
)


def _paired(rows: pd.DataFrame) -> Markup:
    """Return a summary as text, and the table of all pairs."""
    counts = {
        key: (
            int((rows[f"{key}_holm"] < 0.05).sum()),
            int((rows[f"{key}_bh"] < 0.05).sum()),
            int(rows[key].notna().sum()),
        )
        for key in ("p_accuracy", "p_r")
    }
    words = (
        "Every two models on the stimuli that both answered, all scenarios together. Accuracy: "
        "exact test of McNemar. r with the average person: permutation test that swaps the two "
        f"models stimulus by stimulus ({permutations_of(len(rows))} permutations), jackknife "
        "interval over stimuli. Correction over all pairs: by "
        "Holm (chance of any false alarm) and by Benjamini and Hochberg (fraction of false "
        "alarms). "
        f"Of {counts['p_accuracy'][2]} pairs, {counts['p_accuracy'][0]} differ in accuracy by "
        f"Holm and {counts['p_accuracy'][1]} by Benjamini and Hochberg (5 %); of "
        f"{counts['p_r'][2]}, {counts['p_r'][0]} and {counts['p_r'][1]} in r."
    )
    columns = [
        PageColumn("first", "first", "text"),
        PageColumn("second", "second", "text"),
        PageColumn("stimuli", "stimuli", "count"),
        PageColumn("accuracy, first less second", "accuracy_difference", digits=3),
        PageColumn("only first right", "only_first", "count"),
        PageColumn("only second right", "only_second", "count"),
        PageColumn("p", "p_accuracy", "p"),
        PageColumn("Holm", "p_accuracy_holm", "p"),
        PageColumn("B-H", "p_accuracy_bh", "p"),
        PageColumn("r, first less second", "r_difference", "interval"),
        PageColumn("p", "p_r", "p"),
        PageColumn("Holm", "p_r_holm", "p"),
        PageColumn("B-H", "p_r_bh", "p"),
    ]
    if rows["r_difference"].isna().all():
        columns = columns[:9]
    listing = rows_table(rows, columns)
    if len(rows) > 10:
        listing = details(f"All {len(rows)} pairs", listing)
    return paragraph(words) + listing


def _mixed(model: MixedTable) -> Markup:
    formula = paragraph(MACROS.code(model.formula))
    if model.fit is None:
        return details(f"{model.about}: not fitted", formula + paragraph(model.reason))
    fit = model.fit
    rows = fit.table.assign(
        term=fit.table["term"].str.replace(r"(\w+)\[T\.(.*)\]", r"\1: \2", regex=True)
    )
    columns = [
        PageColumn("term", "term", "text"),
        PageColumn("b", "b", "interval", 3, "low", "high"),
        PageColumn("SE", "se", digits=3),
        PageColumn("z", "z"),
        PageColumn("t", "t"),
        PageColumn("df", "df", digits=1),
        PageColumn("p", "p", "p"),
    ]
    logistic = "z" in rows
    known = [c for c in columns if c.key in rows and not (logistic and c.key == "df")]
    spreads = ", ".join(
        f"{row['group']} {number(row['sd'], 3)} ({int(row['levels'])})"
        for _, row in fit.random.iterrows()
    )
    note = f"{fit.rows} rows, {fit.left_out} left out; standard deviations (levels): {spreads}"
    note = ". ".join([note, *fit.warnings]) + "."
    listing = rows_table(rows, known) + paragraph(note, "note")
    return details(f"{model.about}{_together(model)}", formula + listing)


def _together(model: MixedTable) -> str:
    """Return the test that all coefficients of the model's term are zero, as text."""
    if model.fit is None or not model.term:
        return ""
    test = model.fit.joint_test(model.term)
    p = "p < 0.001" if test.p < 0.001 else f"p = {number(test.p, 3)}"
    if np.isinf(test.df2):
        return f". All together: χ²({test.df1}) = {number(test.statistic * test.df1, 1)}, {p}"
    return f". All together: F({test.df1}, {number(test.df2, 1)}) = {number(test.statistic)}, {p}"


# --- outcomes that differ, and what was left out --------------------------------------------------


def changed(comparison: Comparison, links: Mapping[str, str] | None = None) -> Markup:
    """Return the trials whose simulated outcome is not the official one; nothing without any.

    ``links``: to their movies.
    """
    rows = comparison.changed
    if rows.empty:
        return Markup()
    counts = rows["scenario"].value_counts()
    totals = comparison.stimuli.groupby("scenario")["stimulus"].nunique()
    words = ", ".join(
        f"{name} {counts.get(name, 0)} of {totals[name]}" for name in in_order(totals.index)
    )
    header = ["stimulus", "scenario", "official", "simulated"]
    header += ["people say yes"] if comparison.has_people else []
    cells = []
    for _, row in rows.iterrows():
        line = [stimulus_link(row["stimulus"], links or {}), str(row["scenario"])]
        line += [_outcome(row["label"]), _outcome(row["simulated"])]
        line += [percent(row["p_yes"])] if comparison.has_people else []
        cells.append(line)
    listing = details(f"{plural(len(rows), 'trial')}, one by one", table(header, cells))
    total = comparison.stimuli["stimulus"].nunique()
    text = (
        f"{len(rows)} of {total} stimuli: {words}. There the models were shown another event than "
        "people saw, so accuracy is given against both outcomes and r also without them."
    )
    return paragraph(text) + listing


def dropped(comparison: Comparison) -> Markup:
    """Return counts of what was excluded, and why."""
    rows = comparison.dropped
    if rows.empty:
        return paragraph("Nothing.")
    keys = ["model", "reason"]
    totals = rows.groupby(keys, sort=False)["stimuli"].sum().reset_index()
    cells = [
        [str(row["model"] or "people"), str(row["reason"]), str(row["stimuli"])]
        for _, row in totals.iterrows()
    ]
    return table(["whose", "reason", "stimuli"], cells)


def _outcome(value: bool) -> str:
    return "contact" if value else "no contact"
