"""The data of a study as a folder of files: what the analysis reads, and what conventions ask for.

::

    OUT/
      README.md              what is what
      trials.csv, .parquet   one row a session and trial: physion compare --responses
      sessions.csv, .parquet one row a session: physion compare --sessions
      events.csv, .parquet   what else happened
      trial_details.parquet  moments within each trial
      stimuli.csv, expected.csv   what was shown; what the test of each scenario consists of
      data_dictionary.json   every column of every table
      study.json             what the study decided, without codes and keys
      psych-ds/, bids/       the same in two conventions
      export.json            counts, and what was left out; written last

The same data and version of this package give the same bytes.
"""

from __future__ import annotations

import csv
import io
import json
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from sqlalchemy import Connection, Engine, select

import physion
from physion.analysis.response_schema import SESSION_COLUMNS, TRIAL_COLUMNS, data_dictionary
from physion.experiment.answer_tables import snapshot
from physion.experiment.bids import BidsFolder
from physion.experiment.export_folder import whole_folder, write_manifest
from physion.experiment.export_words import STIMULI_COLUMNS, readme
from physion.experiment.further_tables import (
    DETAIL_COLUMNS,
    EVENT_COLUMNS,
    detail_table,
    read_events,
)
from physion.experiment.iso_times import iso_times
from physion.experiment.psych_ds import write_psych_ds
from physion.experiment.session_rows import KINDS, Sessions, Wanted, read_sessions
from physion.experiment.spreadsheet import RULE
from physion.experiment.study import Study
from physion.experiment.table_files import TableFiles
from physion.experiment.tables import STUDIES
from physion.experiment.trial_rows import Trials, read_trials

Layout = Literal["both", "psych-ds", "bids"]
GONE = "answer to a stimulus that the study folder has no more"
NO_FILE = "no answer yet, and so no file in bids/"
WAITING = 2
"""Parts that may wait for being written, so that memory stays bounded."""
TABLES = {
    "trials": TRIAL_COLUMNS,
    "sessions": SESSION_COLUMNS,
    "events": EVENT_COLUMNS,
    "trial_details": DETAIL_COLUMNS,
    "stimuli": STIMULI_COLUMNS,
}
_SECRET_SETTINGS = ("recruitment", "folder", "stimuli")


@dataclass(frozen=True)
class Report:
    """What was exported to ``out``.

    ``sessions``: by kind and ``finished`` or ``unfinished``. ``rows``: by table. ``left_out``: what
    (session or answer), kind, reason and count. ``until``: the last moment in the data.
    """

    out: Path
    sessions: dict[str, dict[str, int]]
    rows: dict[str, int]
    left_out: tuple[dict[str, Any], ...]
    until: str | None

    def facts(self) -> dict[str, Any]:
        """The counts, as plain values; no path."""
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
) -> Report:
    """Export all data at one moment into the folder ``out``, whole or not at all.

    A server may run meanwhile. An ``out`` that is there is replaced where it is an export that
    nobody added anything to; `BadInputError` otherwise. Without ``simulated``, people alone.
    """
    kinds = KINDS if simulated else ("person",)
    with whole_folder(out) as folder:
        with snapshot(engine) as connection:
            sessions = read_sessions(connection, study, Wanted(kinds, scenario))
            bids = None
            if layout != "psych-ds":
                bids = BidsFolder(folder / "bids", study, sessions.table)
            written = _write_tables(folder, connection, study, sessions, bids)
            states = _states(connection, sessions)
        report = _report(out, sessions, written)
        _write_stimuli(folder, study)
        _write_json(folder / "study.json", {"states": states})
        dictionary: dict[str, Any] = {
            name: data_dictionary(columns) for name, columns in TABLES.items()
        }
        _write_json(folder / "data_dictionary.json", dictionary | {"spreadsheet_safety": RULE})
        if bids is not None:
            without = bids.close(
                name=study.title, readme=readme(study, "bids"), version=physion.__version__
            )
            report = _with_left_out(report, "session", "any", NO_FILE, without)
        if layout != "bids":
            _write_psych_ds(folder, study, sessions, report.until)
        (folder / "README.md").write_text(readme(study, "export", report.facts()), "utf-8")
        known = {"package": f"physion {physion.__version__}", "name": study.name}
        write_manifest(folder, known | {"version": study.version} | report.facts())
    return report


@dataclass(frozen=True)
class _Written:
    """Rows by table, answers to stimuli that are gone, and the last moment in the data."""

    rows: dict[str, int]
    gone: int
    until: str | None


# --- tables -------------------------------------------------------------------------------------


def _write_tables(
    folder: Path,
    connection: Connection,
    study: Study,
    sessions: Sessions,
    bids: BidsFolder | None,
) -> _Written:
    """Writes trials, sessions, events and details, in one go through the answers."""
    gone, latest = (
        0,
        [_latest(sessions.table, "started_at"), _latest(sessions.table, "finished_at")],
    )
    with ExitStack() as stack:
        files = {
            name: stack.enter_context(TableFiles(folder, name, TABLES[name]))
            for name in ("trials", "sessions", "events")
        }
        details = stack.enter_context(
            TableFiles(folder, "trial_details", DETAIL_COLUMNS, with_csv=False, level=1)
        )

        def write(part: Trials) -> None:
            files["trials"].write(part.table)
            details.write(detail_table(part))
            if bids is not None:
                bids.write(part)

        files["sessions"].write(sessions.table)
        for events in read_events(connection, sessions.table):
            files["events"].write(events)
        with _Behind(write) as behind:
            for part in read_trials(connection, study, sessions.table, details=True):
                gone += len(part.unknown)
                latest.append(_latest(part.table, "answered_at"))
                behind(part)
        rows = {name: file.rows for name, file in (*files.items(), ("trial_details", details))}
    return _Written(rows, gone, max(latest) or None)


def _latest(table: pa.Table, column: str) -> str:
    """The last moment of a column; empty where it has none."""
    return str(pc.max(table.column(column)).as_py() or "")


class _Behind:
    """Calls a function in one other thread, in order, while this one fetches what comes next."""

    def __init__(self, function: Callable[[Trials], None]) -> None:
        self._function = function
        self._pool = ThreadPoolExecutor(1)
        self._waiting: deque[Future[None]] = deque()

    def __call__(self, part: Trials) -> None:
        self._waiting.append(self._pool.submit(self._function, part))
        while len(self._waiting) > WAITING:
            self._waiting.popleft().result()

    def __enter__(self) -> _Behind:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._pool.shutdown(cancel_futures=kind is not None)
        if kind is None:
            for future in self._waiting:
                future.result()


# --- what stands beside the tables --------------------------------------------------------------


def _report(out: Path, sessions: Sessions, written: _Written) -> Report:
    kinds: dict[str, dict[str, int]] = {}
    for kind in KINDS:
        states = {state: sessions.states[kind, state] for state in ("finished", "unfinished")}
        if any(states.values()):
            kinds[kind] = states
    report = Report(out, kinds, written.rows, (), written.until)
    for (kind, reason), count in sorted(sessions.left_out.items()):
        report = _with_left_out(report, "session", kind, reason, count)
    return _with_left_out(report, "answer", "any", GONE, written.gone)


def _with_left_out(report: Report, what: str, kind: str, reason: str, count: int) -> Report:
    if not count:
        return report
    entry = {"what": what, "kind": kind, "reason": reason, "count": count}
    left_out = (*report.left_out, entry)
    return Report(report.out, report.sessions, report.rows, left_out, report.until)


def _states(connection: Connection, sessions: Sessions) -> list[dict[str, Any]]:
    """The states of the study under which the sessions ran, without codes and links."""
    rows = connection.execute(select(STUDIES)).fetchall()
    found = []
    for row in sorted(rows, key=lambda row: (row.first_served, row.digest)):
        if row.digest in sessions.studies:
            kept = {k: v for k, v in row.settings.items() if k not in _SECRET_SETTINGS}
            found.append({
                "digest": row.digest, "name": row.name, "version": row.version,
                "stimuli_digest": row.stimuli_digest,
                "first_served": iso_times(np.array([row.first_served]))[0].as_py(),
                "settings": kept,
            })  # fmt: skip
    return found


def _write_stimuli(folder: Path, study: Study) -> None:
    names = [column.name for column in STIMULI_COLUMNS]
    shown = [[getattr(stimulus, name) for name in names] for stimulus in study.stimuli]
    _write_csv(folder / "stimuli.csv", names, shown)
    test = [[s.stimulus, s.scenario] for s in study.stimuli if s.phase == "test"]
    _write_csv(folder / "expected.csv", ["stimulus", "scenario"], test)


def _write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    lines = io.StringIO(newline="")
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerows([header, *rows])
    path.write_bytes(lines.getvalue().encode())


def _write_psych_ds(folder: Path, study: Study, sessions: Sessions, until: str | None) -> None:
    began = pc.min(sessions.table.column("started_at")).as_py()
    write_psych_ds(
        folder / "psych-ds",
        {name: (folder / f"{name}.csv", TABLES[name]) for name in ("trials", "sessions", "events")},
        name=study.name,
        description=study.title,
        readme=readme(study, "psych-ds"),
        covers=(began, until) if began and until else None,
    )


def _write_json(path: Path, values: Any) -> None:
    text = json.dumps(values, indent=2, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
