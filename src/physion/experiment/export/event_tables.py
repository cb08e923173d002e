"""Rows of the tables of browser events and of the measured details of trials."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import groupby
from typing import Any

import numpy as np
import pyarrow as pa
from sqlalchemy import Connection, select

from physion.analysis.people.responses import PHASES, Column
from physion.experiment.export.arrow_types import arrow_schema
from physion.experiment.export.iso_times import iso_times
from physion.experiment.export.trial_rows import AT_ONCE, TrialBatch
from physion.experiment.store.database import EVENTS

_SESSION = Column("session", "text", "As in the sessions", required=True, may_be_empty=False)

EVENT_COLUMNS: tuple[Column, ...] = (
    _SESSION,
    Column("number", "integer", "Index among the events of the session, from 0", low=0,
           required=True, may_be_empty=False),
    Column("kind", "text", "What happened: hidden, visible, offline, online, error, resized, ..."),
    Column("at_ms", "number", "Time since the page was opened, by the browser's clock", unit="ms",
           low=0),
    Column("stored_at", "time", "Time when the server stored it"),
    Column("data", "text", "Further data of the event, as a JSON object"),
)  # fmt: skip
"""Columns of ``events``: one row per event of a session."""

DETAIL_COLUMNS: tuple[Column, ...] = (
    _SESSION,
    Column("phase", "choice", "As in the trials", choices=PHASES, required=True,
           may_be_empty=False),
    Column("trial", "integer", "As in the trials", low=0, required=True, may_be_empty=False),
    Column(
        "details", "text",
        "JSON object of further measurements; times in ms from the start of the trial. flashes: "
        "times at which the cue was switched on and off; frames: for each presented frame its "
        "time, its index in the movie from 0, and the number of frames presented so far; play_ms: "
        "time that the movie took to start; ended_ms, enabled_ms: times of the end of the movie "
        "and of enabling the buttons; visibility: times at which the page was hidden or shown; "
        "shown_width, shown_height: size of the movie in CSS pixels; attempts: number of times "
        "the trial was started",
    ),
)  # fmt: skip
"""Columns of ``trial_details``: one row per trial."""


def read_events(connection: Connection, sessions: pa.Table) -> Iterator[pa.Table]:
    """Yield tables of the events of some sessions at a time, in the order of ``sessions``."""
    names = sessions.column("session").to_pylist()
    for first in range(0, len(names), AT_ONCE):
        chosen = names[first : first + AT_ONCE]
        rank = {name: index for index, name in enumerate(chosen)}
        rows = connection.execute(select(EVENTS).where(EVENTS.c.session.in_(chosen))).fetchall()
        ordered = sorted(rows, key=lambda row: (rank[row.session], row.event))
        numbers: list[int] = []
        for _, group in groupby(ordered, key=lambda row: row.session):
            numbers += range(len(list(group)))
        yield _event_table(ordered, numbers)


def _event_table(rows: list[Any], numbers: list[int]) -> pa.Table:
    """Return the exported table of these events."""
    stored_at = np.array([row.stored_at for row in rows], dtype=np.float64)
    # Keys are sorted because databases may return them in another order.
    data = [json.dumps(row.data, sort_keys=True, ensure_ascii=False) for row in rows]
    columns = {
        "session": pa.array([row.session for row in rows], pa.string()),
        "number": pa.array(numbers, pa.int64()),
        "kind": pa.array([row.kind for row in rows], pa.string()),
        "at_ms": pa.array([row.at_ms for row in rows], pa.float64()),
        "stored_at": iso_times(stored_at),
        "data": pa.array(data, pa.string()),
    }
    return pa.table(columns, arrow_schema(EVENT_COLUMNS))


def detail_table(trials: TrialBatch) -> pa.Table:
    """Return the table of details of trials that were read with ``details=True``."""
    keys = [trials.table.column(name) for name in ("session", "phase", "trial")]
    return pa.table([*keys, trials.details], schema=arrow_schema(DETAIL_COLUMNS))
