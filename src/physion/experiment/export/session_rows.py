"""The table of sessions: which are in it, and which are left out for which reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from sqlalchemy import Connection, select

from physion.analysis.people.response_schema import SESSION_COLUMNS
from physion.errors import UnknownNameError
from physion.experiment.export.arrow_types import ARROW_TYPES, arrow_schema
from physion.experiment.export.iso_times import iso_times
from physion.experiment.store.tables import SESSIONS, STUDIES
from physion.experiment.study.study import Study

EXPORTED_KINDS = ("person", "simulated")
"""Kinds of sessions that can be asked for; previews cannot."""
PREVIEW = "preview by the experimenter"
NO_CONSENT = "no consent was given"
WITHDRAWN = "the participant withdrew"
UNFINISHED = "not finished, and only finished ones were asked for"
OTHER_KIND = "{kind}, which was not asked for"
GONE_SCENARIO = "of {scenario}, which study.toml has no more: put it back to export them"
OTHER_SCENARIO = "of a scenario that was not asked for"
_Row = Any
"""A row of sessions with the study's name and version: the library's type lists all columns."""


@dataclass(frozen=True)
class Wanted:
    """Which sessions: of these ``kinds``, of one scenario (None: all), finished ones alone?"""

    kinds: Sequence[str] = EXPORTED_KINDS
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


def read_sessions(connection: Connection, study: Study, wanted: Wanted = Wanted()) -> Sessions:
    """The table of sessions, and what is left out of it, for which reason."""
    for kind in wanted.kinds:
        if kind not in EXPORTED_KINDS:
            raise UnknownNameError("kind of session", kind, EXPORTED_KINDS)
    if wanted.scenario is not None and wanted.scenario not in study.scenarios:
        raise UnknownNameError("scenario", wanted.scenario, study.scenarios)
    query = select(*SESSIONS.c, STUDIES.c.name, STUDIES.c.version).join(
        STUDIES, STUDIES.c.digest == SESSIONS.c.study
    )
    kept: list[_Row] = []
    states: Counter[tuple[str, str]] = Counter()
    left_out: Counter[tuple[str, str]] = Counter()
    for row in connection.execute(query):
        reason = _why_not(row, wanted, study)
        if reason is not None:
            left_out[row.kind, reason] += 1
            continue
        kept.append(row)
        states[row.kind, "unfinished" if row.finished_at is None else "finished"] += 1
    # Sorted here: databases differ in how they order text.
    kept.sort(key=lambda row: (row.started_at, row.session))
    digests = tuple(dict.fromkeys(row.study for row in kept))
    return Sessions(_session_table(kept), states, left_out, digests)


def _why_not(row: _Row, wanted: Wanted, study: Study) -> str | None:
    """Why a session is in no table; None: it is in it."""
    if row.kind not in EXPORTED_KINDS:
        return PREVIEW
    if row.kind not in wanted.kinds:
        return OTHER_KIND.format(kind=row.kind)
    if wanted.scenario not in (None, row.scenario):
        return OTHER_SCENARIO
    if row.consented_at is None:
        return NO_CONSENT
    if row.withdrawn_at is not None:
        return WITHDRAWN
    if row.scenario not in study.scenarios:
        return GONE_SCENARIO.format(scenario=row.scenario)
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
