"""Whom to pay: the ids that recruiters know, beside the sessions of people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy import Engine, func, select

from physion.experiment.store.tables import RAW_IDS, SESSIONS
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import completion
from physion.experiment.study.study import Study

PAGE = 100
"""Rows on one page."""
_SESSION = ("source", "session", "reference", "scenario", "finished_at", "withdrawn_at",
            "answered_test")  # fmt: skip


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
    session, ids = SESSIONS.c, RAW_IDS.c
    chosen = [session.kind == "person"]
    if source:
        chosen.append(session.source == source)
    if finished:
        chosen.append(session.finished_at.is_not(None))
    order = (session.finished_at.is_(None), session.finished_at.desc(), session.started_at.desc())
    joined = RAW_IDS.join(SESSIONS, session.participant == ids.participant)
    names = select(ids.raw_id).select_from(joined).where(*chosen).order_by(*order)
    columns = [session[name] for name in _SESSION]
    lines = select(*columns, ids.raw_id, ids.recruiter).select_from(joined).where(*chosen)
    with engine.connect() as connection:
        all_names = connection.execute(names).scalars().all()
        pages = max(1, -(-len(all_names) // PAGE))
        page = min(max(1, page), pages)
        part = lines.order_by(*order).limit(PAGE).offset((page - 1) * PAGE)
        rows = connection.execute(part).all()
        stored = connection.execute(select(func.count()).select_from(RAW_IDS)).scalar_one()
        sources = connection.execute(select(ids.source).distinct()).scalars().all()
    shown = tuple(
        Payment(
            row.source, row.raw_id, row.session, row.reference, row.scenario, row.finished_at,
            row.withdrawn_at, row.answered_test, _code(study, secrets, row), row.recruiter,
        )
        for row in rows
    )  # fmt: skip
    ids_once = tuple(dict.fromkeys(all_names))
    return Payments(shown, len(all_names), page, pages, ids_once, tuple(sorted(sources)), stored)


def _code(study: Study, secrets: Secrets, row: object) -> str | None:
    finished = getattr(row, "finished_at", None) is not None
    return completion(study, secrets, row, row).code if finished else None
