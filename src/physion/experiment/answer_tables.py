"""The data of a study as two tables: one row a session, one row a session and trial.

Columns, types and order are those of `physion.analysis.response_schema`. Sessions stand in the
order in which they began; trials by session, familiarization first, in the order in which they were
shown. Labels come from the study folder. Which sessions are never in any table, and why, is counted
(`Sessions.left_out`).
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pyarrow as pa
from sqlalchemy import (
    Connection,
    Engine,
    Float,
    Integer,
    case,
    cast,
    func,
    select,
    type_coerce,
)
from sqlalchemy.sql import ColumnElement

from physion.analysis.response_schema import SESSION_COLUMNS, TRIAL_COLUMNS, Column
from physion.errors import PhysionError, UnknownNameError
from physion.experiment.iso_times import iso_times
from physion.experiment.stimuli import LOOKS, PHASES, Stimulus
from physion.experiment.study import Study
from physion.experiment.tables import ANSWERS, SESSIONS, STUDIES

KINDS = ("person", "simulated")
"""Kinds of sessions that can be asked for; previews cannot."""
PREVIEW = "preview by the experimenter"
NO_CONSENT = "no consent was given"
WITHDRAWN = "the participant withdrew"
UNFINISHED = "not finished, and only finished ones were asked for"
OTHER_KIND = "{kind}, which was not asked for"
OTHER_SCENARIO = "of a scenario that was not asked for"
AT_ONCE = 200
"""Sessions whose answers are fetched together."""
ARROW_TYPES = {
    "text": pa.string(),
    "choice": pa.string(),
    "time": pa.string(),
    "integer": pa.int64(),
    "number": pa.float64(),
    "flag": pa.bool_(),
}


_Row = Any
"""A row of sessions with the study's name and version: the library's type lists all columns."""


@dataclass(frozen=True)
class Wanted:
    """Which sessions: of these ``kinds``, of one scenario (None: all), finished ones alone?"""

    kinds: Sequence[str] = KINDS
    scenario: str | None = None
    finished_only: bool = False


@dataclass(frozen=True)
class Sessions:
    """The ``table`` of sessions (empty cells are null), and what is not in it.

    ``states``: sessions of the table by kind and ``finished`` or ``unfinished``. ``left_out``:
    sessions by kind and reason. ``studies``: digests of the states of the study folder under which
    the table's sessions ran.
    """

    table: pa.Table
    states: Counter[tuple[str, str]]
    left_out: Counter[tuple[str, str]]
    studies: tuple[str, ...]


@dataclass(frozen=True)
class Trials:
    """Answers of some consecutive sessions.

    ``sessions``: their rows in the table of sessions. ``counts``: rows of ``table`` by session.
    ``details``: JSON text by row, where it was asked for. ``unknown``: names of stimuli that the
    study folder has no more, by row that is left out for this.
    """

    sessions: range
    table: pa.Table
    counts: npt.NDArray[np.int64]
    details: pa.Array | None
    unknown: tuple[str, ...]


def read_tables(
    engine: Engine,
    study: Study,
    *,
    kinds: Sequence[str] = KINDS,
    scenario: str | None = None,
    finished_only: bool = False,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Trials and sessions as they are at one moment, as `response_schema.check_table` types them.

    Sessions without consent and of participants who withdrew are left out. Raises `PhysionError`
    for answers to stimuli that the study folder has no more.
    """
    with snapshot(engine) as connection:
        sessions = read_sessions(connection, study, Wanted(kinds, scenario, finished_only))
        parts = list(read_trials(connection, study, sessions.table))
    unknown = [name for part in parts for name in part.unknown]
    if unknown:
        raise PhysionError(
            f"{len(unknown)} answers are to stimuli that {study.folder} has no more, the first to "
            f"{unknown[0]}; bring them back into stimuli.csv"
        )
    empty = arrow_schema(TRIAL_COLUMNS).empty_table()
    trials = pa.concat_tables([empty, *(part.table for part in parts)])
    return as_frame(trials, TRIAL_COLUMNS), as_frame(sessions.table, SESSION_COLUMNS)


@contextlib.contextmanager
def snapshot(engine: Engine) -> Iterator[Connection]:
    """A connection that sees the database as it is at its first question, whoever writes."""
    with engine.connect() as connection:
        if engine.dialect.name == "postgresql":
            connection.execution_options(
                isolation_level="REPEATABLE READ", postgresql_readonly=True
            )
        with connection.begin():
            yield connection


def arrow_schema(columns: Sequence[Column]) -> pa.Schema:
    """The columns with the types that they have in Arrow and parquet."""
    return pa.schema([pa.field(column.name, ARROW_TYPES[column.kind]) for column in columns])


def as_frame(table: pa.Table, columns: Sequence[Column]) -> pd.DataFrame:
    """A table of Arrow with the types of `response_schema.check_table`."""
    nullable = {pa.int64(): pd.Int64Dtype(), pa.bool_(): pd.BooleanDtype()}
    frame = table.to_pandas(types_mapper=nullable.get)
    typed = {}
    for column in columns:
        values = frame[column.name]
        if ARROW_TYPES[column.kind] == pa.string():
            values = values.astype("str").fillna("")
        elif column.kind == "flag" and not column.may_be_empty:
            values = values.astype(bool)
        typed[column.name] = values
    return pd.DataFrame(typed)


# --- sessions -----------------------------------------------------------------------------------


def read_sessions(connection: Connection, study: Study, wanted: Wanted = Wanted()) -> Sessions:
    """The table of sessions, and what is left out of it, for which reason."""
    for kind in wanted.kinds:
        if kind not in KINDS:
            raise UnknownNameError("kind of session", kind, KINDS)
    if wanted.scenario is not None and wanted.scenario not in study.scenarios:
        raise UnknownNameError("scenario", wanted.scenario, study.scenarios)
    query = select(*SESSIONS.c, STUDIES.c.name, STUDIES.c.version).join(
        STUDIES, STUDIES.c.digest == SESSIONS.c.study
    )
    kept: list[_Row] = []
    states: Counter[tuple[str, str]] = Counter()
    left_out: Counter[tuple[str, str]] = Counter()
    for row in connection.execute(query):
        reason = _why_not(row, wanted)
        if reason is not None:
            left_out[row.kind, reason] += 1
            continue
        kept.append(row)
        states[row.kind, "unfinished" if row.finished_at is None else "finished"] += 1
    # Sorted here: databases differ in how they order text.
    kept.sort(key=lambda row: (row.started_at, row.session))
    digests = tuple(dict.fromkeys(row.study for row in kept))
    return Sessions(_session_table(kept), states, left_out, digests)


def _why_not(row: _Row, wanted: Wanted) -> str | None:
    """Why a session is in no table; None: it is in it."""
    if row.kind not in KINDS:
        return PREVIEW
    if row.kind not in wanted.kinds:
        return OTHER_KIND.format(kind=row.kind)
    if wanted.scenario not in (None, row.scenario):
        return OTHER_SCENARIO
    if row.consented_at is None:
        return NO_CONSENT
    if row.withdrawn_at is not None:
        return WITHDRAWN
    if wanted.finished_only and row.finished_at is None:
        return UNFINISHED
    return None


def _session_table(rows: Sequence[_Row]) -> pa.Table:
    columns: dict[str, pa.Array] = {}
    for column in SESSION_COLUMNS:
        values = [_session_value(row, column.name) for row in rows]
        if column.kind == "time":
            columns[column.name] = iso_times(np.array(values, dtype=np.float64))
        else:
            columns[column.name] = pa.array(values, ARROW_TYPES[column.kind])
    return pa.table(columns, arrow_schema(SESSION_COLUMNS))


def _session_value(row: _Row, name: str) -> Any:
    match name:
        case "simulated":
            return row.kind == "simulated"
        case "study":
            return f"{row.name} {row.version}"
        case "recruited_by":
            return row.source
        case "user_agent" | "refresh_hz" | "screen_width" | "screen_height":
            return row.device.get(name)
        case "pixel_ratio" | "touch":
            return row.device.get(name)
    value = getattr(row, name)
    return None if value == "" else value


# --- trials -------------------------------------------------------------------------------------

_INPUTS = ("mouse", "touch", "keyboard")
_RESPONSES = ("no", "yes")
_ABSENT = -1.0
"""Stands for empty cells while numbers are fetched: none of them is ever below 0."""


def _place(column: Any, words: Sequence[str]) -> ColumnElement[int]:
    return case({word: place for place, word in enumerate(words)}, value=column, else_=-1)


def _or_absent(column: Any) -> ColumnElement[float]:
    return func.coalesce(type_coerce(column, Float), _ABSENT)


_NUMBERS: dict[str, Any] = {
    "phase": _place(ANSWERS.c.phase, PHASES),
    "trial": ANSWERS.c.trial,
    "response": _place(ANSWERS.c.response, _RESPONSES),
    "rt_ms": ANSWERS.c.rt_ms,
    "input": _place(ANSWERS.c.input, _INPUTS),
    "fixation_ms": _or_absent(ANSWERS.c.fixation_ms),
    "cue_ms": _or_absent(ANSWERS.c.cue_ms),
    "frames_expected": ANSWERS.c.frames_expected,
    "frames_shown": _or_absent(ANSWERS.c.frames_shown),
    "frames_dropped": _or_absent(ANSWERS.c.frames_dropped),
    "movie_ms": _or_absent(ANSWERS.c.movie_ms),
    "visibility_changes": _or_absent(ANSWERS.c.visibility_changes),
    "window_width": _or_absent(ANSWERS.c.window_width),
    "window_height": _or_absent(ANSWERS.c.window_height),
    "resumed": cast(ANSWERS.c.resumed, Integer),
    "answered_at": ANSWERS.c.answered_at,
}
"""All of an answer but names: fetched as numbers, which is several times as fast as text."""
_WORDS = {"phase": PHASES, "response": _RESPONSES, "input": _INPUTS}


def read_trials(
    connection: Connection, study: Study, sessions: pa.Table, *, details: bool = False
) -> Iterator[Trials]:
    """The answers of all ``sessions`` of a table of `read_sessions`, some sessions at a time."""
    known = _Stimuli(study.stimuli)
    names = sessions.column("session").to_pylist()
    for first in range(0, len(names), AT_ONCE):
        chosen = range(first, min(first + AT_ONCE, len(names)))
        rows = _fetch(connection, [names[at] for at in chosen], details)
        own = sessions.slice(first, len(chosen)).combine_chunks()
        yield _trials(chosen, own, rows, known, details)


def _fetch(connection: Connection, names: Sequence[str], details: bool) -> list[tuple[Any, ...]]:
    """Rows of session, stimulus, details if asked for, and `_NUMBERS`."""
    texts = [ANSWERS.c.session, ANSWERS.c.stimulus, *([ANSWERS.c.details] if details else [])]
    query = select(*texts, *_NUMBERS.values()).where(ANSWERS.c.session.in_(names))
    text = query.compile(dialect=connection.dialect, compile_kwargs={"literal_binds": True})
    # The driver's own rows: a row object of the library for each answer would double the time.
    cursor = connection.connection.cursor()
    try:
        cursor.execute(str(text))
        return list(cursor.fetchall())
    finally:
        cursor.close()


class _Stimuli:
    """What the study folder knows of each stimulus of each scenario, as arrays."""

    def __init__(self, stimuli: Sequence[Stimulus]) -> None:
        self.places = {(s.scenario, s.stimulus): place for place, s in enumerate(stimuli)}
        self.names = pa.array([s.stimulus for s in stimuli], pa.string())
        self.labels = np.array([s.label for s in stimuli], dtype=bool)
        self.looks = np.array([LOOKS.index(s.look) for s in stimuli], dtype=np.int64)


def _trials(
    chosen: range,
    sessions: pa.Table,
    rows: list[tuple[Any, ...]],
    known: _Stimuli,
    details: bool,
) -> Trials:
    texts = 3 if details else 2
    ranks = {name: rank for rank, name in enumerate(sessions.column("session").to_pylist())}
    scenarios = sessions.column("scenario").to_pylist()
    rank = np.array([ranks[row[0]] for row in rows], dtype=np.int64)
    place = np.array(
        [known.places.get((scenarios[ranks[row[0]]], row[1]), -1) for row in rows], dtype=np.int64
    )
    unknown = tuple(rows[at][1] for at in np.flatnonzero(place < 0))
    flat = chain.from_iterable(row[texts:] for row in rows)
    width = len(_NUMBERS)
    numbers = np.fromiter(flat, np.float64, len(rows) * width).reshape(-1, width).T
    found = dict(zip(_NUMBERS, numbers, strict=True))
    order = np.lexsort((found["trial"], found["phase"], rank))
    order = order[place[order] >= 0]
    found = {name: values[order] for name, values in found.items()}
    rank, place = rank[order], place[order]
    words = pa.array([rows[at][2] for at in order], pa.string()) if details else None
    return Trials(
        sessions=chosen,
        table=_trial_table(sessions, rank, known, place, found),
        counts=np.bincount(rank, minlength=len(chosen)).astype(np.int64),
        details=words,
        unknown=unknown,
    )


def _trial_table(
    sessions: pa.Table,
    rank: npt.NDArray[np.int64],
    known: _Stimuli,
    place: npt.NDArray[np.int64],
    found: dict[str, npt.NDArray[np.float64]],
) -> pa.Table:
    of_session = sessions.select(["participant", "session", "scenario", "simulated", "buttons"])
    of_session = of_session.take(pa.array(rank))
    label = known.labels[place]
    columns: dict[str, Any] = {name: of_session.column(name) for name in of_session.column_names}
    columns |= {
        "stimulus": known.names.take(pa.array(place)),
        "label": pa.array(label),
        "correct": pa.array((found["response"] == _RESPONSES.index("yes")) == label),
        "look": pa.array(LOOKS).take(pa.array(known.looks[place])),
        "answered_at": iso_times(found["answered_at"]),
        "resumed": pa.array(found["resumed"] != 0),
    }
    for name, words in _WORDS.items():
        places = found[name].astype(np.int64)
        columns[name] = pa.array(words).take(pa.array(places, mask=places < 0))
    for column in TRIAL_COLUMNS:
        if column.name not in columns:
            values = found[column.name]
            absent = None if column.name == "rt_ms" else values == _ABSENT
            whole = values.astype(np.int64) if column.kind == "integer" else values
            columns[column.name] = pa.array(whole, mask=absent)
    ordered = {column.name: columns[column.name] for column in TRIAL_COLUMNS}
    return pa.table(ordered, arrow_schema(TRIAL_COLUMNS))
