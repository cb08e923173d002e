"""Writing of the large tables of an export, in batches, while the next batch is being read."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from sqlalchemy import Connection

from physion.analysis.people.responses import SESSION_COLUMNS, TRIAL_COLUMNS, Column
from physion.experiment.export.conventions.bids import BidsWriter
from physion.experiment.export.descriptions import STIMULI_COLUMNS
from physion.experiment.export.event_tables import (
    DETAIL_COLUMNS,
    EVENT_COLUMNS,
    detail_table,
    read_events,
)
from physion.experiment.export.further_answers import (
    ATTENTION_COLUMNS,
    REPEAT_COLUMNS,
    read_attention,
    read_practice_repeats,
)
from physion.experiment.export.question_table import (
    KEYS,
    question_columns,
    read_own_answers,
    read_questions,
)
from physion.experiment.export.session_rows import SessionTable
from physion.experiment.export.table_writer import TableWriter
from physion.experiment.export.trial_rows import TrialBatch, read_trials
from physion.experiment.study.study import Study

WAITING = 2
"""Maximum number of batches waiting to be written, which bounds the memory."""
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
    bids: BidsWriter | None,
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
    bids
        Writer of the BIDS dataset, if there is to be one.
    """
    gone = 0
    latest = [_latest(sessions.table, column) for column in ("started_at", "finished_at")]
    with ExitStack() as stack:
        files = {
            name: stack.enter_context(TableWriter(folder, name, TABLES[name]))
            for name in ("trials", "sessions", "events")
        }
        details = stack.enter_context(
            TableWriter(folder, "trial_details", DETAIL_COLUMNS, with_csv=False, level=1)
        )

        def write(part: TrialBatch) -> None:
            files["trials"].write(part.table)
            details.write(detail_table(part))
            if bids is not None:
                bids.write(part)

        files["sessions"].write(sessions.table)
        own = _write_own_answers(folder, connection, study, sessions)
        for events in read_events(connection, sessions.table):
            files["events"].write(events)
        with _BackgroundWriter(write) as behind:
            for part in read_trials(connection, study, sessions.table, details=True):
                gone += len(part.unknown)
                latest.append(_latest(part.table, "answered_at"))
                behind(part)
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
            with TableWriter(folder, name, columns) as file:
                file.write(table)
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
    with TableWriter(folder, "questions", columns) as file:
        file.write(table)
    return table, columns


def _latest(table: pa.Table, column: str) -> str:
    """Return the latest time in a column, or an empty text."""
    return str(pc.max(table.column(column)).as_py() or "")


class _BackgroundWriter:
    """Calls a function in order in a background thread, while this thread reads the next batch."""

    def __init__(self, function: Callable[[TrialBatch], None]) -> None:
        self._function = function
        self._pool = ThreadPoolExecutor(1)
        self._waiting: deque[Future[None]] = deque()

    def __call__(self, part: TrialBatch) -> None:
        self._waiting.append(self._pool.submit(self._function, part))
        while len(self._waiting) > WAITING:
            self._waiting.popleft().result()

    def __enter__(self) -> _BackgroundWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._pool.shutdown(cancel_futures=kind is not None)
        if kind is None:
            for future in self._waiting:
                future.result()
