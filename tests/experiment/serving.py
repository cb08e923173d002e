"""Rows of a study's database, read apart from the server and its code."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from physion.experiment.database import open_database, sqlite_url
from physion.experiment.study import Study
from physion.experiment.tables import ANSWERS, SESSIONS


def stored_sessions(study: Study, url: str | None = None) -> dict[str, Any]:
    """Rows of SESSIONS by the reference that the participant was given."""
    return {row.reference: row for row in _rows(study, url, sa.select(SESSIONS))}


def stored_answers(study: Study, url: str | None = None) -> dict[tuple[str, str, int], Any]:
    """Rows of ANSWERS by reference, phase and trial."""
    found = sa.select(ANSWERS, SESSIONS.c.reference).join(SESSIONS)
    rows = _rows(study, url, found)
    by_place = {(row.reference, row.phase, row.trial): row for row in rows}
    assert len(by_place) == len(rows)
    return by_place


def _rows(study: Study, url: str | None, query: sa.Select[Any]) -> list[Any]:
    engine = open_database(url or sqlite_url(study.folder), must_exist=True)
    try:
        with engine.connect() as connection:
            return list(connection.execute(query).all())
    finally:
        engine.dispose()
