"""The exported table of sessions, and counts of the sessions left out, by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from sqlalchemy import Connection, select

from physion.analysis.people.responses import SESSION_COLUMNS
from physion.core.errors import UnknownNameError
from physion.experiment.export.arrow_types import ARROW_TYPES, arrow_schema
from physion.experiment.export.iso_times import iso_times
from physion.experiment.store.database import SESSIONS, STUDIES
from physion.experiment.study.orders import block_scenarios
from physion.experiment.study.study import Study, under

EXPORTED_KINDS = ("person", "simulated")
"""Kinds of sessions that can be exported; previews cannot."""
PREVIEW = "preview by the experimenter"
NO_CONSENT = "no consent was given"
VOID = "the experimenter made the session void"
WITHDRAWN = "the participant withdrew"
UNFINISHED = "not finished, and only finished ones were requested"
OTHER_KIND = "{kind}, which was not requested"
GONE_SCENARIO = "of {scenario}, which study.toml no longer has: add it again to export them"
OTHER_SCENARIO = "of a scenario that was not requested"
_Row = Any
"""A row of sessions with name and version of the study (its exact type would list all columns)."""


@dataclass(frozen=True)
class SessionSelection:
    """Which sessions to export: kinds, one scenario (None: all), only finished ones or all."""

    kinds: Sequence[str] = EXPORTED_KINDS
    scenario: str | None = None
    finished_only: bool = False


@dataclass(frozen=True)
class SessionTable:
    """The exported sessions, and counts of those left out.

    Attributes
    ----------
    table
        One row per session; empty cells are null.
    states
        Number of sessions in the table by kind and ``finished`` or ``unfinished``.
    left_out
        Number of sessions left out, by kind and reason.
    studies
        Digests of the versions of the study under which the sessions of the table ran.
    """

    table: pa.Table
    states: Counter[tuple[str, str]]
    left_out: Counter[tuple[str, str]]
    studies: tuple[str, ...]


def read_sessions(
    connection: Connection, study: Study, wanted: SessionSelection = SessionSelection()
) -> SessionTable:
    """Read the selected sessions, sorted by start time; count the others by reason."""
    for kind in wanted.kinds:
        if kind not in EXPORTED_KINDS:
            raise UnknownNameError("kind of session", kind, EXPORTED_KINDS)
    if wanted.scenario is not None and wanted.scenario not in study.offered:
        raise UnknownNameError("scenario", wanted.scenario, study.offered)
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
    # Sorted here because databases differ in how they order text.
    kept.sort(key=lambda row: (row.started_at, row.session))
    digests = tuple(dict.fromkeys(row.study for row in kept))
    return SessionTable(_session_table(kept, study), states, left_out, digests)


def _why_not(row: _Row, wanted: SessionSelection, study: Study) -> str | None:
    """Return the reason why a session is left out, or None if it is exported."""
    if row.kind not in EXPORTED_KINDS:
        return PREVIEW
    if row.kind not in wanted.kinds:
        return OTHER_KIND.format(kind=row.kind)
    if wanted.scenario not in (None, row.scenario):
        return OTHER_SCENARIO
    if row.voided_at is not None:
        return VOID
    if row.consented_at is None:
        return NO_CONSENT
    if row.withdrawn_at is not None:
        return WITHDRAWN
    if row.scenario not in study.offered:
        return GONE_SCENARIO.format(scenario=row.scenario)
    if wanted.finished_only and row.finished_at is None:
        return UNFINISHED
    return None


def _session_table(rows: Sequence[_Row], study: Study) -> pa.Table:
    """Return the exported table of these sessions."""
    columns: dict[str, pa.Array] = {}
    for column in SESSION_COLUMNS:
        values = [_session_value(row, column.name, study) for row in rows]
        if column.kind == "time":
            columns[column.name] = iso_times(np.array(values, dtype=np.float64))
        else:
            columns[column.name] = pa.array(values, ARROW_TYPES[column.kind])
    return pa.table(columns, arrow_schema(SESSION_COLUMNS))


def _session_value(row: _Row, name: str, study: Study) -> Any:
    """Return the value of one exported column; None for an empty cell."""
    match name:
        case "scenario":
            variant = under(study, row.condition)
            return " ".join(block_scenarios(variant, row.scenario, row.order_seed))
        case "simulated":
            return row.kind == "simulated"
        case "study":
            return f"{row.name} {row.version}"
        case "screened_out":
            return row.screened_out_by
        case "recruited_by":
            return row.source
        case "user_agent" | "refresh_hz" | "screen_width" | "screen_height":
            return row.device.get(name)
        case "pixel_ratio" | "touch":
            return row.device.get(name)
    value = getattr(row, name)
    return None if value == "" else value
