"""The table of answers, some sessions at a time, so that memory stays bounded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from sqlalchemy import Connection, Float, Integer, case, cast, func, select
from sqlalchemy.sql import ColumnElement

from physion.analysis.people.response_schema import TRIAL_COLUMNS
from physion.experiment.export.arrow_types import arrow_schema
from physion.experiment.export.iso_times import iso_times
from physion.experiment.store.tables import ANSWERS
from physion.experiment.study.stimuli import LOOKS, PHASES, Stimulus
from physion.experiment.study.study import Study

AT_ONCE = 200
"""Sessions whose answers are fetched together."""


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


_INPUTS = ("mouse", "touch", "keyboard")
_RESPONSES = ("no", "yes")
_ABSENT = -1.0
"""Stands for empty cells while numbers are fetched: none of them is ever below 0."""


def _place(column: Any, words: Sequence[str]) -> ColumnElement[int]:
    return case({word: place for place, word in enumerate(words)}, value=column, else_=-1)


def _or_absent(column: Any) -> ColumnElement[Any]:
    # Of the column's own type: PostgreSQL would make decimals of both, which are slow.
    return func.coalesce(column, _ABSENT if isinstance(column.type, Float) else int(_ABSENT))


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
    binary = {"binary": True} if connection.dialect.name == "postgresql" else {}
    cursor = connection.connection.cursor(**binary)
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
