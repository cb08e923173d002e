"""What is stored besides answers and sessions: events, and the moments within each trial."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import groupby
from typing import Any

import numpy as np
import pyarrow as pa
from sqlalchemy import Connection, select

from physion.analysis.people.response_schema import PHASES, Column
from physion.experiment.export.arrow_types import arrow_schema
from physion.experiment.export.iso_times import iso_times
from physion.experiment.export.trial_rows import AT_ONCE, Trials
from physion.experiment.store.tables import EVENTS

_SESSION = Column("session", "text", "As in the sessions", required=True, may_be_empty=False)

EVENT_COLUMNS: tuple[Column, ...] = (
    _SESSION,
    Column("number", "integer", "Place among the events of the session, from 0", low=0,
           required=True, may_be_empty=False),
    Column("kind", "text", "What happened: hidden, visible, offline, online, error, resized, ..."),
    Column("at_ms", "number", "When, since the page was opened, by the browser's clock", unit="ms",
           low=0),
    Column("stored_at", "time", "When the server stored it"),
    Column("data", "text", "What else is known of it, as a JSON object"),
)  # fmt: skip
"""One row an event of a session."""

DETAIL_COLUMNS: tuple[Column, ...] = (
    _SESSION,
    Column("phase", "choice", "As in the trials", choices=PHASES, required=True,
           may_be_empty=False),
    Column("trial", "integer", "As in the trials", low=0, required=True, may_be_empty=False),
    Column(
        "details", "text",
        "JSON object of what the page measured besides, times in ms: flashes: moments at which the "
        "cue went on and off; frames: for each frame that was presented its moment, its number in "
        "the movie from 0, and how many the browser had presented so far; play_ms: how long the "
        "movie took to start; ended_ms, enabled_ms: when it ended, and when the buttons were "
        "enabled; visibility: when the page was hidden or shown; shown_width, shown_height: size "
        "of the movie in CSS pixels; attempts: how often the trial was begun. Moments count from "
        "the beginning of the trial",
    ),
)  # fmt: skip
"""One row a trial."""


def read_events(connection: Connection, sessions: pa.Table) -> Iterator[pa.Table]:
    """Events of the sessions of a table of `read_sessions`, in their order."""
    names = sessions.column("session").to_pylist()
    for first in range(0, len(names), AT_ONCE):
        chosen = names[first : first + AT_ONCE]
        rank = {name: place for place, name in enumerate(chosen)}
        rows = connection.execute(select(EVENTS).where(EVENTS.c.session.in_(chosen))).fetchall()
        ordered = sorted(rows, key=lambda row: (rank[row.session], row.event))
        numbers: list[int] = []
        for _, own in groupby(ordered, key=lambda row: row.session):
            numbers += range(len(list(own)))
        yield _event_table(ordered, numbers)


def _event_table(rows: list[Any], numbers: list[int]) -> pa.Table:
    stored_at = np.array([row.stored_at for row in rows], dtype=np.float64)
    # Keys sorted: databases may give an object back in another order.
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


def detail_table(trials: Trials) -> pa.Table:
    """The details of answers that were read with them."""
    keys = [trials.table.column(name) for name in ("session", "phase", "trial")]
    return pa.table([*keys, trials.details], schema=arrow_schema(DETAIL_COLUMNS))
