"""Report about people alone, without predictions: page, tables and figures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from physion.analysis.models.figure_tables import response_time_table
from physion.analysis.people.difficulty import below_chance_level
from physion.analysis.people.results import PeopleResults
from physion.analysis.tables.stimuli import in_order
from physion.core.files import write_atomic
from physion.core.version import MADE_WITH
from physion.report.figures.by_stimulus.difficulty import CAPTION as DIFFICULTY
from physion.report.figures.by_stimulus.difficulty import difficulty_figure
from physion.report.figures.by_stimulus.response_time import CAPTION as RESPONSE_TIME
from physion.report.figures.by_stimulus.response_time import response_time_figure
from physion.report.figures.theme import Plot
from physion.report.page import blocks, people_blocks, session_blocks
from physion.report.page.document import Picture, Section, figure, render_document
from physion.report.words import plural
from physion.report.write import prepare_folder, write_csv, write_plot

TITLE = "People on physical prediction"


@dataclass(frozen=True)
class PeopleReport:
    """Results about people with the settings of the page.

    - ``people``: every analysis of them.
    - ``methods``: settings made outside the analysis, as text.
    - ``movies``: movie by stimulus, to which the page links.
    - ``title``: the heading.
    """

    people: PeopleResults
    methods: Mapping[str, str] = field(default_factory=dict)
    movies: Mapping[str, Path] = field(default_factory=dict)
    title: str = TITLE


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
    shown = [write_plot(plot, pictures, rehearsal) for plot in make_plots(report.people)]
    warnings = list(report.people.warnings)
    methods = _methods(report)
    content = {"package": MADE_WITH, "methods": methods, "warnings": warnings, **numbers}
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(folder / "report.json", f"{text}\n".encode())
    page = folder / "report.html"
    write_atomic(page, render_people_page(report, shown, folder).encode())
    return page


def make_plots(people: PeopleResults) -> list[Plot]:
    """Return the figures: difficulty of stimuli and, if times are known, response times."""
    by_stimulus = people.tables["by_stimulus"]
    rows = by_stimulus.sort_values(["scenario", "stimulus"], kind="stable")
    tail = below_chance_level(rows.reset_index(drop=True))
    plots = [Plot("difficulty", DIFFICULTY, tail, difficulty_figure)]
    times = response_time_table(by_stimulus)
    if times["mean_log_rt"].notna().any():
        plots.append(Plot("response_time", RESPONSE_TIME, times, response_time_figure))
    return plots


def render_people_page(report: PeopleReport, pictures: Sequence[Picture], folder: Path) -> str:
    """Return the page as text; ``folder``: its folder, for relative links to movies."""
    people = report.people
    shown = "\n".join(figure(picture) for picture in pictures)
    links = blocks.relative_links(report.movies, folder)
    sections = [
        Section("People", people_blocks.people_alone(people)),
        Section(
            "Stimulus by stimulus",
            shown + people_blocks.fooled_by(people.tables["by_stimulus"], links),
        ),
        Section("Sessions left out", session_blocks.sessions_alone(people)),
        Section("How this was made", blocks.definition_list(_methods(report))),
        Section("What was left out", session_blocks.dropped(people)),
    ]
    return render_document(report.title, _summary(people), sections, people.mark)


def _summary(people: PeopleResults) -> str:
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
    warned = blocks.warnings(people.warnings, people.mark)
    return f'{warned}<p class="lead">{escape(words)}</p>'


def _methods(report: PeopleReport) -> dict[str, str]:
    return {**report.methods, **session_blocks.rules_text(report.people)}
