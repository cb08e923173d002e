"""Who may begin a session, in which scenario and order; who goes on with one."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from secrets import token_hex
from typing import NamedTuple

from sqlalchemy import Connection, case, func, insert, or_, select

from physion.experiment.protocol.messages import Enter, Entered, Kind
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.sessions import (
    ACTIVE_WITHIN,
    ENTERED_AGAIN,
    SESSION_COLUMNS,
    Session,
    Trials,
    change_session,
    insert_new,
    mark_loaded,
    plain,
    plain_values,
    served_session,
    state_of,
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
from physion.experiment.study.orders import draw_buttons, own_order_seed, prepared_order_seed
from physion.experiment.study.recruitment import is_unfilled, kind_of_pass
from physion.experiment.study.study import Study


@dataclass(frozen=True)
class Visitor:
    """Who comes, with all that is drawn: the same visitor may be let in twice with one effect."""

    enter: Enter
    kind: Kind
    participant: str
    raw_id: str | None
    token: str = field(default_factory=new_token)
    session: str = field(default_factory=new_session)
    reference: str = field(default_factory=new_reference)
    now: float = field(default_factory=time.time)


def receive(study: Study, secrets: Secrets, enter: Enter) -> Visitor:
    """Who comes, from link and id, else from the visit's word; without both a new person.

    `Refused` for a word of a link that we never gave, an id that the recruiter did not fill in, or
    a missing one.
    """
    kind: Kind | None = "person"
    if enter.pass_ is not None:
        kind = kind_of_pass(secrets, enter.pass_)
    if kind is None:
        raise Refused("bad_link", "This link is not complete; copy all of it and try again.")
    if is_unfilled(enter):
        raise Refused(
            "bad_link",
            "The recruiter did not fill in your id: this link has only the placeholder for it. "
            "Open the study from the recruiter's own page.",
        )
    raw_id = plain(enter.id or "").strip() or None
    needed = study.recruitment.id_needed or enter.source != "link"
    if raw_id is None and kind == "person" and needed:
        raise Refused("id_needed", "This link lacks your id; open the link that you were given.")
    if enter.scenario is not None and enter.scenario not in study.scenarios:
        raise Refused("bad_link", "This link names a part that the study does not have.")
    # Sessions of programs and previews must not stand in the way of a person with the same id.
    source = enter.source if kind == "person" else f"{kind} {enter.source}"
    if raw_id is not None:
        participant = participant_hash(secrets, source, raw_id)
    else:
        # A visit's word is as secret as a token: nobody but its browser knows it.
        participant = participant_hash(secrets, f"{source} visit", enter.visit or token_hex(16))
    return Visitor(enter, kind, participant, raw_id if kind == "person" else None)


def let_in(
    connection: Connection, study: Study, secrets: Secrets, trials: Trials, visitor: Visitor
) -> Entered:
    """Begin a session, or give a further token for the one that the visitor has begun."""
    own = [
        served_session(study, row)
        for row in connection.execute(
            select(*SESSION_COLUMNS).where(SESSIONS.c.participant == visitor.participant)
        )
    ]
    session = _unfinished(own, visitor.enter.scenario)
    if session is not None:
        _go_on(connection, trials, session, visitor)
    else:
        done = {each.scenario for each in own}
        scenario = _choose(connection, study, visitor, done)
        session = _begin(connection, study, secrets, scenario, visitor)
    connection.execute(
        insert_new(connection, TOKENS),
        {"token_hash": hash_token(visitor.token), "session": session.session, "made": visitor.now},
    )
    _keep_raw_id(connection, visitor)
    return Entered(token=visitor.token, state=state_of(session, trials.of(session.scenario)))


def _unfinished(own: list[Session], scenario: str | None) -> Session | None:
    """The session to go on with: of the scenario asked for, else the latest."""
    found = [
        session
        for session in own
        if session.finished_at is None
        and session.withdrawn_at is None
        and scenario in (None, session.scenario)
    ]
    return max(found, key=lambda session: session.started_at, default=None)


def _choose(connection: Connection, study: Study, visitor: Visitor, done: set[str]) -> str:
    """The scenario of a new session: the one asked for, else the least filled with room left."""
    asked = visitor.enter.scenario
    open_to = [
        scenario
        for scenario in study.scenarios
        if scenario not in done and asked in (None, scenario)
    ]
    if not open_to:
        raise Refused("already_took_part", "You have taken part already. Thank you!")
    filled = _filled(connection, visitor)
    if visitor.kind == "person":
        open_to = [each for each in open_to if filled[each].taken < study.participants]
    if not open_to:
        raise Refused("study_full", "The study has all the participants that it needs. Thank you!")
    return min(open_to, key=lambda scenario: filled[scenario].begun)


class _Filled(NamedTuple):
    """Sessions of a scenario: ``taken`` are finished, or agreed to and going on; ``begun`` are
    these and those that are at the consent just now.
    """

    taken: int = 0
    begun: int = 0


def _filled(connection: Connection, visitor: Visitor) -> Mapping[str, _Filled]:
    """How full each scenario is of sessions of the visitor's kind."""
    found: dict[str, _Filled] = defaultdict(_Filled)
    if visitor.kind != "person" and visitor.enter.scenario is not None:
        return found  # nobody asks
    columns = SESSIONS.c
    finished = columns.finished_at.is_not(None)
    # Whoever only opened the page may never agree, and must not keep others away.
    taken = case((or_(finished, columns.consented_at.is_not(None)), 1), else_=0)
    statement = (
        select(columns.scenario, func.sum(taken), func.count())
        .where(
            columns.kind == visitor.kind,
            columns.withdrawn_at.is_(None),
            or_(finished, columns.last_seen >= visitor.now - ACTIVE_WITHIN),
        )
        .group_by(columns.scenario)
    )
    for scenario, *counts in connection.execute(statement):
        found[scenario] = _Filled(*counts)
    return found


def _begin(
    connection: Connection, study: Study, secrets: Secrets, scenario: str, visitor: Visitor
) -> Session:
    number = _least_used(connection, study, scenario, visitor.kind) if study.orders else 0
    connection.execute(
        insert_new(connection, PARTICIPANTS),
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
        else own_order_seed(study, scenario, visitor.participant),
        "order_number": number,
        "buttons": draw_buttons(study, visitor.participant),
        "language": _language(study, visitor.enter.language),
        "started_at": visitor.now,
        "last_seen": visitor.now,
        "device": plain_values(visitor.enter.device.model_dump()),
    }
    connection.execute(insert(SESSIONS), values)
    row = connection.execute(
        select(*SESSION_COLUMNS).where(SESSIONS.c.session == visitor.session)
    ).one()
    return served_session(study, row)


def _least_used(connection: Connection, study: Study, scenario: str, kind: str) -> int:
    """The prepared order, from 1, that fewest sessions of the scenario and kind have."""
    columns = SESSIONS.c
    statement = (
        select(columns.order_number, func.count())
        .where(columns.scenario == scenario, columns.kind == kind, columns.withdrawn_at.is_(None))
        .group_by(columns.order_number)
    )
    used: dict[int, int] = dict(connection.execute(statement).all())
    return min(range(1, study.orders + 1), key=lambda number: (used.get(number, 0), number))


def _language(study: Study, wanted: str) -> str:
    """The study's language that is meant; ``de-AT`` means ``de`` where there is no closer one."""
    known = {language.lower(): language for language in study.languages}
    wanted = wanted.lower()
    return known.get(wanted) or known.get(wanted.partition("-")[0]) or study.languages[0]


def _go_on(connection: Connection, trials: Trials, session: Session, visitor: Visitor) -> None:
    marks = mark_loaded(session, trials.of(session.scenario))
    change_session(connection, session, last_seen=visitor.now, **marks)
    event = {
        "session": session.session,
        "kind": ENTERED_AGAIN,
        "at_ms": 0.0,
        "stored_at": visitor.now,
        "data": plain_values(visitor.enter.device.model_dump()),
    }
    connection.execute(insert(EVENTS), event)


def _keep_raw_id(connection: Connection, visitor: Visitor) -> None:
    """For payment; the recruiter's parameters are those of the last visit."""
    if visitor.raw_id is None:
        return
    values = {
        "source": visitor.enter.source,
        "raw_id": visitor.raw_id,
        "recruiter": plain_values(visitor.enter.recruiter),
        "seen": visitor.now,
    }
    statement = RAW_IDS.update().where(RAW_IDS.c.participant == visitor.participant)
    if connection.execute(statement.values(**values)).rowcount == 0:
        connection.execute(insert(RAW_IDS), {"participant": visitor.participant, **values})
