"""Writers of the files of a report: folders, tables, figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd

from physion.analysis.figure_tables import response_time_table
from physion.analysis.people.effects import below_chance_level
from physion.analysis.people.results import PeopleResults
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
