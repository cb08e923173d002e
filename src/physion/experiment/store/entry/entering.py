"""Begin or continue a session of a visitor."""

from __future__ import annotations

from sqlalchemy import Connection, insert, select

from physion.experiment.protocol.messages import Entered
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.entry.assigning import (
    assign_order,
    choose_course,
    choose_scenario,
)
from physion.experiment.store.entry.visitor import Visitor
from physion.experiment.store.sessions import (
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
    storable_values,
)
from physion.experiment.store.tables import EVENTS, PARTICIPANTS, RAW_IDS, SESSIONS, TOKENS
from physion.experiment.study.courses.variants import under
from physion.experiment.study.identity import Secrets, hash_token
from physion.experiment.study.orders import draw_buttons
from physion.experiment.study.study import Study


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
