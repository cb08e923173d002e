"""Begin or continue a session: identify the visitor, assign scenario, trial order and buttons."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from secrets import token_hex
from typing import NamedTuple

from sqlalchemy import Connection, and_, case, func, insert, or_, select

from physion.experiment.protocol.messages import Enter, Entered, Kind
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.lab.managing import is_paused
from physion.experiment.store.sessions import (
    ACTIVE_WITHIN,
    ENTERED_AGAIN,
    SESSION_COLUMNS,
    Courses,
    Session,
    can_take_back,
    change_session,
    insert_or_skip,
    mark_loaded,
    session_from_row,
    state_of,
    storable,
    storable_values,
)
from physion.experiment.store.tables import EVENTS, PARTICIPANTS, RAW_IDS, SESSIONS, TOKENS
from physion.experiment.study.identity import (
    Secrets,
    hash_token,
    new_reference,
    new_session,
    new_token,
    participant_hash,
)
from physion.experiment.study.orders import draw_buttons, individual_order_seed, prepared_order_seed
from physion.experiment.study.recruitment import (
    ending_completion,
    is_id_allowed,
    is_unfilled,
    read_pass,
)
from physion.experiment.study.study import Study


@dataclass(frozen=True)
class Visitor:
    """An identified visitor, with all random names drawn, so that entering can be repeated."""

    enter: Enter
    kind: Kind
    participant: str
    raw_id: str | None
    now: float
    known_token: str = ""
    """Token of an earlier visit, with which the session can be continued."""
    signed: bool = False
    """Whether the link is signed for this person or for sessions of this kind."""
    browser: str = ""
    """Keyed hash of the key of the browser; empty if it sent none."""
    token: str = field(default_factory=new_token)
    session: str = field(default_factory=new_session)
    reference: str = field(default_factory=new_reference)


def identify_visitor(study: Study, secrets: Secrets, enter: Enter, token: str = "") -> Visitor:
    """Identify the visitor by link and id, else by the visit key, else as a new participant.

    ``token`` is one that the browser has from an earlier visit, or empty.

    Raises
    ------
    Refused
        The link has an invalid key, an unknown scenario or an unfilled placeholder for the id, or
        lacks a required signature or id; or the study does not allow the id.
    """
    key = read_pass(secrets, enter)
    kind: Kind = "preview" if key == "preview" else "simulated" if key == "simulated" else "person"
    required = {"no": (None, "study", "person"), "study": ("study", "person")}
    people = required.get(study.recruitment.signed_links, ("person",))
    if (key is None and enter.pass_ is not None) or (kind == "person" and key not in people):
        raise Refused("bad_link", "This link is not complete; copy all of it and try again.")
    if is_unfilled(enter):
        raise Refused(
            "bad_link",
            "The recruiter did not fill in your id: this link contains only its placeholder. "
            "Open the study from the recruiter's own page.",
        )
    raw_id = storable(enter.id or "").strip() or None
    needed = study.recruitment.id_needed or enter.source != "link"
    if raw_id is None and kind == "person" and needed:
        raise Refused("id_needed", "This link lacks your id; open the link that you were given.")
    if raw_id is not None and kind == "person" and not is_id_allowed(study, enter.source, raw_id):
        raise Refused("id_refused", "This study does not know the id of this link.")
    if enter.scenario is not None and enter.scenario not in study.scenarios:
        raise Refused("bad_link", "This link names a scenario that the study does not have.")
    # A simulated or preview session must not block a person with the same id.
    source = enter.source if kind == "person" else f"{kind} {enter.source}"
    if raw_id is not None:
        participant = participant_hash(secrets, source, raw_id)
    else:
        # A visit key is as secret as a token: only its browser knows it.
        participant = participant_hash(secrets, f"{source} visit", enter.visit or token_hex(16))
    return Visitor(
        enter,
        kind,
        participant,
        raw_id if kind == "person" else None,
        time.time(),
        known_token=token,
        signed=key in ("preview", "simulated", "person"),
        browser=participant_hash(secrets, f"browser of {participant}", enter.visit)
        if enter.visit
        else "",
    )


def enter_session(
    connection: Connection, study: Study, secrets: Secrets, courses: Courses, visitor: Visitor
) -> Entered:
    """Begin a session, or issue another token for the session that the visitor has begun.

    A visitor who declined or stopped gets a token for the ended session, and takes it up again if
    `Enter.take_back` says so.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    study, secrets
        The study and its keys.
    courses
        The courses of its scenarios.
    visitor
        Who enters.

    Raises
    ------
    Refused
        The visitor has taken part already, the session belongs to another browser, or the study is
        full or paused.
    """
    sessions = [
        session_from_row(study, row)
        for row in connection.execute(
            select(*SESSION_COLUMNS).where(SESSIONS.c.participant == visitor.participant)
        )
    ]
    session = _find_unfinished(sessions, visitor.enter.scenario)
    ended = None if session is not None else _find_ended(study, sessions, visitor.enter.scenario)
    begun = session or ended
    if begun is not None:
        _check_browser(connection, begun, visitor)
    if ended is not None and visitor.enter.take_back and can_take_back(ended):
        _choose_scenario(connection, study, visitor, set(study.scenarios) - {ended.scenario})
        _take_back(connection, ended, visitor)
        session, ended = ended, None
    if session is not None:
        _continue(connection, courses, session, visitor)
    elif ended is None:
        done = {each.scenario for each in sessions}
        scenario = _choose_scenario(connection, study, visitor, done)
        session = _begin_session(connection, study, secrets, scenario, visitor)
    if ended is None:
        _keep_raw_id(connection, visitor)  # not of somebody who declined
    session = session or ended
    assert session is not None
    connection.execute(
        insert_or_skip(connection, TOKENS),
        {"token_hash": hash_token(visitor.token), "session": session.session, "made": visitor.now},
    )
    return Entered(token=visitor.token, state=state_of(session, courses.of(session.scenario)))


def _check_browser(connection: Connection, session: Session, visitor: Visitor) -> None:
    """Raise `Refused` unless the visitor's browser may continue the session.

    It may with its own key, with a token of the session, or by a signed link. Sessions of older
    versions have no key; the next browser gives them one.
    """
    if visitor.signed or session.browser is None:
        return
    if session.browser and session.browser == visitor.browser:
        return
    known = select(TOKENS.c.token_hash).where(
        TOKENS.c.session == session.session,
        TOKENS.c.token_hash == hash_token(visitor.known_token),
    )
    if connection.execute(known).first() is None:
        raise Refused(
            "other_browser",
            "This session began in another browser; continue there, or ask for a link of your own.",
        )


def _find_unfinished(sessions: list[Session], scenario: str | None) -> Session | None:
    """Return the latest unfinished session, of ``scenario`` if it is given, or None."""
    unfinished = [
        session
        for session in sessions
        if session.finished_at is None
        and session.withdrawn_at is None
        and session.voided_at is None
        and scenario in (None, session.scenario)
    ]
    return max(unfinished, key=lambda session: session.started_at, default=None)


def _find_ended(study: Study, sessions: list[Session], scenario: str | None) -> Session | None:
    """Return the latest session, of ``scenario`` if it is given, if it was declined or stopped.

    None if another scenario is left in which the visitor may begin, and for sessions that the lab
    ended.
    """
    known = {session.scenario for session in sessions}
    wanted = [session for session in sessions if scenario in (None, session.scenario)]
    if not wanted or (scenario is None and not set(study.scenarios) <= known):
        return None
    last = max(wanted, key=lambda session: session.started_at)
    by_lab = last.closed_at is not None or last.voided_at is not None
    return last if last.withdrawn_at is not None and not by_lab else None


def _take_back(connection: Connection, session: Session, visitor: Visitor) -> None:
    """Take up a session again that was declined or stopped; the device was deleted with it."""
    device = storable_values(visitor.enter.device.model_dump())
    change_session(connection, session, withdrawn_at=None, device=device)


def _choose_scenario(connection: Connection, study: Study, visitor: Visitor, done: set[str]) -> str:
    """Return the scenario of a new session: the requested one, else the one with fewest sessions.

    Scenarios in ``done`` are excluded, and for people also those that have enough participants.
    """
    requested = visitor.enter.scenario
    available = [
        scenario
        for scenario in study.scenarios
        if scenario not in done and requested in (None, scenario)
    ]
    if not available:
        raise Refused("already_took_part", "You have taken part already. Thank you!")
    if visitor.kind == "person" and is_paused(connection):
        raise Refused("paused", "The study takes in nobody at the moment; try again later.")
    counts = _count_sessions(connection, study, visitor)
    if visitor.kind == "person":
        available = [each for each in available if counts[each].taken < study.participants]
    if not available:
        raise Refused(
            "study_full",
            "The study has all the participants that it needs. Thank you!",
            completion=ending_completion(study.full, visitor.enter.source),
        )
    return min(available, key=lambda scenario: counts[scenario].begun)


class _SessionCounts(NamedTuple):
    """Numbers of sessions of a scenario.

    ``taken``: places of plausible sessions, finished or held for people who go on.
    ``begun``: finished and active sessions.
    """

    taken: int = 0
    begun: int = 0


def _count_sessions(
    connection: Connection, study: Study, visitor: Visitor
) -> Mapping[str, _SessionCounts]:
    """Count the sessions of the visitor's kind in each scenario.

    A place is held from the consent on, until no page or answer has come for ``hold_minutes``.
    """
    counts_by_scenario: dict[str, _SessionCounts] = defaultdict(_SessionCounts)
    if visitor.kind != "person" and visitor.enter.scenario is not None:
        return counts_by_scenario  # the counts would not be used
    columns = SESSIONS.c
    finished = columns.finished_at.is_not(None)
    active = columns.last_seen >= visitor.now - ACTIVE_WITHIN
    held_since = visitor.now - 60 * study.recruitment.hold_minutes
    progressed_at = func.coalesce(columns.progressed_at, columns.last_seen)
    # Somebody who only opened the page may never consent, and must not take a place.
    held = and_(columns.consented_at.is_not(None), progressed_at >= held_since)
    taken = case((and_(columns.implausible.is_(None), or_(finished, held)), 1), else_=0)
    begun = case((or_(finished, active), 1), else_=0)
    statement = (
        select(columns.scenario, func.sum(taken), func.sum(begun))
        .where(
            columns.kind == visitor.kind,
            columns.withdrawn_at.is_(None),
            columns.voided_at.is_(None),
            or_(finished, active, held),
        )
        .group_by(columns.scenario)
    )
    for scenario, *counts in connection.execute(statement):
        counts_by_scenario[scenario] = _SessionCounts(*counts)
    return counts_by_scenario


def _begin_session(
    connection: Connection, study: Study, secrets: Secrets, scenario: str, visitor: Visitor
) -> Session:
    """Insert a new session and return it."""
    number = _least_used_order(connection, study, scenario, visitor.kind) if study.orders else 0
    connection.execute(
        insert_or_skip(connection, PARTICIPANTS),
        {"participant": visitor.participant, "first_seen": visitor.now},
    )
    values = {
        "session": visitor.session,
        "participant": visitor.participant,
        "scenario": scenario,
        "kind": visitor.kind,
        "source": visitor.enter.source,
        "study": study.digest,
        "reference": visitor.reference,
        "order_seed": prepared_order_seed(study, secrets, scenario, number)
        if number
        else individual_order_seed(study, scenario, visitor.participant),
        "order_number": number,
        "buttons": draw_buttons(study, visitor.participant),
        "language": _match_language(study, visitor.enter.language),
        "browser": visitor.browser,
        "started_at": visitor.now,
        "last_seen": visitor.now,
        "device": storable_values(visitor.enter.device.model_dump()),
    }
    connection.execute(insert(SESSIONS), values)
    row = connection.execute(
        select(*SESSION_COLUMNS).where(SESSIONS.c.session == visitor.session)
    ).one()
    return session_from_row(study, row)


def _least_used_order(connection: Connection, study: Study, scenario: str, kind: str) -> int:
    """Return the number (from 1) of the prepared order with the fewest sessions so far."""
    columns = SESSIONS.c
    statement = (
        select(columns.order_number, func.count())
        .where(
            columns.scenario == scenario,
            columns.kind == kind,
            columns.withdrawn_at.is_(None),
            columns.voided_at.is_(None),
        )
        .group_by(columns.order_number)
    )
    used: dict[int, int] = dict(connection.execute(statement).all())
    return min(range(1, study.orders + 1), key=lambda number: (used.get(number, 0), number))


def _match_language(study: Study, wanted: str) -> str:
    """Return the best matching language of the study; ``de-AT`` falls back to ``de``."""
    known = {language.lower(): language for language in study.languages}
    wanted = wanted.lower()
    return known.get(wanted) or known.get(wanted.partition("-")[0]) or study.languages[0]


def _continue(connection: Connection, courses: Courses, session: Session, visitor: Visitor) -> None:
    """Record that the visitor entered an unfinished session again."""
    marks = mark_loaded(session, courses.of(session.scenario))
    browser = {} if session.browser is not None else {"browser": visitor.browser}
    change_session(connection, session, last_seen=visitor.now, **browser, **marks)
    event = {
        "session": session.session,
        "kind": ENTERED_AGAIN,
        "at_ms": 0.0,
        "stored_at": visitor.now,
        "data": storable_values(visitor.enter.device.model_dump()),
    }
    connection.execute(insert(EVENTS), event)


def _keep_raw_id(connection: Connection, visitor: Visitor) -> None:
    """Store the raw id for payment, with the recruiter's parameters of the latest visit."""
    if visitor.raw_id is None:
        return
    values = {
        "source": visitor.enter.source,
        "raw_id": visitor.raw_id,
        "recruiter": storable_values(visitor.enter.recruiter),
        "seen": visitor.now,
    }
    statement = RAW_IDS.update().where(RAW_IDS.c.participant == visitor.participant)
    if connection.execute(statement.values(**values)).rowcount == 0:
        connection.execute(insert(RAW_IDS), {"participant": visitor.participant, **values})
