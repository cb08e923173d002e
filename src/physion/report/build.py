"""Writers of a report, from a comparison or from files: a folder with page, tables and figures."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from physion.analysis import (
    Bootstrap,
    read_human_zone,
    read_humans,
    read_labels,
    read_predictions,
)
from physion.analysis.models.contradictions import check_coverage
from physion.analysis.models.rollout_errors import read_rollout_errors, rollout_error_table
from physion.analysis.people.completeness import Expected, find_expected, read_expected
from physion.analysis.people.exclusions import PREREGISTERED
from physion.analysis.people.results import read_attributes
from physion.analysis.results import ComparisonResults, compare
from physion.analysis.tables.responses import LABELS_FILE, DominoesLook, find_next_to
from physion.analysis.tables.stimuli import (
    check_excluded_names,
    in_order,
    read_stimulus_list,
)
from physion.core.errors import BadInputError
from physion.core.files import write_atomic
from physion.core.version import MADE_WITH
from physion.report.figures.registry import make_plots
from physion.report.inputs import ReportInputs
from physion.report.page.movies import check_movies
from physion.report.page.page import render_page
from physion.report.page.trial_pages import FOLDER, trial_pages
from physion.report.page.trials import shown_stimuli
from physion.report.people_report import PeopleReport, build_people_report
from physion.report.settings_text import (
    describe_attributes,
    describe_expected,
    describe_intervals,
    describe_people,
    people_from_files,
    read_by_model,
)
from physion.report.write import prepare_folder, write_csv, write_plot

ZONE_FILE = "human_accuracy_by_scenario.csv"

_LOOKS = {
    "plain": "those who saw free colours with flashing overlays, as in the paper",
    "redyellow": "those who saw a red agent and a yellow patient",
    "pooled": "those of both looks, weighted by their number",
}


# --- writing ------------------------------------------------------------------------------------


def build_report(inputs: ReportInputs, folder: Path) -> Path:
    """Write ``report.html``, ``report.json``, ``tables/*.csv`` and ``figures/*.{svg,pdf,png,csv}``.

    With ``inputs.trial_pages`` also ``trials/*.html``, a page for each stimulus and their list.
    Returns the path of the page, which needs none of the other files. Every file is complete or
    absent, the page is written last, and the same inputs give the same bytes. Raises
    `BadInputError`, before anything is written, if ``folder`` is a file or a movie is not readable.
    """
    check_movies(inputs.movies, shown_stimuli(inputs))
    pictures = prepare_folder(folder)
    for name, table in inputs.tables().items():
        write_csv(folder / "tables" / f"{name}.csv", table, bool(inputs.mark))
    shown = [write_plot(plot, pictures, bool(inputs.mark)) for plot in make_plots(inputs)]
    text = json.dumps(report_numbers(inputs), indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(folder / "report.json", f"{text}\n".encode())
    if inputs.trial_pages:
        (folder / FOLDER).mkdir(exist_ok=True)
        for name, content in trial_pages(inputs):
            write_atomic(folder / FOLDER / name, content.encode())
    page = folder / "report.html"
    write_atomic(page, render_page(inputs, shown, folder).encode())
    return page


def report_numbers(inputs: ReportInputs) -> dict[str, Any]:
    """Return every table of a report, and the settings, as plain values for JSON; NaN becomes
    null.
    """
    values: dict[str, Any] = {
        name: json.loads(table.to_json(orient="records", double_precision=15))
        for name, table in inputs.tables().items()
        if name != "stimuli"
    }
    methods = {**inputs.methods, **inputs.comparison.settings}
    warnings = list(inputs.warnings)
    return {"package": MADE_WITH, "methods": methods, "warnings": warnings, **values}


# --- from files ---------------------------------------------------------------------------------


def compare_files(
    predictions: list[Path],
    humans: Path | None,
    labels: Path | Mapping[str, bool] | None,
    folder: Path,
    *,
    responses: Sequence[Path] = (),
    sessions: Path | None = None,
    rules: str = PREREGISTERED.name,
    expected: Path | Expected | None = None,
    accept_rules: Collection[str] = (),
    simulated: bool = False,
    where: Sequence[str] = (),
    attributes: Path | pd.DataFrame | None = None,
    zone: Path | None = None,
    exclude: Path | None = None,
    exclude_ledge: bool = True,
    dominoes: DominoesLook = "plain",
    bootstrap: Bootstrap | None = None,
    methods: Mapping[str, str] | None = None,
    movies: Mapping[str, Path] | None = None,
    question: str | None = None,
    trial_pages: bool = False,
    rollout_errors: Sequence[Path] = (),
) -> Path:
    """Compare predictions in CSV files with people, write the report and return the page's path.

    Parameters
    ----------
    predictions
        CSV files with the official column names; none: a page about the people in ``responses``.
    humans
        Folder of ``human_accuracy-*.csv``, or None.
    labels
        CSV file with ``stim_ID`` and ``label``, or outcomes by stimulus. None looks for the
        official file in ``humans``, next to it, and in ``stimuli`` next to it, and else uses
        *Recorded Outcome* of the predictions.
    folder
        Folder for the report.
    responses, sessions
        Participant-level answers instead of ``humans``: our export (with its table of sessions) or
        the study's raw files.
    rules
        Name of the exclusion rules, see `exclusions.RULE_SETS`.
    expected
        The stimuli that a session must have: a file for `read_expected`, or stimuli by scenario or
        session. None looks for ``expected.csv`` beside the responses, and else takes those that at
        least half of the scenario's sessions answered.
    accept_rules
        Exclusion rules that may leave out more than a third of a scenario's sessions.
    simulated
        Whether to rehearse the analysis with the simulated participants of ``responses``, who are
        left out otherwise. Every page is marked.
    where
        Values that the sessions must have, as in `select_sessions.keep_where`.
    attributes
        Elements, distractors and occluders of one's own stimuli: a table of
        `attributes.attributes_from_table`, its file, or a dataset.
    zone
        Official table of participants' percentiles; None looks for it in ``results`` likewise, and
        goes on without.
    exclude
        File of stimuli to exclude, one a line.
    exclude_ledge
        Whether to exclude the Roll stimuli with a ledge.
    dominoes
        Which people count for Dominoes in ``humans``.
    bootstrap
        Draws for the intervals.
    methods, movies, question, trial_pages
        See `ReportInputs`.
    rollout_errors
        Files of ``physion evaluate --rollout-error``, for a figure of them.

    Raises
    ------
    BadInputError
        Before anything is written.
    """
    draws = bootstrap or Bootstrap()
    if not predictions and not responses:
        raise BadInputError(
            "no file of predictions: give some, or --responses for a page about people alone"
        )
    if not predictions and (trial_pages or rollout_errors):
        raise BadInputError("pages of stimuli and rollout errors are about predictions: give some")
    rows = read_predictions(predictions) if predictions else None
    errors = read_rollout_errors(rollout_errors) if rollout_errors else None
    excluded = read_stimulus_list(exclude) if exclude is not None else []
    choices = dict(methods or {})
    if responses:
        if humans is not None:
            raise BadInputError("give people's tables (humans) or their responses, not both")
        given = read_labels(labels) if isinstance(labels, Path) else labels
        expected = find_expected(responses) if expected is None else expected
        people = people_from_files(
            responses, sessions, rules, given, excluded, exclude_ledge, draws,
            expected=read_expected(expected) if isinstance(expected, Path) else expected,
            accept_rules=accept_rules,
            participants="simulated" if simulated else "people",
            attributes=read_attributes(attributes) if isinstance(attributes, Path) else attributes,
            where=where,
        )  # fmt: skip
        choices.setdefault("Official outcomes", "those recorded with the responses")
        described = describe_people(responses, people)
        chosen = f"; of the sessions with {', '.join(where)} alone" if where else ""
        choices.setdefault("People", described + chosen)
        choices.setdefault(
            "Trials of a whole session", describe_expected(people, expected is not None)
        )
        choices.setdefault("Attributes of stimuli", describe_attributes(people))
        if rows is None:
            check_excluded_names(excluded, people.stimuli)
            choices.setdefault("Intervals", describe_intervals(draws))
            return build_people_report(PeopleReport(people, choices, movies or {}), folder)
        results = compare(
            rows, people=people, exclude=excluded, exclude_ledge=exclude_ledge, bootstrap=draws
        )
    else:
        assert rows is not None
        about = (sessions, expected, attributes)
        if any(one is not None for one in about) or accept_rules or simulated or where:
            raise BadInputError(
                "sessions, expected, attributes, accepted rules, chosen values (where) and "
                "simulated participants are about responses: give those"
            )
        settings: dict[str, Any] = {"exclude": excluded, "exclude_ledge": exclude_ledge}
        results, words = _with_averages(
            rows, humans, labels, zone, dominoes, {**settings, "bootstrap": draws}
        )
        choices = {**words, **choices}
    inputs = ReportInputs.of(
        results,
        methods=choices,
        movies=movies or {},
        model_inputs=read_by_model(predictions, "Inputs"),
        model_weights=read_by_model(predictions, "Init"),
        trial_pages=trial_pages,
        rollout_errors=None if errors is None else rollout_error_table(errors, draws.level),
        **({"question": question} if question else {}),
    )
    return build_report(inputs, folder)


def _with_averages(
    rows: pd.DataFrame,
    humans: Path | None,
    labels: Path | Mapping[str, bool] | None,
    zone: Path | None,
    dominoes: DominoesLook,
    settings: Mapping[str, Any],
) -> tuple[ComparisonResults, dict[str, str]]:
    """Return the comparison with people's averages, if there are any, and its settings as text."""
    if humans is None:
        known = read_labels(labels) if isinstance(labels, Path) else labels
        return compare(rows, None, known, **settings), {}
    averages = read_humans(humans, dominoes)
    labels = find_next_to(humans, "stimuli", LABELS_FILE) if labels is None else labels
    zone = find_next_to(humans, "results", ZONE_FILE) if zone is None else zone
    if labels is None and rows["recorded"].isna().all():
        raise BadInputError(f"no {LABELS_FILE} lies near {humans}; give the file with the labels")
    known = read_labels(labels) if isinstance(labels, Path) else labels
    zone_table = None if zone is None else read_human_zone(zone)
    origin = labels.name if isinstance(labels, Path) else "those recorded with the trials"
    words = {"Official outcomes": origin, "People for Dominoes": _LOOKS[dominoes]}
    zone_source = "" if zone is None else f"official table {zone.name}"
    results = compare(rows, averages, known, zone=zone_table, zone_origin=zone_source, **settings)
    # Outcomes that are no file may be of more stimuli than people saw.
    cut = check_coverage(averages, known) if known and isinstance(labels, Path) else []
    if zone_table is not None:
        absent = [name for name in in_order(averages["scenario"]) if name not in
                  set(zone_table["scenario"])]  # fmt: skip
        cut += [f"{name}: {zone_source} has no row: is it cut?" for name in absent]
    return replace(results, warnings=(*results.warnings, *cut)), words
