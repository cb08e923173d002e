"""The exported table of answers, read in batches of sessions to bound the memory."""

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

from physion.analysis.people.responses import TRIAL_COLUMNS
from physion.experiment.export.arrow_types import arrow_schema
from physion.experiment.export.iso_times import iso_times
from physion.experiment.store.database import ANSWERS
from physion.experiment.study.stimuli import LOOKS, PHASES, Stimulus
from physion.experiment.study.study import Study

AT_ONCE = 200
"""Number of sessions whose answers are fetched in one query."""


@dataclass(frozen=True)
class TrialBatch:
    """Answers of consecutive sessions.

    Attributes
    ----------
    sessions
        Row numbers of these sessions in the table of sessions.
    table
        One row per answer.
    counts
        Number of rows of ``table`` for each session.
    details
        JSON text of each row, if requested.
    unknown
        Stimulus of each answer that was left out because the study folder no longer has it.
    """

    sessions: range
    table: pa.Table
    counts: npt.NDArray[np.int64]
    details: pa.Array | None
    unknown: tuple[str, ...]


_INPUTS = ("mouse", "touch", "keyboard")
_RESPONSES = ("no", "yes")
_VOID = ("hidden", "dialog", "window")
_ABSENT = -1.0
"""Value of empty cells while numbers are fetched; real values are never negative."""


def _index(column: Any, values: Sequence[str]) -> ColumnElement[int]:
    """Return the SQL expression of the index of a cell in ``values``, -1 if it is not in them."""
    return case({value: index for index, value in enumerate(values)}, value=column, else_=-1)


def _or_absent(column: Any) -> ColumnElement[Any]:
    """Return the SQL expression of a column with `_ABSENT` in place of NULL."""
    return func.coalesce(column, _ABSENT if isinstance(column.type, Float) else int(_ABSENT))


_NUMBERS: dict[str, Any] = {
    "phase": _index(ANSWERS.c.phase, PHASES),
    "trial": ANSWERS.c.trial,
    "response": _index(ANSWERS.c.response, _RESPONSES),
    "rt_ms": ANSWERS.c.rt_ms,
    "input": _index(ANSWERS.c.input, _INPUTS),
    "fixation_ms": _or_absent(ANSWERS.c.fixation_ms),
    "cue_ms": _or_absent(ANSWERS.c.cue_ms),
    "frames_expected": ANSWERS.c.frames_expected,
    "frames_shown": _or_absent(ANSWERS.c.frames_shown),
    "frames_dropped": _or_absent(ANSWERS.c.frames_dropped),
    "movie_ms": _or_absent(ANSWERS.c.movie_ms),
    "visibility_changes": _or_absent(ANSWERS.c.visibility_changes),
    "window_width": _or_absent(ANSWERS.c.window_width),
    "window_height": _or_absent(ANSWERS.c.window_height),
    "break_ms": _or_absent(ANSWERS.c.break_ms),
    "resumed": cast(ANSWERS.c.resumed, Integer),
    "showings": _or_absent(ANSWERS.c.showings),
    "void": _index(ANSWERS.c.void, _VOID),
    "answered_at": ANSWERS.c.answered_at,
}
"""Columns of an answer that are fetched as numbers, several times faster than as text."""
_CHOICES = {"phase": PHASES, "response": _RESPONSES, "input": _INPUTS, "void": _VOID}


def read_trials(
    connection: Connection, study: Study, sessions: pa.Table, *, details: bool = False
) -> Iterator[TrialBatch]:
    """Yield the answers of a batch of sessions at a time, in the order of ``sessions``.

    Parameters
    ----------
    connection
        Connection of `snapshot`.
    study
        The study, for the labels of its stimuli.
    sessions
        Table of `read_sessions`.
    details
        Whether to read the measured details of each trial too.
    """
    known = _Stimuli(study.stimuli)
    names = sessions.column("session").to_pylist()
    for first in range(0, len(names), AT_ONCE):
        chosen = range(first, min(first + AT_ONCE, len(names)))
        rows = _fetch(connection, [names[at] for at in chosen], details)
        batch = sessions.slice(first, len(chosen)).combine_chunks()
        yield _trials(chosen, batch, rows, known, details)


def _fetch(connection: Connection, names: Sequence[str], details: bool) -> list[tuple[Any, ...]]:
    """Fetch rows of session, stimulus, details (if requested) and `_NUMBERS`."""
    texts = [ANSWERS.c.session, ANSWERS.c.stimulus, *([ANSWERS.c.details] if details else [])]
    chosen = ANSWERS.c.session.in_(names), ANSWERS.c.phase.in_(PHASES)
    query = select(*texts, *_NUMBERS.values()).where(*chosen)
    text = query.compile(dialect=connection.dialect, compile_kwargs={"literal_binds": True})
    # Plain rows of the driver: SQLAlchemy's row objects would double the time.
    cursor = connection.connection.cursor()
    try:
        cursor.execute(str(text))
        return list(cursor.fetchall())
    finally:
        cursor.close()


class _Stimuli:
    """Scenarios, names, labels and looks of all stimuli as arrays, and their indices by name."""

    def __init__(self, stimuli: Sequence[Stimulus]) -> None:
        self.indices = {(s.scenario, s.stimulus): index for index, s in enumerate(stimuli)}
        self.scenarios = pa.array([s.scenario for s in stimuli], pa.string())
        self.names = pa.array([s.stimulus for s in stimuli], pa.string())
        self.labels = np.array([s.label for s in stimuli], dtype=bool)
        self.looks = np.array([LOOKS.index(s.look) for s in stimuli], dtype=np.int64)

    def find(self, blocks: Sequence[str], name: str) -> tuple[int, float]:
        """Return the index of a stimulus of a session, -1 if it is unknown, and its block.

        ``blocks``: the scenarios of the session. The block is `_ABSENT` if there is only one.
        """
        for number, scenario in enumerate(blocks):
            index = self.indices.get((scenario, name), -1)
            if index >= 0:
                return index, number if len(blocks) > 1 else _ABSENT
        return -1, _ABSENT


def _trials(
    chosen: range,
    sessions: pa.Table,
    rows: list[tuple[Any, ...]],
    known: _Stimuli,
    details: bool,
) -> TrialBatch:
    """Convert fetched rows to a table in the order shown; unknown stimuli are left out."""
    texts = 3 if details else 2
    ranks = {name: rank for rank, name in enumerate(sessions.column("session").to_pylist())}
    blocks = [cell.split(" ") for cell in sessions.column("scenario").to_pylist()]
    rank = np.array([ranks[row[0]] for row in rows], dtype=np.int64)
    found = [known.find(blocks[ranks[row[0]]], row[1]) for row in rows]
    stimulus, block = np.array(found, dtype=np.int64).reshape(-1, 2).T
    unknown = tuple(rows[at][1] for at in np.flatnonzero(stimulus < 0))
    flat = chain.from_iterable(row[texts:] for row in rows)
    width = len(_NUMBERS)
    numbers = np.fromiter(flat, np.float64, len(rows) * width).reshape(-1, width).T
    values = dict(zip(_NUMBERS, numbers, strict=True))
    values["block"] = block.astype(np.float64)
    order = np.lexsort((values["trial"], values["phase"], block, rank))
    order = order[stimulus[order] >= 0]
    values = {name: column[order] for name, column in values.items()}
    rank, stimulus = rank[order], stimulus[order]
    return TrialBatch(
        sessions=chosen,
        table=_trial_table(sessions, rank, known, stimulus, values),
        counts=np.bincount(rank, minlength=len(chosen)).astype(np.int64),
        details=pa.array([rows[at][2] for at in order], pa.string()) if details else None,
        unknown=unknown,
    )


def _trial_table(
    sessions: pa.Table,
    rank: npt.NDArray[np.int64],
    known: _Stimuli,
    stimulus: npt.NDArray[np.int64],
    values: dict[str, npt.NDArray[np.float64]],
) -> pa.Table:
    """Return the table of trials from fetched numbers.

    Parameters
    ----------
    sessions
        Rows of the sessions of this batch.
    rank
        Index of the session of each answer.
    known
        The stimuli of the study.
    stimulus
        Index of the stimulus of each answer.
    values
        Columns of `_NUMBERS`, and ``block``.
    """
    of_session = sessions.select(["participant", "session", "simulated", "buttons", "condition"])
    of_session = of_session.take(pa.array(rank))
    label = known.labels[stimulus]
    columns: dict[str, Any] = {name: of_session.column(name) for name in of_session.column_names}
    columns |= {
        "scenario": known.scenarios.take(pa.array(stimulus)),
        "stimulus": known.names.take(pa.array(stimulus)),
        "label": pa.array(label),
        "correct": pa.array((values["response"] == _RESPONSES.index("yes")) == label),
        "look": pa.array(LOOKS).take(pa.array(known.looks[stimulus])),
        "answered_at": iso_times(values["answered_at"]),
        "resumed": pa.array(values["resumed"] != 0),
    }
    for name, choices in _CHOICES.items():
        indices = values[name].astype(np.int64)
        columns[name] = pa.array(choices).take(pa.array(indices, mask=indices < 0))
    for column in TRIAL_COLUMNS:
        if column.name not in columns:
            cells = values[column.name]
            absent = None if column.name == "rt_ms" else cells == _ABSENT
            typed = cells.astype(np.int64) if column.kind == "integer" else cells
            columns[column.name] = pa.array(typed, mask=absent)
    ordered = {column.name: columns[column.name] for column in TRIAL_COLUMNS}
    return pa.table(ordered, arrow_schema(TRIAL_COLUMNS))
