"""The exported tables of answers that are no trials of the analysis.

Attention checks, and practice trials that were repeated afterwards.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
from sqlalchemy import Connection, select

from physion.analysis.people.responses import TRIAL_COLUMNS, Column
from physion.experiment.export.arrow_types import ARROW_TYPES, arrow_schema
from physion.experiment.export.iso_times import iso_times
from physion.experiment.store.database import ANSWERS, PRACTICE_REPEATS
from physion.experiment.study.orders import instructed_response, stimuli_by_session
from physion.experiment.study.stimuli import ATTENTION
from physion.experiment.study.study import ALL_SCENARIOS, Study

_NAMES = ("participant", "session", "stimulus", "trial", "response", "label", "correct", "rt_ms",
          "input", "frames_shown", "void", "answered_at")  # fmt: skip
_AS_TRIALS = tuple(
    replace(column, about=f"{column.about}; as in the trials")
    for column in TRIAL_COLUMNS
    if column.name in _NAMES
)
REPEAT_COLUMNS: tuple[Column, ...] = (
    *_AS_TRIALS,
    Column("repeat", "integer", "How often the practice of this block had been repeated before",
           low=0, required=True, may_be_empty=False),
)  # fmt: skip
"""One row per answer to a practice trial that was repeated afterwards."""
ATTENTION_COLUMNS: tuple[Column, ...] = (
    *_AS_TRIALS,
    Column("instructed", "flag", "The page said which button to press; label is True for yes",
           required=True, may_be_empty=False),
)  # fmt: skip
"""One row per answer to an attention check."""


def read_practice_repeats(connection: Connection, study: Study, sessions: pa.Table) -> pa.Table:
    """Return the answers of these sessions to practice trials that were repeated afterwards."""
    rows = connection.execute(select(PRACTICE_REPEATS).order_by(PRACTICE_REPEATS.c.repeat))
    return _table(rows, study, sessions, REPEAT_COLUMNS)


def read_attention(connection: Connection, study: Study, sessions: pa.Table) -> pa.Table:
    """Return the answers of these sessions to attention checks."""
    rows = connection.execute(select(ANSWERS).where(ANSWERS.c.phase == ATTENTION))
    return _table(rows, study, sessions, ATTENTION_COLUMNS)


def _table(
    rows: Iterable[Any], study: Study, sessions: pa.Table, columns: Sequence[Column]
) -> pa.Table:
    """Return the exported table of these answers, in the order of the sessions.

    Answers of other sessions, and to stimuli that the study no longer has, are left out.
    """
    names = ("session", "participant", "scenario")
    keys = zip(*(sessions.column(name).to_pylist() for name in names), strict=True)
    several = study.blocks.all_scenarios
    places = {
        session: (at, person, ALL_SCENARIOS if several else scenario)
        for at, (session, person, scenario) in enumerate(keys)
    }
    labels = {key: each.label for key, each in stimuli_by_session(study).items()}
    kept: list[tuple[tuple[int, int, int], dict[str, Any]]] = []
    for row in rows:
        if row.session not in places:
            continue
        at, person, scenario = places[row.session]
        asked = instructed_response(row.stimulus) if row.phase == ATTENTION else None
        label = labels.get((scenario, row.stimulus)) if asked is None else asked == "yes"
        if label is None:
            continue
        repeat = getattr(row, "repeat", 0)
        cells = row._asdict() | {
            "participant": person,
            "label": label,
            "correct": (row.response == "yes") == label,
            "instructed": asked is not None,
        }
        kept.append(((at, repeat, row.trial), cells))
    kept.sort(key=lambda entry: entry[0])
    arrays = []
    for column in columns:
        values = [cells[column.name] for _, cells in kept]
        if column.kind == "time":
            arrays.append(iso_times(np.array(values, dtype=np.float64)))
        else:
            arrays.append(pa.array(values, ARROW_TYPES[column.kind]))
    return pa.table(arrays, schema=arrow_schema(columns))
