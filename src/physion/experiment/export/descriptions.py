"""Descriptions of an export: README files and the Psych-DS dataset.

Psych-DS (psych-ds.github.io): ``dataset_description.json`` is a schema.org ``Dataset`` whose
``variableMeasured`` describes every column of every file; data files are called
``keyword-value[_keyword-value...]_data.csv``.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from physion.core.version import __version__
from physion.experiment.study.study import Study

if TYPE_CHECKING:
    from physion.core.tables import Column

# --- labels of files and columns ---

KIND_NAMES = {
    "text": "text",
    "integer": "whole number",
    "number": "number",
    "flag": "true or false",
    "choice": "one of the given words",
    "time": "moment in ISO 8601, UTC",
}


def file_label(name: str) -> str:
    """Return the ASCII letters and digits of a name, or ``x`` if it has none."""
    return re.sub(r"[^A-Za-z0-9]", "", name) or "x"


def column_levels(column: Column) -> tuple[str, ...]:
    """Return the allowed values of a flag or choice column; empty for other columns."""
    return ("true", "false") if column.kind == "flag" else column.choices


# --- Psych-DS ---

VERSION = "Psych-DS 0.4.0"


def write_psych_ds(
    folder: Path,
    tables: Mapping[str, tuple[Path, Sequence[Column]]],
    *,
    name: str,
    description: str,
    readme: str,
    covers: tuple[str, str] | None,
) -> list[Path]:
    """Write a dataset into a new folder; return the paths of its data files.

    Parameters
    ----------
    folder
        Folder to create.
    tables
        CSV file (which is copied) and columns of each table, by table name.
    name, description
        Name and title of the study.
    readme
        Text of README.md.
    covers
        First and last time in the data (ISO 8601), if known.
    """
    data = folder / "data"
    data.mkdir(parents=True)
    paths = []
    for table, (source, _) in tables.items():
        paths.append(data / f"study-{file_label(name)}_description-{file_label(table)}_data.csv")
        shutil.copyfile(source, paths[-1])
    columns: dict[str, Column] = {}
    for _, listed in tables.values():
        for column in listed:
            columns.setdefault(column.name, column)  # the first table has the full description
    metadata: dict[str, Any] = {
        "@context": "https://schema.org/",
        "@type": "Dataset",
        "name": name,
        "description": description,
        "schemaVersion": VERSION,
        "keywords": ["intuitive physics", "human behavior", "response time"],
        "variableMeasured": [variable(column) for column in columns.values()],
    }
    if covers is not None:
        metadata["temporalCoverage"] = "/".join(covers)
    text = json.dumps(metadata, indent=2, ensure_ascii=False)
    (folder / "dataset_description.json").write_text(text + "\n", encoding="utf-8")
    (folder / "README.md").write_text(readme, encoding="utf-8")
    return paths


def variable(column: Column) -> dict[str, Any]:
    """Return the description of a column as a schema.org ``PropertyValue``."""
    about = f"{column.about} ({KIND_NAMES[column.kind]})"
    value: dict[str, Any] = {
        "@type": "PropertyValue",
        "name": column.name,
        "description": about,
    }
    if column.unit:
        value["unitText"] = column.unit
    if column.low is not None:
        value["minValue"] = column.low
    if column.high is not None:
        value["maxValue"] = column.high
    if column_levels(column):
        value["valueReference"] = list(column_levels(column))
    return value


_TASK = """\
Participants saw the first part of a movie, in whose first frame the agent was marked in red and the
patient in yellow, and predicted whether the agent would touch the patient."""

_SESSION = """ A session is one
participant in one scenario: familiarization with feedback, then the test without feedback."""

_PEOPLE = """\
`participant` is a keyed hash: the same for all sessions of a person in this study, and of no use
without the study's key. Recruiters' ids are not exported. Free text, rare combinations of age,
gender and education, times of answers to the millisecond, and the descriptions of browser and
screen may still identify a person: check them before you publish the data.
Sessions with `simulated` = true are of simulated participants."""

_FILES = """\
- `trials.csv`, `trials.parquet`: one row per trial.
- `sessions.csv`, `sessions.parquet`: one row per session.
- `questions.csv`, `questions.parquet`: one row per session that answered the questions of the lab,
  if it asks some.
- `practice_repeats.csv`, `practice_repeats.parquet`: answers to practice trials that were repeated
  afterwards, if there are some; `trials` has the last repeat.
- `attention_checks.csv`, `attention_checks.parquet`: answers to attention checks, if there are any.
- `events.csv`, `events.parquet`: other events in the browser.
- `trial_details.parquet`: times of frames and cues within each trial.
- `stimuli.csv`: the stimuli and their outcomes. `expected.csv`: the test stimuli by scenario.
- `data_dictionary.json`: description of every column of every table.
- `study.json`: settings and texts of each version of the study under which sessions ran.
- `psych-ds/`: the same tables as a Psych-DS dataset.

In CSV files an apostrophe stands before a text that a spreadsheet would take for a formula, because
it begins with =, +, -, @, a tab, a line end or an apostrophe. Parquet files hold the text as it was
written.

A row of `trials` is identified by `session`, `phase` and `trial`. To compare them with models:

    physion compare PREDICTIONS --responses trials.csv --sessions sessions.csv \\
        --expected expected.csv

Unfinished sessions are included; the analysis flags them. Previews and sessions of people who
withdrew or did not consent are not included."""

_PSYCH_DS = """\
A Psych-DS dataset (psych-ds.github.io). A row of `..._description-trials_data.csv` is identified by
`session`, `phase` and `trial`, a row of `..._description-sessions_data.csv` by `session`, a row of
`..._description-events_data.csv` by `session` and `number`. If the lab asks
questions of its own, a row of `..._description-questions_data.csv` is identified by `session`."""


def readme(
    study: Study,
    layout: Literal["export", "psych-ds"],
    facts: Mapping[str, Any] | None = None,
) -> str:
    """Return the README.md of the export, or of its Psych-DS folder.

    ``facts``, if given, are the counts of `ExportReport.facts`, which are appended.
    """
    special = _FILES if layout == "export" else _PSYCH_DS
    parts = [
        f"# {study.title}",
        f"Study {study.name}, version {study.version}. Contact: {study.contact}",
        f"Written by physion {__version__}.",
        _TASK + _SESSION,
        special,
        _PEOPLE,
    ]
    if facts is not None:
        parts.append("## Counts\n\n" + "\n".join(count_lines(facts, "- ")))
    return "\n\n".join(parts) + "\n"


def count_lines(facts: Mapping[str, Any], bullet: str = "") -> list[str]:
    """Return the counts of `ExportReport.facts` as lines of text."""
    lines = []
    for kind, states in facts["sessions"].items():
        total = sum(states.values())
        lines.append(f"{bullet}{kind}: {total} sessions, {states['finished']} finished")
    if not lines:
        lines.append(f"{bullet}no session")
    counts = ", ".join(f"{count} {name}" for name, count in facts["rows"].items())
    lines.append(f"{bullet}rows: {counts}")
    for entry in facts["left_out"]:
        whose = "" if entry["kind"] == "any" else f" ({entry['kind']})"
        what = entry["what"] + ("s" if entry["count"] != 1 else "")
        lines.append(f"{bullet}left out: {entry['count']} {what}{whose}: {entry['reason']}")
    if facts["data_until"]:
        lines.append(f"{bullet}data until {facts['data_until']}")
    return lines
