"""Rows of the payments page: sessions of people with their recruiters' ids."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy import Engine, func, select

from physion.experiment.store.database import RAW_IDS, SESSIONS
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import completion
from physion.experiment.study.study import Study

PAGE = 100
"""Rows per page."""
_SESSION = ("source", "session", "reference", "scenario", "finished_at", "withdrawn_at",
            "answered_test", "implausible")  # fmt: skip


@dataclass(frozen=True)
class Payment:
    """Session of a person with the raw id; ``recruiter``: further parameters of the entry URL.

    ``implausible``: why no person can have made it; its ``code`` was not shown to the participant.
    """

    source: str
    raw_id: str
    session: str
    reference: str
    scenario: str
    finished_at: float | None
    withdrawn_at: float | None
    trials: int
    implausible: str | None
    code: str | None
    recruiter: Mapping[str, str]


@dataclass(frozen=True)
class Payments:
    """One page of the list of payments.

    Attributes
    ----------
    rows
        Payments on this page.
    total
        Number of selected sessions, on all pages.
    page, pages
        This page, and number of pages.
    ids
        Unique raw ids of all selected sessions that are plausible, in order.
    sources
        Recruiters of the stored ids.
    stored
        Number of raw ids in the database, including those of other kinds of sessions.
    """

    rows: tuple[Payment, ...]
    total: int
    page: int
    pages: int
    ids: tuple[str, ...]
    sources: tuple[str, ...]
    stored: int


def read_payments(
    study: Study, secrets: Secrets, engine: Engine, *, source: str, finished: bool, page: int | None
) -> Payments:
    """Read a page of the sessions of people whose raw id is stored, last finished first.

    Parameters
    ----------
    study, secrets
        The study and its keys, for completion codes.
    engine
        The database.
    source
        Only sessions from this recruiter; empty: from all.
    finished
        Only finished sessions.
    page
        Number of the page from 1; numbers out of range give the closest page. None: all rows on
        one page.
    """
    session, ids = SESSIONS.c, RAW_IDS.c
    chosen = [session.kind == "person"]
    if source:
        chosen.append(session.source == source)
    if finished:
        chosen.append(session.finished_at.is_not(None))
    order = (session.finished_at.is_(None), session.finished_at.desc(), session.started_at.desc())
    joined = RAW_IDS.join(SESSIONS, session.participant == ids.participant)
    names = (
        select(ids.raw_id, session.implausible).select_from(joined).where(*chosen).order_by(*order)
    )
    columns = [session[name] for name in _SESSION]
    lines = select(*columns, ids.raw_id, ids.recruiter).select_from(joined).where(*chosen)
    with engine.connect() as connection:
        all_names = connection.execute(names).all()
        size = PAGE if page is not None else max(1, len(all_names))
        pages = max(1, -(-len(all_names) // size))
        page = min(max(1, page or 1), pages)
        part = lines.order_by(*order).limit(size).offset((page - 1) * size)
        rows = connection.execute(part).all()
        stored = connection.execute(select(func.count()).select_from(RAW_IDS)).scalar_one()
        sources = connection.execute(select(ids.source).distinct()).scalars().all()
    shown = tuple(
        Payment(
            row.source, row.raw_id, row.session, row.reference, row.scenario, row.finished_at,
            row.withdrawn_at, row.answered_test, row.implausible,
            _code(study, secrets, row), row.recruiter,
        )
        for row in rows
    )  # fmt: skip
    plausible = [name for name, implausible in all_names if implausible is None]
    ids_once = tuple(dict.fromkeys(plausible))
    return Payments(shown, len(all_names), page, pages, ids_once, tuple(sorted(sources)), stored)


def _code(study: Study, secrets: Secrets, row: object) -> str | None:
    """Return the completion code of a finished session."""
    finished = getattr(row, "finished_at", None) is not None
    return completion(study, secrets, row, row).code if finished else None
