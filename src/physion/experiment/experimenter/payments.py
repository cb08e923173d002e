"""Whom to pay: the ids that recruiters know, beside the sessions of people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy import Engine, func, select

from physion.experiment.identity import Secrets
from physion.experiment.recruitment import completion
from physion.experiment.study import Study
from physion.experiment.tables import RAW_IDS, SESSIONS

PAGE = 100
"""Rows on one page."""


@dataclass(frozen=True)
class Payment:
    """One person's session. ``recruiter``: further parameters of the recruiter's address."""

    source: str
    raw_id: str
    session: str
    reference: str
    scenario: str
    finished_at: float | None
    withdrawn_at: float | None
    trials: int
    code: str | None
    recruiter: Mapping[str, str]


@dataclass(frozen=True)
class Payments:
    """A page of payments. ``ids`` are those of all rows that were chosen, each once, in order;
    ``stored`` counts raw ids in the database, people's or not."""

    rows: tuple[Payment, ...]
    found: int
    page: int
    pages: int
    ids: tuple[str, ...]
    sources: tuple[str, ...]
    stored: int


def read_payments(
    study: Study, secrets: Secrets, engine: Engine, *, source: str, finished: bool, page: int
) -> Payments:
    """Sessions of people whose raw id is stored, those that finished last first.

    ``source``: of this recruiter alone, empty: of all. ``finished``: finished sessions alone.
    """
    session = SESSIONS.c
    joined = RAW_IDS.join(SESSIONS, session.participant == RAW_IDS.c.participant)
    people = select(SESSIONS, RAW_IDS.c.raw_id, RAW_IDS.c.recruiter).select_from(joined)
    people = people.where(session.kind == "person")
    if source:
        people = people.where(session.source == source)
    if finished:
        people = people.where(session.finished_at.is_not(None))
    people = people.order_by(
        session.finished_at.is_(None), session.finished_at.desc(), session.started_at.desc()
    )
    with engine.connect() as connection:
        rows = connection.execute(people).all()
        stored = connection.execute(select(func.count()).select_from(RAW_IDS)).scalar_one()
        sources = connection.execute(select(RAW_IDS.c.source).distinct()).scalars().all()
    pages = max(1, -(-len(rows) // PAGE))
    page = min(max(1, page), pages)
    shown = tuple(
        Payment(
            row.source, row.raw_id, row.session, row.reference, row.scenario, row.finished_at,
            row.withdrawn_at, row.answered_test, _code(study, secrets, row), row.recruiter,
        )
        for row in rows[(page - 1) * PAGE : page * PAGE]
    )  # fmt: skip
    ids = tuple(dict.fromkeys(row.raw_id for row in rows))
    return Payments(shown, len(rows), page, pages, ids, tuple(sorted(sources)), stored)


def _code(study: Study, secrets: Secrets, row: object) -> str | None:
    finished = getattr(row, "finished_at", None) is not None
    return completion(study, secrets, row, row).code if finished else None
