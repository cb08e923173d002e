"""The two pages of a report: a comparison of models with people, and people without models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from physion.analysis.comparison import Comparison
from physion.analysis.people.results import PeopleResults
from physion.analysis.scores import AVERAGES, TWO_PEOPLE, scenario_counts, shown_average
from physion.analysis.tables import MEAN, in_order
from physion.core.html import Markup, joined
from physion.report import html, scores
from physion.report import people as people_parts
from physion.report.figures.theme import (
    BY_SCENARIO,
    BY_STIMULUS,
    FIRST,
    TRAINING,
    all_figures,
)
from physion.report.html import (
    MACROS,
    PageMovies,
    Picture,
    Section,
    figure,
    heading,
    notes,
    paragraph,
    plural,
    render_document,
)
from physion.report.inputs import EXPECTED_METHODS, PeopleReport, ReportInputs
from physion.report.scores import inputs_sentence, weights_sentence
from physion.report.trials import gaps, opening


def render_page(
    inputs: ReportInputs, pictures: Sequence[Picture], folder: Path | None = None
) -> str:
    """Return the page as text; the same inputs give the same text. Raises `BadInputError` for a
    movie.

    It starts with one trial of each scenario. Movies are added last, as many as the size of the
    page allows. ``folder``: the folder of the page, for links to the movies that it lacks.
    """
    shown = {picture.name: figure(picture) for picture in pictures}
    links = _links(inputs, folder)
    sections = [
        Section("Results", scores.results(inputs)),
        Section("Scores", scores.scores(inputs.comparison)),
        Section(BY_SCENARIO, _by_scenario(inputs, shown)),
        Section(TRAINING, _figures(TRAINING, shown, {})),
        Section(BY_STIMULUS, _stimuli(inputs, shown, links)),
        Section(DISAGREE, Markup()),
        Section("People", people_parts.people(inputs)),
        Section("Sessions left out", people_parts.sessions(inputs)),
        Section("Populations", scores.populations(inputs)),
        Section("Tests", scores.tests(inputs)),
        Section("Trials whose simulated outcome differs", scores.changed(inputs.comparison, links)),
        Section("How this was made", _methods(inputs)),
        Section("What was left out", _left_out(inputs)),
    ]
    lead = _first(inputs, shown)
    # Once without movies, for the size of all else.
    texts = [
        lead,
        *(one.content for one in _with_trials(inputs, sections, PageMovies({}, 0), links)),
    ]
    left = inputs.page_bytes - _FRAME_BYTES - sum(len(text.encode()) for text in texts)
    sections = _with_trials(inputs, sections, PageMovies(inputs.movies, left), links)
    filled = [one for one in sections if one.content]
    return render_document(inputs.title, lead, filled, inputs.mark)


OPENING = "One trial of each scenario"
DISAGREE = "What people and models disagree on"
_FRAME_BYTES = 50_000
"""Bytes kept for style, headings and contents of the page."""


def _with_trials(
    inputs: ReportInputs, sections: Sequence[Section], movies: PageMovies, links: Mapping[str, str]
) -> list[Section]:
    """Return the sections after the opening trials, with the disagreements."""
    first = Section(OPENING, opening(inputs, movies, links))
    shows = Section(DISAGREE, gaps(inputs, movies, links))
    return [first, *(shows if one.title == DISAGREE else one for one in sections)]


def _links(inputs: ReportInputs, folder: Path | None) -> Mapping[str, str]:
    """Return the addresses of movies by stimulus, relative to the page."""
    return {} if folder is None else html.relative_links(inputs.movies, folder)


def _first(inputs: ReportInputs, shown: Mapping[str, Markup]) -> Markup:
    """Return the first screen: warnings, one sentence, one picture."""
    warned = html.warnings(inputs.warnings, inputs.mark)
    picture = _figures(FIRST, shown, {})
    return joined([warned, Markup(MACROS.first(_sentence(inputs), picture))])


def _sentence(inputs: ReportInputs) -> str:
    """Return who is how accurate, and who is most like people, in one sentence.

    Models that were shown the outcome are left out, and models of fewer scenarios than others.
    """
    table = inputs.results()
    comparison = inputs.comparison
    stimuli = comparison.stimuli["stimulus"].nunique()
    scenarios = plural(comparison.stimuli["scenario"].nunique(), "scenario")
    models = table[(table["group"] == "model") & (table["readout"] != "full")]
    models = models[models["scenarios"] == models["scenarios"].max()]
    words = []
    if comparison.has_people:
        people = table.set_index("row").loc[TWO_PEOPLE]
        words.append(f"people are right in {html.percent(people['accuracy'])} of their answers")
    if len(known := models.dropna(subset=["accuracy"])):
        best = known.loc[known["accuracy"].idxmax()]
        which = "the most accurate model" if len(models) > 1 else "the model"
        words.append(f"{which}, {_named(best)}, in {html.percent(best['accuracy'])}")
    text = f"On {plural(stimuli, 'stimulus')} of {scenarios}, {', '.join(words)}"
    if comparison.has_people and len(known := models.dropna(subset=["kappa"])):
        like = known.loc[known["kappa"].idxmax()]
        same = len(words) > 1 and like["row"] == best["row"]
        who = "it is also most like people" if same else f"{_named(like)} is most like people"
        kappa = html.number(like["kappa"])
        words_of_like = f"{who} (kappa {kappa}" if len(models) > 1 else f"its kappa is {kappa}"
        others = f"where two people with each other reach {html.number(people['kappa'])}"
        text += f"; {words_of_like}, {others}{')' if len(models) > 1 else ''}"
    return f"{text}."


def _named(row: pd.Series) -> str:
    name = str(row["row"]).partition(" · ")[0]
    return f"{name} (given: {row['given']})" if row["given"] else name


def _summary(inputs: ReportInputs) -> Markup:
    comparison = inputs.comparison
    stimuli = comparison.stimuli["stimulus"].nunique()
    scenarios = in_order(comparison.stimuli["scenario"])
    models, rows = comparison.stimuli["base_model"].nunique(), len(comparison.names)
    each = f" (with their readouts and trainings {rows} rows)" if rows > models else ""
    words = [
        f"{plural(models, 'model')}{each} on {plural(stimuli, 'stimulus')} "
        f"of {plural(len(scenarios), 'scenario')} ({', '.join(scenarios)})."
    ]
    if comparison.has_people:
        mean = comparison.people.set_index("scenario").loc[MEAN]
        drawn = html.spread(mean["bootstrap_low"], mean["bootstrap_high"], 3)
        known = pd.notna(mean["bootstrap_low"])
        words.append(
            f"People: mean accuracy {mean['accuracy']:.3f} over scenarios"
            + (f" ({drawn} by drawing participants, as preregistered)" if known else "")
            + f", about {mean['people']:.0f} participants per stimulus."
        )
    else:
        words.append("No answers of people were given: this page is about models only.")
    if inputs.people is not None:
        flags = inputs.people.tables["flags"]
        words.append(
            f"Flagged and left out: {int(flags['flagged'].sum())} of "
            f"{plural(len(flags), 'session')}; the main results are given with them too."
        )
    if len(comparison.changed):
        words.append(
            f"In {len(comparison.changed)} of these stimuli the simulated outcome is not the "
            "official one; accuracy is given against both."
        )
    words.append(_answer(comparison))
    given = f"{inputs_sentence(inputs)} {weights_sentence(inputs)}".strip()
    more = paragraph(given) if given else Markup()
    return joined([paragraph(" ".join(words)), more])


def _answer(comparison: Comparison) -> str:
    """Return which model is most accurate and which is most like people, as sentences.

    Models that were shown the outcome are left out, and models of fewer scenarios than others. Of
    few stimuli only pooled scores are known.
    """
    scores = comparison.all_scores
    models = scores[(scores["kind"] == "model") & (scores["readout"] != "full")]
    counts = models["model"].map(scenario_counts(models))
    models = models[counts == counts.max()]
    words = []
    for name, text in (("accuracy", "Most accurate"), ("r", "Most like people")):
        if name not in models or (name == "r" and not comparison.has_people):
            continue
        for which in sorted(AVERAGES, key=lambda name: name != shown_average(scores)):
            rows = models[models["scenario"] == which].dropna(subset=[name])
            if len(rows):
                best = rows.loc[rows[name].idxmax()]
                value = "r " * (name == "r") + html.number(best[name])
                other = {"accuracy": ("people", "human_accuracy"), "r": ("ceiling", "ceiling")}
                label, column = other[name]
                known = column in rows and pd.notna(best[column])
                beyond = f"; {label} {html.number(best[column])}" if known else ""
                words.append(f"{text}: {best['model']} ({value}{beyond}; {AVERAGES[which]}).")
                break
    return " ".join(words)


def _figures(section: str, shown: Mapping[str, Markup], below: Mapping[str, Markup]) -> Markup:
    """Return the figures of a section with headings; ``below``: what stands below them."""
    parts = []
    for entry in all_figures():
        if entry.section == section and entry.name in shown:
            parts += [heading(entry.heading)] if entry.heading else []
            parts += [shown[entry.name], below.get(entry.name, Markup())]
    return joined(parts)


def _by_scenario(inputs: ReportInputs, shown: Mapping[str, Markup]) -> Markup:
    comparison = inputs.comparison
    below = {
        "accuracy": html.details("Accuracy as a table", scores.accuracies(inputs))
        + scores.accuracies_over_runs(comparison),
        "kappa": people_parts.measures(inputs),
    }
    if comparison.has_people:
        below["r"] = html.details(
            "Pearson r by scenario, as a table", scores.matrix(comparison, "r")
        )
    return _figures(BY_SCENARIO, shown, below)


def _stimuli(inputs: ReportInputs, shown: Mapping[str, Markup], links: Mapping[str, str]) -> Markup:
    below: dict[str, Markup] = {}
    if inputs.comparison.has_people:
        below["difficulty"] = people_parts.fooled(inputs, links)
    return _figures(BY_STIMULUS, shown, below)


def _methods(inputs: ReportInputs) -> Markup:
    stated = dict.fromkeys(EXPECTED_METHODS, "not stated")
    models = dict.fromkeys(inputs.comparison.stimuli["base_model"].astype(str))
    unknown = [name for name in models if not inputs.model_weights.get(name)]
    if not unknown:
        del stated["Encoder weights"]  # `_summary` has them
    elif len(unknown) < len(models):
        stated["Encoder weights"] = f"not stated of {html.listed(unknown)}"
    stated |= inputs.methods
    rules = {} if inputs.people is None else people_parts.rules_text(inputs.people)
    choices = {**stated, **inputs.comparison.settings, **rules}
    return _summary(inputs) + html.definition_list(choices) + scores.definitions(inputs.comparison)


def _left_out(inputs: ReportInputs) -> Markup:
    parts = [heading("Stimuli"), scores.dropped(inputs.comparison)]
    if inputs.people is not None:
        parts += [heading("Answers of people"), people_parts.dropped(inputs.people)]
    missing = _unanswered(inputs)
    if missing:
        parts += [heading("What cannot be said from these files"), notes(missing)]
    return joined(parts)


def _unanswered(inputs: ReportInputs) -> list[str]:
    """Return what a complete report would contain and this one lacks, and why."""
    words = []
    if not inputs.comparison.has_people:
        words.append(
            "Everything that compares with people: no answers of people were given (--humans for "
            "their averages, --responses for single participants)."
        )
    if inputs.people is None:
        words.append(
            "Cohen's kappa with participants, their zones of r and kappa, split halves, response "
            "times, biases, exclusions and their effect, intervals that draw people, "
            "mixed models of answers: they need the answers of single participants (--responses)."
        )
    elif inputs.people.tables["by_stimulus"]["mean_log_rt"].isna().all():
        words.append("Response times: no answer has one above 0.")
    counts = inputs.comparison.stimuli[["model", "stimulus"]].groupby("model").size()
    if counts.nunique() > 1:
        words.append(
            f"Models answered between {counts.min()} and {counts.max()} stimuli: their scores are "
            "of different stimuli; the paired tests use those that both answered."
        )
    return words


# --- people without predictions ------------------------------------------------------------------


def render_people_page(report: PeopleReport, pictures: Sequence[Picture], folder: Path) -> str:
    """Return the page as text; ``folder``: its folder, for relative links to movies."""
    people = report.people
    shown = joined(figure(picture) for picture in pictures)
    links = html.relative_links(report.movies, folder)
    sections = [
        Section("People", people_parts.people_only(people)),
        Section(
            BY_STIMULUS,
            shown + people_parts.fooled_by(people.tables["by_stimulus"], links),
        ),
        Section("Sessions left out", people_parts.sessions_only(people)),
        Section("Mixed models", scores.mixed_models(report.mixed)),
        Section("How this was made", html.definition_list(people_methods(report))),
        Section("What was left out", people_parts.dropped(people)),
    ]
    return render_document(report.title, _people_summary(people), sections, people.mark)


def _people_summary(people: PeopleResults) -> Markup:
    """Return the sentences at the top of the page."""
    flags, test = people.tables["flags"], people.kept.test
    scenarios = in_order(test["scenario"])
    words = (
        f"{plural(test['participant'].nunique(), 'participant')} on "
        f"{plural(test['stimulus'].nunique(), 'stimulus')} of "
        f"{plural(len(scenarios), 'scenario')} ({', '.join(scenarios)}). No predictions were "
        f"given. Flagged and left out: {int(flags['flagged'].sum())} of "
        f"{plural(len(flags), 'session')}; the main results are given with them too."
    )
    warned = html.warnings(people.warnings, people.mark)
    return joined([warned, paragraph(words, "lead")])


def people_methods(report: PeopleReport) -> dict[str, str]:
    """Return the settings of the page, as text."""
    return {**report.methods, **people_parts.rules_text(report.people)}
