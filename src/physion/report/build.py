"""Writers of the files of a report: folders, tables, figures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from physion.analysis.figure_tables import response_time_table
from physion.analysis.people.effects import below_chance_level
from physion.analysis.people.results import PeopleResults
from physion.analysis.tables import records
from physion.core.errors import BadInputError
from physion.core.files import write_atomic
from physion.core.version import MADE_WITH
from physion.report.figures import theme
from physion.report.figures.by_stimulus import CAPTION as DIFFICULTY
from physion.report.figures.by_stimulus import RESPONSE_TIME_CAPTION as RESPONSE_TIME
from physion.report.figures.by_stimulus import (
    difficulty_figure,
    misleading_plot,
    response_time_figure,
)
from physion.report.figures.theme import Plot, make_plots
from physion.report.html import (
    Picture,
    check_movies,
    page_kind,
)
from physion.report.inputs import PeopleReport, ReportInputs
from physion.report.page import people_methods, render_page, render_people_page
from physion.report.trials import shown_stimuli


def prepare_folder(folder: Path) -> Path:
    """Make ``folder`` with its ``tables`` and ``figures``, and return the path of the latter."""
    if folder.exists() and not folder.is_dir():
        raise BadInputError(f"{folder} is a file; give a folder for the report")
    for name in ("tables", "figures"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    return folder / "figures"


def write_plot(plot: Plot, folder: Path, rehearsal: bool = False) -> Picture:
    """Write a figure as SVG, PDF and PNG with its table; return what the page shows.

    ``rehearsal``: as in `write_csv`.
    """
    write_csv(folder / f"{plot.name}.csv", plot.table, rehearsal)
    figure = plot.draw(plot.table, theme.LIGHT)
    light = {kind: theme.figure_bytes(figure, kind) for kind in ("svg", "pdf", "png")}
    for ending, content in light.items():
        write_atomic(folder / f"{plot.name}.{ending}", content)
    # The dark figure is for the page only, so it is made only in the format used there.
    if page_kind(light) == "svg":
        dark = {"svg": theme.darkened(light["svg"])}
    else:
        dark = {"png": theme.figure_bytes(plot.draw(plot.table, theme.DARK), "png")}
    return Picture(plot.name, light, dark, plot.caption)


def write_csv(path: Path, table: pd.DataFrame, rehearsal: bool = False) -> None:
    """Write a table as CSV, completely or not at all.

    ``rehearsal``: the participants are simulated, which every row then states.
    """
    marked = table.assign(rehearsal="simulated participants") if rehearsal else table
    write_atomic(path, marked.to_csv(index=False, lineterminator="\n").encode())


def build_people_report(report: PeopleReport, folder: Path) -> Path:
    """Write a report about people without predictions, as `build_report`; return the page."""
    tables = report.tables()
    plots = people_plots(report.people, report.movies)
    shown = _write_parts(folder, tables, plots, bool(report.people.mark))
    numbers = _numbers(people_methods(report), report.people.warnings, tables)
    return _write_pages(folder, numbers, render_people_page(report, shown, folder))


def people_plots(people: PeopleResults, movies: Mapping[str, Path]) -> list[Plot]:
    """Return the figures: difficulty of stimuli, frames of those that mislead people, and, if times
    are known, response times.
    """
    by_stimulus = people.tables["by_stimulus"]
    rows = by_stimulus.sort_values(["scenario", "stimulus"], kind="stable")
    tail = below_chance_level(rows.reset_index(drop=True))
    frames = misleading_plot(tail, movies)
    plots = [Plot("difficulty", DIFFICULTY, tail, difficulty_figure), *([frames] if frames else [])]
    times = response_time_table(by_stimulus)
    if times["mean_log_rt"].notna().any():
        plots.append(Plot("response_time", RESPONSE_TIME, times, response_time_figure))
    return plots


def build_report(inputs: ReportInputs, folder: Path) -> Path:
    """Write ``report.html``, ``report.json``, ``tables/*.csv`` and ``figures/*.{svg,pdf,png,csv}``.

    Returns the path of the page, which needs none of the other files. Every file is complete or
    absent, the page is written last, and the same inputs give the same bytes. Raises
    `BadInputError`, before anything is written, if ``folder`` is a file or a movie is not readable.
    """
    check_movies(inputs.movies, shown_stimuli(inputs))
    shown = _write_parts(folder, inputs.tables(), make_plots(inputs), bool(inputs.mark))
    return _write_pages(folder, report_numbers(inputs), render_page(inputs, shown, folder))


def report_numbers(inputs: ReportInputs) -> dict[str, Any]:
    """Return every table of a report, and the settings, as plain values for JSON; NaN becomes
    null.
    """
    tables = {name: table for name, table in inputs.tables().items() if name != "stimuli"}
    return _numbers({**inputs.methods, **inputs.comparison.settings}, inputs.warnings, tables)


def _numbers(
    methods: Mapping[str, str], warnings: Sequence[str], tables: Mapping[str, pd.DataFrame]
) -> dict[str, Any]:
    values = {name: records(table) for name, table in tables.items()}
    return {"package": MADE_WITH, "methods": methods, "warnings": list(warnings), **values}


def _write_parts(
    folder: Path, tables: Mapping[str, pd.DataFrame], plots: Sequence[Plot], rehearsal: bool
) -> list[Picture]:
    """Write tables and figures; return the figures for the page."""
    figures = prepare_folder(folder)
    for name, table in tables.items():
        write_csv(folder / "tables" / f"{name}.csv", table, rehearsal)
    return [write_plot(plot, figures, rehearsal) for plot in plots]


def _write_pages(folder: Path, numbers: Mapping[str, Any], page: str) -> Path:
    """Write the numbers for machines and, last, the page; return its path."""
    text = json.dumps(numbers, indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(folder / "report.json", f"{text}\n".encode())
    path = folder / "report.html"
    write_atomic(path, page.encode())
    return path
