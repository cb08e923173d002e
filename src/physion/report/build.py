"""Writers of the files of a report: folders, tables, figures."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from physion.analysis import Bootstrap, read_human_zone, read_humans, read_labels, read_predictions
from physion.analysis.compare import ComparisonResults, compare
from physion.analysis.comparison import check_coverage
from physion.analysis.figure_tables import response_time_table
from physion.analysis.people.effects import below_chance_level
from physion.analysis.people.exclusions import PREREGISTERED, Expected, find_expected, read_expected
from physion.analysis.people.results import PeopleResults, read_attributes
from physion.analysis.rollout_errors import read_rollout_errors, rollout_error_table
from physion.analysis.tables import (
    LABELS_FILE,
    DominoesLook,
    check_excluded_names,
    find_next_to,
    in_order,
    read_stimulus_list,
)
from physion.core.errors import BadInputError
from physion.core.files import write_atomic
from physion.core.version import MADE_WITH
from physion.report.figures import theme
from physion.report.figures.by_stimulus import CAPTION as DIFFICULTY
from physion.report.figures.by_stimulus import RESPONSE_TIME_CAPTION as RESPONSE_TIME
from physion.report.figures.by_stimulus import difficulty_figure, response_time_figure
from physion.report.figures.theme import Plot, make_plots
from physion.report.html import (
    Picture,
    check_movies,
    page_kind,
)
from physion.report.inputs import PeopleReport, ReportInputs
from physion.report.page import people_methods, render_page, render_people_page
from physion.report.people import (
    describe_attributes,
    describe_expected,
    describe_intervals,
    describe_people,
    people_from_files,
    read_by_model,
)
from physion.report.trials import FOLDER, shown_stimuli, trial_pages


def prepare_folder(folder: Path) -> Path:
    """Make ``folder`` with its ``tables`` and ``figures``, and return the path of the latter."""
    if folder.exists() and not folder.is_dir():
        raise BadInputError(f"{folder} is a file; give a folder for the report")
    for name in ("tables", "figures"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    return folder / "figures"


def write_plot(plot: Plot, folder: Path, rehearsal: bool = False) -> Picture:
    """Write a figure as SVG with text, PDF and PNG with its table; return what the page shows.

    The page shows an SVG with outlined letters, which needs no font. ``rehearsal``: as in
    `write_csv`.
    """
    write_csv(folder / f"{plot.name}.csv", plot.table, rehearsal)
    figure = plot.draw(plot.table, theme.LIGHT)
    light = {kind: theme.figure_bytes(figure, kind) for kind in ("svg", "png")}
    # The dark figure is for the page only, so it is made only in the format used there.
    kind = page_kind(light)
    dark = {kind: theme.figure_bytes(plot.draw(plot.table, theme.DARK), kind)}
    files = {
        "svg": theme.figure_bytes(figure, "svg", text=True),
        "pdf": theme.figure_bytes(figure, "pdf"),
        "png": light["png"],
    }
    for ending, content in files.items():
        write_atomic(folder / f"{plot.name}.{ending}", content)
    return Picture(plot.name, light, dark, plot.words)


def write_csv(path: Path, table: pd.DataFrame, rehearsal: bool = False) -> None:
    """Write a table as CSV, completely or not at all.

    ``rehearsal``: the participants are simulated, which every row then states.
    """
    marked = mark_rehearsal(table) if rehearsal else table
    write_atomic(path, marked.to_csv(index=False, lineterminator="\n").encode())


def mark_rehearsal(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table with the column ``rehearsal``, which states that nothing is about people."""
    return table.assign(rehearsal="simulated participants")


def build_people_report(report: PeopleReport, folder: Path) -> Path:
    """Write ``report.html``, ``report.json``, ``tables/*.csv`` and ``figures/*``; return the page.

    Every file is complete or absent, the page is written last, and the same results give the same
    bytes. Raises `BadInputError`, before anything is written, if ``folder`` is a file.
    """
    pictures = prepare_folder(folder)
    tables = {f"people_{name}": t for name, t in report.people.tables.items() if len(t.columns)}
    rehearsal = bool(report.people.mark)
    for name, table in tables.items():
        write_csv(folder / "tables" / f"{name}.csv", table, rehearsal)
    numbers: dict[str, Any] = {
        name: json.loads(table.to_json(orient="records", double_precision=15))
        for name, table in tables.items()
    }
    shown = [write_plot(plot, pictures, rehearsal) for plot in people_plots(report.people)]
    warnings = list(report.people.warnings)
    methods = people_methods(report)
    content = {"package": MADE_WITH, "methods": methods, "warnings": warnings, **numbers}
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(folder / "report.json", f"{text}\n".encode())
    page = folder / "report.html"
    write_atomic(page, render_people_page(report, shown, folder).encode())
    return page


def people_plots(people: PeopleResults) -> list[Plot]:
    """Return the figures: difficulty of stimuli and, if times are known, response times."""
    by_stimulus = people.tables["by_stimulus"]
    rows = by_stimulus.sort_values(["scenario", "stimulus"], kind="stable")
    tail = below_chance_level(rows.reset_index(drop=True))
    plots = [Plot("difficulty", DIFFICULTY, tail, difficulty_figure)]
    times = response_time_table(by_stimulus)
    if times["mean_log_rt"].notna().any():
        plots.append(Plot("response_time", RESPONSE_TIME, times, response_time_figure))
    return plots


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
