"""Identify the visitor who enters, by link and id, or by the key of the browser."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from secrets import token_hex
from typing import NamedTuple

from sqlalchemy import ColumnElement, Connection, and_, case, func, insert, or_, select

from physion.core.seeds import stable_hash
from physion.experiment.protocol import Enter, Entered, Kind, Refused
from physion.experiment.store.database import EVENTS, PARTICIPANTS, RAW_IDS, SESSIONS, TOKENS
from physion.experiment.store.lab import is_paused
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
from physion.experiment.study.identity import (
    Secrets,
    hash_token,
    new_reference,
    new_session,
    new_token,
    participant_hash,
)
from physion.experiment.study.orders import (
    block_orders,
    draw_buttons,
    individual_order_seed,
    prepared_order_seed,
)
from physion.experiment.study.recruitment import (
    ending_completion,
    is_id_allowed,
    is_unfilled,
    read_pass,
)
from physion.experiment.study.study import ALL_SCENARIOS, Study, under, variants


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
        The link has an invalid key, an unknown scenario or condition, or an unfilled placeholder
        for the id, or lacks a required signature or id; or the study does not allow the id.
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
    if enter.scenario is not None and enter.scenario not in study.offered:
        raise Refused("bad_link", "This link names a scenario that no session of the study is of.")
    if enter.condition is not None and (
        key is None or enter.condition not in [each.name for each in study.conditions]
    ):
        raise Refused("bad_link", "This link is not signed for its condition; copy all of it.")
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


# Assign condition, scenario and order of trials to a new session: those that the fewest have.


def choose_course(
    connection: Connection, study: Study, visitor: Visitor, done: set[str], own: str | None
) -> tuple[Study, str]:
    """Return the study under the condition of a new session, and its scenario.

    The condition is that of the person's earlier sessions, else the one that the link fixes, else
    the one with the fewest sessions among those that have a place left in a wanted scenario.

    Parameters
    ----------
    connection
        Connection of the writer.
    study, visitor
        The study, and who enters.
    done
        Scenarios in which the visitor has a session already.
    own
        Condition of these sessions, if there are any.

    Raises
    ------
    Refused
        As `choose_scenario` does, for all conditions.
    """
    fixed = own or visitor.enter.condition
    ranked = variants(study) if fixed is None else (under(study, fixed),)
    if len(ranked) > 1:
        ranked = _fewest_first(connection, study, visitor)
    refused: Refused | None = None
    for variant in ranked:
        if visitor.enter.scenario not in (None, *variant.offered):
            continue
        try:
            return variant, choose_scenario(connection, variant, visitor, done)
        except Refused as error:
            refused = refused or error
    raise refused or Refused("bad_link", "This link names a scenario that its condition lacks.")


def _fewest_first(connection: Connection, study: Study, visitor: Visitor) -> tuple[Study, ...]:
    """Return the study under each condition, fewest sessions first; equal ones by seed.

    Sessions that ended early, are void or implausible, or that nobody goes on with, do not count.
    If the link names a scenario, sessions of this scenario alone do.
    """
    columns = SESSIONS.c
    wanted = visitor.enter.scenario
    statement = (
        select(columns.condition, func.count())
        .where(
            *_counted(study, visitor),
            *([] if wanted is None else [columns.scenario == wanted]),
        )
        .group_by(columns.condition)
    )
    used: dict[str | None, int] = dict(connection.execute(statement).all())

    def rank(variant: Study) -> tuple[int, int]:
        tie = stable_hash("condition", study.seed, visitor.participant, variant.condition)
        return used.get(variant.condition, 0), tie

    return tuple(sorted(variants(study), key=rank))


def _counted(study: Study, visitor: Visitor) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions for plausible sessions of the visitor's kind that did not end early."""
    columns = SESSIONS.c
    return (
        columns.kind == visitor.kind,
        columns.withdrawn_at.is_(None),
        columns.voided_at.is_(None),
        columns.screened_out_at.is_(None),
        columns.implausible.is_(None),
        or_(*_in_use(study, visitor.now)),
    )


def choose_scenario(connection: Connection, study: Study, visitor: Visitor, done: set[str]) -> str:
    """Return the scenario of a new session: the requested one, else the one with fewest sessions.

    Scenarios in ``done`` are excluded, and for people also those that have enough participants.
    """
    requested = visitor.enter.scenario
    available = [
        scenario
        for scenario in study.offered
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
    """Count the sessions of the visitor's kind in each scenario."""
    counts_by_scenario: dict[str, _SessionCounts] = defaultdict(_SessionCounts)
    if visitor.kind != "person" and visitor.enter.scenario is not None:
        return counts_by_scenario  # the counts would not be used
    columns = SESSIONS.c
    finished, active, held = _in_use(study, visitor.now)
    taken = case((and_(columns.implausible.is_(None), or_(finished, held)), 1), else_=0)
    begun = case((or_(finished, active), 1), else_=0)
    statement = (
        select(columns.scenario, func.sum(taken), func.sum(begun))
        .where(
            columns.kind == visitor.kind,
            columns.withdrawn_at.is_(None),
            columns.voided_at.is_(None),
            columns.screened_out_at.is_(None),
            or_(finished, active, held),
        )
        .group_by(columns.scenario)
    )
    for scenario, *counts in connection.execute(statement):
        counts_by_scenario[scenario] = _SessionCounts(*counts)
    return counts_by_scenario


def _in_use(study: Study, now: float) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions for sessions that are finished, active, or hold a place.

    A place is held from the consent on, until no page or answer has come for ``hold_minutes``.
    """
    columns = SESSIONS.c
    progressed_at = func.coalesce(columns.progressed_at, columns.last_seen)
    held_since = now - 60 * study.recruitment.hold_minutes
    return (
        columns.finished_at.is_not(None),
        columns.last_seen >= now - ACTIVE_WITHIN,
        # Somebody who only opened the page may never consent, and must not take a place.
        and_(columns.consented_at.is_not(None), progressed_at >= held_since),
    )


def assign_order(
    connection: Connection, study: Study, secrets: Secrets, scenario: str, visitor: Visitor
) -> tuple[int, int]:
    """Return the number of the prepared order of a new session, 0 if there is none, and its seed.

    The seed also determines the order of the blocks; the least used order is taken.
    """
    if study.orders:
        number = _least_used_order(connection, study, scenario, visitor.kind)
        return number, prepared_order_seed(study, secrets, scenario, number)
    blocks = 0
    if scenario == ALL_SCENARIOS:
        blocks = _least_used_blocks(connection, study, visitor)
    return 0, individual_order_seed(study, scenario, visitor.participant, blocks)


def _least_used_blocks(connection: Connection, study: Study, visitor: Visitor) -> int:
    """Return the index of the order of blocks with the fewest sessions; equal ones by seed.

    Sessions that ended early, or that nobody goes on with, give their place back.
    """
    count = len(block_orders(len(study.scenarios)))
    columns = SESSIONS.c
    index = columns.order_seed % count
    statement = (
        select(index, func.count())
        .where(
            columns.scenario == ALL_SCENARIOS,
            func.coalesce(columns.condition, "") == study.condition,
            *_counted(study, visitor),
        )
        .group_by(index)
    )
    used: dict[int, int] = dict(connection.execute(statement).all())

    def rank(number: int) -> tuple[int, int]:
        tie = stable_hash("order of blocks", study.seed, visitor.participant, number)
        return used.get(number, 0), tie

    return min(range(count), key=rank)


def _least_used_order(connection: Connection, study: Study, scenario: str, kind: str) -> int:
    """Return the number (from 1) of the prepared order with the fewest sessions so far."""
    columns = SESSIONS.c
    statement = (
        select(columns.order_number, func.count())
        .where(
            columns.scenario == scenario,
            func.coalesce(columns.condition, "") == study.condition,
            columns.kind == kind,
            columns.withdrawn_at.is_(None),
            columns.voided_at.is_(None),
            columns.screened_out_at.is_(None),
        )
        .group_by(columns.order_number)
    )
    used: dict[int, int] = dict(connection.execute(statement).all())
    return min(range(1, study.orders + 1), key=lambda number: (used.get(number, 0), number))


# Begin or continue a session of a visitor.


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
    own = next((each.condition for each in sessions if each.condition), None)
    ended = None
    if session is None:
        ended = _find_ended(under(study, own), sessions, visitor.enter.scenario)
    begun = session or ended
    if begun is not None:
        _check_browser(connection, begun, visitor)
    if ended is not None and visitor.enter.take_back and can_take_back(ended):
        offered = set(under(study, own).offered)
        choose_scenario(connection, under(study, own), visitor, offered - {ended.scenario})
        _take_back(connection, ended, visitor)
        session, ended = ended, None
    if session is not None:
        _continue(connection, courses, session, visitor)
    elif ended is None:
        done = {each.scenario for each in sessions}
        chosen, scenario = choose_course(connection, study, visitor, done, own)
        session = _begin_session(connection, chosen, secrets, scenario, visitor)
    if ended is None:
        _keep_raw_id(connection, visitor)  # not of somebody who declined
    session = session or ended
    assert session is not None
    connection.execute(
        insert_or_skip(connection, TOKENS),
        {"token_hash": hash_token(visitor.token), "session": session.session, "made": visitor.now},
    )
    return Entered(token=visitor.token, state=state_of(session, courses.of(session)))


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
        and session.screened_out_at is None
        and scenario in (None, session.scenario)
    ]
    return max(unfinished, key=lambda session: session.started_at, default=None)


def _find_ended(study: Study, sessions: list[Session], scenario: str | None) -> Session | None:
    """Return the latest session, of ``scenario`` if it is given, if it was declined or stopped.

    None if another scenario is left in which the visitor may begin, and for sessions that the lab
    ended. Who was screened out cannot begin in another scenario.
    """
    screened_out = [session for session in sessions if session.screened_out_at is not None]
    if screened_out:
        return max(screened_out, key=lambda session: session.started_at)
    known = {session.scenario for session in sessions}
    wanted = [session for session in sessions if scenario in (None, session.scenario)]
    if not wanted or (scenario is None and not set(study.offered) <= known):
        return None
    last = max(wanted, key=lambda session: session.started_at)
    by_lab = last.closed_at is not None or last.voided_at is not None
    return last if last.withdrawn_at is not None and not by_lab else None


def _take_back(connection: Connection, session: Session, visitor: Visitor) -> None:
    """Take up a session again that was declined or stopped; the device was deleted with it."""
    device = storable_values(visitor.enter.device.model_dump())
    change_session(connection, session, withdrawn_at=None, device=device)


def _begin_session(
    connection: Connection, study: Study, secrets: Secrets, scenario: str, visitor: Visitor
) -> Session:
    """Insert a new session under the condition of ``study``, and return it."""
    number, seed = assign_order(connection, study, secrets, scenario, visitor)
    connection.execute(
        insert_or_skip(connection, PARTICIPANTS),
        {"participant": visitor.participant, "first_seen": visitor.now},
    )
    values = {
        "session": visitor.session,
        "participant": visitor.participant,
        "scenario": scenario,
        "condition": study.condition or None,
        "kind": visitor.kind,
        "source": visitor.enter.source,
        "study": study.digest,
        "reference": visitor.reference,
        "order_seed": seed,
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


def _match_language(study: Study, wanted: str) -> str:
    """Return the best matching language of the study; ``de-AT`` falls back to ``de``."""
    known = {language.lower(): language for language in study.languages}
    wanted = wanted.lower()
    return known.get(wanted) or known.get(wanted.partition("-")[0]) or study.languages[0]


def _continue(connection: Connection, courses: Courses, session: Session, visitor: Visitor) -> None:
    """Record that the visitor entered an unfinished session again."""
    marks = mark_loaded(session, courses.of(session))
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
