"""Export of the data of a study as a folder of tables, also in the conventions Psych-DS and BIDS.

::

    OUT/
      README.md              description of the files
      trials.csv, .parquet   one row per trial: physion compare --responses
      sessions.csv, .parquet one row per session: physion compare --sessions
      questions.csv, .parquet    answers to the lab's own questions, if there are any
      practice_repeats.csv, .parquet  answers to practice trials that were repeated, if any
      attention_checks.csv, .parquet  answers to attention checks, if there are any
      events.csv, .parquet   other events in the browser
      trial_details.parquet  times of frames and cues within each trial
      stimuli.csv, expected.csv   the stimuli; the test stimuli of each scenario or session
      data_dictionary.json   description of every column of every table
      study.json             settings and texts of the study, without codes and keys
      psych-ds/, bids/       the same data in two conventions
      export.json            counts, and what was left out; written last

The same data and package version give byte-identical files, whatever the database.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow.compute as pc
from sqlalchemy import Connection, Engine, select

from physion.analysis.people.responses import Column, data_dictionary
from physion.core.version import __version__
from physion.experiment.export.answer_tables import snapshot
from physion.experiment.export.conventions.bids import BidsWriter
from physion.experiment.export.conventions.psych_ds import write_psych_ds
from physion.experiment.export.descriptions import STIMULI_COLUMNS, readme
from physion.experiment.export.expected import expected_stimuli
from physion.experiment.export.export_folder import atomic_folder, write_manifest
from physion.experiment.export.iso_times import iso_times
from physion.experiment.export.session_rows import (
    EXPORTED_KINDS,
    SessionSelection,
    SessionTable,
    read_sessions,
)
from physion.experiment.export.spreadsheet import RULE
from physion.experiment.export.write_tables import WrittenTables, write_tables
from physion.experiment.store.database import STUDIES
from physion.experiment.study.study import EARLY_ENDS, Study

Layout = Literal["both", "psych-ds", "bids"]
GONE = "its stimulus is no longer in the study folder"
NO_FILE = "no answer yet, so no file in bids/"
_PSYCH_DS_TABLES = ("trials", "sessions", "events", "questions", "practice_repeats",
                    "attention_checks")  # fmt: skip
_SECRET_SETTINGS = ("recruitment", *EARLY_ENDS, "folder", "stimuli")


@dataclass(frozen=True)
class ExportReport:
    """Counts of an export.

    Attributes
    ----------
    out
        The exported folder.
    sessions
        Number of sessions by kind, and by ``finished`` or ``unfinished``.
    rows
        Number of rows by table.
    left_out
        What (session or answer) was left out, with kind, reason and count.
    until
        Latest time in the data (ISO 8601); None if there are no data.
    """

    out: Path
    sessions: dict[str, dict[str, int]]
    rows: dict[str, int]
    left_out: tuple[dict[str, Any], ...]
    until: str | None

    def facts(self) -> dict[str, Any]:
        """Return the counts as JSON values, without the path."""
        return {
            "sessions": self.sessions,
            "rows": self.rows,
            "left_out": list(self.left_out),
            "data_until": self.until,
        }


def export_study(
    engine: Engine,
    study: Study,
    out: Path,
    *,
    simulated: bool = True,
    scenario: str | None = None,
    layout: Layout = "both",
) -> ExportReport:
    """Export one consistent snapshot of the data into the folder ``out``, completely or not at all.

    A server may be running.

    Parameters
    ----------
    engine
        The database.
    study
        The study.
    out
        Folder to write. An existing export without added files is replaced.
    simulated
        Whether to include simulated participants.
    scenario
        Export only this scenario.
    layout
        Conventions to write besides the tables.

    Raises
    ------
    BadInputError
        ``out`` exists and is anything but an unchanged export or an empty folder.
    """
    kinds = EXPORTED_KINDS if simulated else ("person",)
    with atomic_folder(out) as folder:
        with snapshot(engine) as connection:
            sessions = read_sessions(connection, study, SessionSelection(kinds, scenario))
            bids = None
            if layout != "psych-ds":
                bids = BidsWriter(folder / "bids", study, sessions.table)
            written = write_tables(folder, connection, study, sessions, bids)
            states = _states(connection, sessions)
            expected = expected_stimuli(connection, study, sessions)
        report = _report(out, sessions, written)
        _write_stimuli(folder, study, expected)
        _write_json(folder / "study.json", {"states": states})
        dictionary: dict[str, Any] = {
            name: data_dictionary(columns) for name, columns in written.described.items()
        }
        _write_json(folder / "data_dictionary.json", dictionary | {"spreadsheet_safety": RULE})
        if bids is not None:
            if written.own is not None:
                bids.write_questions(*written.own)
            without = bids.close(
                name=study.title, readme=readme(study, "bids"), version=__version__
            )
            report = _with_left_out(report, "session", "any", NO_FILE, without)
        if layout != "bids":
            chosen = {
                name: (folder / f"{name}.csv", columns)
                for name, columns in written.described.items()
                if name in _PSYCH_DS_TABLES
            }
            _write_psych_ds(folder, study, sessions, report.until, chosen)
        (folder / "README.md").write_text(readme(study, "export", report.facts()), "utf-8")
        known = {"package": f"physion {__version__}", "name": study.name}
        write_manifest(folder, known | {"version": study.version} | report.facts())
    return report


def _report(out: Path, sessions: SessionTable, written: WrittenTables) -> ExportReport:
    """Return the report of the tables, before Psych-DS and BIDS."""
    kinds: dict[str, dict[str, int]] = {}
    for kind in EXPORTED_KINDS:
        states = {state: sessions.states[kind, state] for state in ("finished", "unfinished")}
        if any(states.values()):
            kinds[kind] = states
    report = ExportReport(out, kinds, written.rows, (), written.until)
    for (kind, reason), count in sorted(sessions.left_out.items()):
        report = _with_left_out(report, "session", kind, reason, count)
    return _with_left_out(report, "answer", "any", GONE, written.gone)


def _with_left_out(
    report: ExportReport, what: str, kind: str, reason: str, count: int
) -> ExportReport:
    """Return the report with one more entry in ``left_out``, unless ``count`` is 0."""
    if not count:
        return report
    entry = {"what": what, "kind": kind, "reason": reason, "count": count}
    left_out = (*report.left_out, entry)
    return ExportReport(report.out, report.sessions, report.rows, left_out, report.until)


def _states(connection: Connection, sessions: SessionTable) -> list[dict[str, Any]]:
    """Return the versions of the study under which the sessions ran, without secret settings."""
    rows = connection.execute(select(STUDIES)).fetchall()
    states = []
    for row in sorted(rows, key=lambda row: (row.first_served, row.digest)):
        if row.digest in sessions.studies:
            kept = {k: v for k, v in row.settings.items() if k not in _SECRET_SETTINGS}
            states.append({
                "digest": row.digest, "name": row.name, "version": row.version,
                "stimuli_digest": row.stimuli_digest,
                "first_served": iso_times(np.array([row.first_served]))[0].as_py(),
                "settings": kept,
            })  # fmt: skip
    return states


def _write_stimuli(folder: Path, study: Study, expected: Sequence[Sequence[str]]) -> None:
    """Write ``stimuli.csv`` and ``expected.csv``, whose rows are ``expected``."""
    names = [column.name for column in STIMULI_COLUMNS]
    shown = [[getattr(stimulus, name) for name in names] for stimulus in study.stimuli]
    _write_csv(folder / "stimuli.csv", names, shown)
    _write_csv(folder / "expected.csv", expected[0], expected[1:])


def _write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    lines = io.StringIO(newline="")
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerows([header, *rows])
    path.write_bytes(lines.getvalue().encode())


def _write_psych_ds(
    folder: Path,
    study: Study,
    sessions: SessionTable,
    until: str | None,
    tables: Mapping[str, tuple[Path, Sequence[Column]]],
) -> None:
    """Write the Psych-DS dataset from the CSV files and columns of tables already written."""
    began = pc.min(sessions.table.column("started_at")).as_py()
    write_psych_ds(
        folder / "psych-ds",
        tables,
        name=study.name,
        description=study.title,
        readme=readme(study, "psych-ds"),
        covers=(began, until) if began and until else None,
    )


def _write_json(path: Path, values: Any) -> None:
    text = json.dumps(values, indent=2, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
