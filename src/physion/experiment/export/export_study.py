"""Export of the data of a study as a folder of tables, also in the convention Psych-DS.

::

    OUT/
      README.md              description of the files, counts, and what was left out
      trials.csv, .parquet   one row per trial: physion compare --responses
      sessions.csv, .parquet one row per session: physion compare --sessions
      questions.csv, .parquet    answers to the lab's own questions, if there are any
      practice_repeats.csv, .parquet  answers to practice trials that were repeated, if any
      attention_checks.csv, .parquet  answers to attention checks, if there are any
      events.csv, .parquet   other events in the browser
      trial_details.parquet  times of frames and cues within each trial
      stimuli.csv, expected.csv   the stimuli; the test stimuli of each scenario
      data_dictionary.json   description of every column of every table
      study.json             settings and texts of the study, without codes and keys
      psych-ds/              the same data as a Psych-DS dataset

The same data and package version give byte-identical files, whatever the database.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pyarrow import csv as arrow_csv
from sqlalchemy import Connection, Engine, select

from physion.analysis.people.responses import SESSION_COLUMNS, TRIAL_COLUMNS
from physion.core.errors import BadInputError
from physion.core.files import new_folder
from physion.core.tables import FORMULA, Column, data_dictionary
from physion.experiment.export.descriptions import readme, write_psych_ds
from physion.experiment.export.tables import (
    ATTENTION_COLUMNS,
    DETAIL_COLUMNS,
    EVENT_COLUMNS,
    EXPORTED_KINDS,
    KEYS,
    REPEAT_COLUMNS,
    STIMULI_COLUMNS,
    SessionSelection,
    SessionTable,
    arrow_schema,
    detail_table,
    iso_times,
    question_columns,
    read_attention,
    read_events,
    read_own_answers,
    read_practice_repeats,
    read_questions,
    read_sessions,
    read_trials,
    snapshot,
)
from physion.experiment.store.database import STUDIES
from physion.experiment.study.settings import EARLY_ENDS
from physion.experiment.study.study import Study

# --- the folder: replaces an older export, and nothing else ---

_NAMES = re.compile(
    r"README\.md|(trials|sessions|questions|practice_repeats|attention_checks|events)\.(csv|parquet)"
    r"|trial_details\.parquet|(stimuli|expected)\.csv|(data_dictionary|study)\.json"
    r"|psych-ds(/(README\.md|dataset_description\.json|data(/study-[^/]*_data\.csv)?))?"
)
"""Paths within an export."""


def _refuse_others(out: Path) -> None:
    """Raise `BadInputError` if replacing ``out`` would delete anything but an export."""
    if not out.is_symlink() and not out.exists():
        return
    if out.is_symlink() or not out.is_dir():
        raise BadInputError(f"{out} is not a folder; choose another one with --out")
    names = [path.relative_to(out).as_posix() for path in out.rglob("*")]
    if names and not {"study.json", "data_dictionary.json"} <= set(names):
        raise BadInputError(f"{out} contains something else; choose another folder with --out")
    for name in names:
        if not _NAMES.fullmatch(name):
            raise BadInputError(
                f"{out} is an export to which {name} was added; move your files elsewhere, or "
                "choose another folder with --out"
            )


# --- one table as CSV and parquet; the same rows give the same bytes ---

NAMES = frozenset({"participant", "session", "scenario", "condition", "stimulus", "kind"})
"""Text columns whose values are names or hashes; other texts are free, and hardly ever repeat."""


class TableWriter:
    """Writes ``NAME.csv`` (UTF-8, LF line ends) and ``NAME.parquet`` (Zstandard) in a folder.

    In the CSV file an apostrophe stands before a free text that begins like a formula.

    Parameters
    ----------
    opened
        Closes the files.
    folder, name
        Folder, and name of the files without ending.
    columns
        Columns of the table.
    with_csv
        Whether to write the CSV file too.
    level
        Compression level of the parquet file.
    """

    def __init__(
        self,
        opened: ExitStack,
        folder: Path,
        name: str,
        columns: Sequence[Column],
        *,
        with_csv: bool = True,
        level: int = 3,
    ) -> None:
        self.rows = 0
        schema = arrow_schema(columns)
        names = [c.name for c in columns if c.kind != "text" or c.name in NAMES]
        self._texts = [c.name for c in columns if c.name not in names]
        parquet = pq.ParquetWriter(
            folder / f"{name}.parquet", schema, compression="zstd", compression_level=level,
            use_dictionary=names,
        )  # fmt: skip
        self._parquet, self._csv = opened.enter_context(parquet), None
        if with_csv:
            file = opened.enter_context((folder / f"{name}.csv").open("wb"))
            file.write(",".join(column.name for column in columns).encode() + b"\n")
            quoting = "none" if len(names) == len(columns) else "needed"
            options = arrow_csv.WriteOptions(include_header=False, quoting_style=quoting)
            csv_file = arrow_csv.CSVWriter(file, schema, write_options=options)
            self._csv = opened.enter_context(csv_file)

    def write(self, table: pa.Table) -> None:
        """Append rows."""
        self.rows += table.num_rows
        self._parquet.write_table(table)
        if self._csv is None:
            return
        for name in self._texts:
            place = table.schema.get_field_index(name)
            safe = pc.replace_substring_regex(table[name], FORMULA, r"'\1")
            table = table.set_column(place, table.schema.field(place), safe)
        self._csv.write_table(table)


# --- all tables, in batches of sessions ---

TABLES = {
    "trials": TRIAL_COLUMNS,
    "sessions": SESSION_COLUMNS,
    "events": EVENT_COLUMNS,
    "trial_details": DETAIL_COLUMNS,
    "stimuli": STIMULI_COLUMNS,
}


@dataclass(frozen=True)
class WrittenTables:
    """What was written.

    Attributes
    ----------
    rows
        Rows by table.
    gone
        Answers whose stimuli no longer exist.
    until
        Latest time in the data.
    own
        Answers to the lab's own questions with their columns; None if there are no questions.
    described
        Columns of each written table.
    """

    rows: dict[str, int]
    gone: int
    until: str | None
    own: tuple[pa.Table, tuple[Column, ...]] | None
    described: dict[str, tuple[Column, ...]]


def write_tables(
    folder: Path,
    connection: Connection,
    study: Study,
    sessions: SessionTable,
) -> WrittenTables:
    """Write trials, sessions, questions, events and details in one pass over the answers.

    Parameters
    ----------
    folder
        Folder of the tables.
    connection
        Connection of `snapshot`.
    study
        The study.
    sessions
        The sessions to export.
    """
    gone = 0
    latest = [_latest(sessions.table, column) for column in ("started_at", "finished_at")]
    with ExitStack() as stack:
        files = {
            name: TableWriter(stack, folder, name, TABLES[name])
            for name in ("trials", "sessions", "events")
        }
        details = TableWriter(
            stack, folder, "trial_details", DETAIL_COLUMNS, with_csv=False, level=1
        )
        files["sessions"].write(sessions.table)
        own = _write_own_answers(folder, connection, study, sessions)
        for events in read_events(connection, sessions.table):
            files["events"].write(events)
        for part in read_trials(connection, study, sessions.table):
            gone += len(part.unknown)
            latest.append(_latest(part.table, "answered_at"))
            files["trials"].write(part.table)
            details.write(detail_table(part))
        rows = {name: file.rows for name, file in (*files.items(), ("trial_details", details))}
    described = dict(TABLES)
    if own is not None:
        rows["questions"], described["questions"] = own[0].num_rows, own[1]
    further = {
        "practice_repeats": (read_practice_repeats, REPEAT_COLUMNS),
        "attention_checks": (read_attention, ATTENTION_COLUMNS),
    }
    for name, (read, columns) in further.items():
        table = read(connection, study, sessions.table)
        if table.num_rows:
            with ExitStack() as stack:
                TableWriter(stack, folder, name, columns).write(table)
            rows[name], described[name] = table.num_rows, columns
    return WrittenTables(rows, gone, max(latest) or None, own, described)


def _write_own_answers(
    folder: Path, connection: Connection, study: Study, sessions: SessionTable
) -> tuple[pa.Table, tuple[Column, ...]] | None:
    """Write the table of the lab's own questions, if there are any; return it and its columns."""
    questions = read_questions(connection, study)
    if not questions:
        return None
    columns = (*KEYS, *question_columns(questions))
    table = read_own_answers(connection, questions, sessions.table)
    with ExitStack() as stack:
        TableWriter(stack, folder, "questions", columns).write(table)
    return table, columns


def _latest(table: pa.Table, column: str) -> str:
    """Return the latest time in a column, or an empty text."""
    return str(pc.max(table.column(column)).as_py() or "")


GONE = "its stimulus is no longer in the study folder"
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

    Raises
    ------
    BadInputError
        ``out`` exists and is anything but an export without added files or an empty folder.
    """
    kinds = EXPORTED_KINDS if simulated else ("person",)
    _refuse_others(out)
    # Other users of the machine must not read the answers.
    with new_folder(out, 0o700) as folder:
        with snapshot(engine) as connection:
            sessions = read_sessions(connection, study, SessionSelection(kinds, scenario))
            written = write_tables(folder, connection, study, sessions)
            states = _states(connection, sessions)
        report = _report(out, sessions, written)
        _write_stimuli(folder, study)
        _write_json(folder / "study.json", {"states": states})
        dictionary: dict[str, Any] = {
            name: data_dictionary(columns) for name, columns in written.described.items()
        }
        _write_json(folder / "data_dictionary.json", dictionary)
        chosen = {
            name: (folder / f"{name}.csv", columns)
            for name, columns in written.described.items()
            if name in _PSYCH_DS_TABLES
        }
        _write_psych_ds(folder, study, sessions, report.until, chosen)
        (folder / "README.md").write_text(readme(study, "export", report.facts()), "utf-8")
    return report


def _report(out: Path, sessions: SessionTable, written: WrittenTables) -> ExportReport:
    """Return the report of the tables, before Psych-DS."""
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


def _write_stimuli(folder: Path, study: Study) -> None:
    """Write ``stimuli.csv`` and ``expected.csv``, the test stimuli of each scenario."""
    names = [column.name for column in STIMULI_COLUMNS]
    shown = [[getattr(stimulus, name) for name in names] for stimulus in study.stimuli]
    _write_csv(folder / "stimuli.csv", names, shown)
    expected = [(s.stimulus, s.scenario) for s in study.stimuli if s.phase == "test"]
    _write_csv(folder / "expected.csv", ("stimulus", "scenario"), expected)


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
