"""The exported table of answers to practice trials that were repeated afterwards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa
from sqlalchemy import Connection, select

from physion.analysis.people.response_schema import TRIAL_COLUMNS, Column
from physion.experiment.export.arrow_types import ARROW_TYPES, arrow_schema
from physion.experiment.export.iso_times import iso_times
from physion.experiment.store.tables import PRACTICE_REPEATS
from physion.experiment.study.courses.blocks import stimuli_by_session
from physion.experiment.study.study import ALL_SCENARIOS, Study

_NAMES = ("participant", "session", "stimulus", "trial", "response", "label", "correct", "rt_ms",
          "input", "frames_shown", "answered_at")  # fmt: skip
COLUMNS: tuple[Column, ...] = (
    *(replace(column, about=f"{column.about}; as in the trials")
      for column in TRIAL_COLUMNS if column.name in _NAMES),
    Column("repeat", "integer", "How often the practice of this block had been repeated before",
           low=0, required=True, may_be_empty=False),
)  # fmt: skip
"""One row per answer to a practice trial that was repeated afterwards."""


def read_practice_repeats(connection: Connection, study: Study, sessions: pa.Table) -> pa.Table:
    """Return the answers of these exported sessions, in their order, then by repeat and trial.

    Answers to stimuli that the study no longer has are left out.
    """
    names = ("session", "participant", "scenario")
    keys = zip(*(sessions.column(name).to_pylist() for name in names), strict=True)
    several = study.blocks.all_scenarios
    rank = {
        session: (at, who, ALL_SCENARIOS if several else where)
        for at, (session, who, where) in enumerate(keys)
    }
    labels = {key: each.label for key, each in stimuli_by_session(study).items()}
    rows = [
        (rank[row.session], row, labels[rank[row.session][2], row.stimulus])
        for row in connection.execute(select(PRACTICE_REPEATS))
        if row.session in rank and (rank[row.session][2], row.stimulus) in labels
    ]
    rows.sort(key=lambda entry: (entry[0][0], entry[1].repeat, entry[1].trial))
    derived = {
        "participant": [who for (_, who, _), _, _ in rows],
        "label": [label for _, _, label in rows],
        "correct": [(row.response == "yes") == label for _, row, label in rows],
    }
    arrays = []
    for column in COLUMNS:
        values = derived.get(column.name) or [getattr(row, column.name, None) for _, row, _ in rows]
        if column.kind == "time":
            arrays.append(iso_times(np.array(values, dtype=np.float64)))
        else:
            arrays.append(pa.array(values, ARROW_TYPES[column.kind]))
    return pa.table(arrays, schema=arrow_schema(COLUMNS))
