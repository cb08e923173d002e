"""The large tables of an export, written part by part while the next part is read."""

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

from physion.analysis.people.response_schema import SESSION_COLUMNS, TRIAL_COLUMNS
from physion.experiment.export.bids import BidsFolder
from physion.experiment.export.descriptions import STIMULI_COLUMNS
from physion.experiment.export.further_tables import (
    DETAIL_COLUMNS,
    EVENT_COLUMNS,
    detail_table,
    read_events,
)
from physion.experiment.export.session_rows import Sessions
from physion.experiment.export.table_files import TableFiles
from physion.experiment.export.trial_rows import Trials, read_trials
from physion.experiment.study.study import Study

WAITING = 2
"""Parts that may wait for being written, so that memory stays bounded."""
TABLES = {
    "trials": TRIAL_COLUMNS,
    "sessions": SESSION_COLUMNS,
    "events": EVENT_COLUMNS,
    "trial_details": DETAIL_COLUMNS,
    "stimuli": STIMULI_COLUMNS,
}


@dataclass(frozen=True)
class Written:
    """Rows by table, answers to stimuli that are gone, and the last moment in the data."""

    rows: dict[str, int]
    gone: int
    until: str | None


def write_tables(
    folder: Path,
    connection: Connection,
    study: Study,
    sessions: Sessions,
    bids: BidsFolder | None,
) -> Written:
    """Writes trials, sessions, events and details, in one go through the answers."""
    gone = 0
    latest = [_latest(sessions.table, column) for column in ("started_at", "finished_at")]
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
    return Written(rows, gone, max(latest) or None)


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
