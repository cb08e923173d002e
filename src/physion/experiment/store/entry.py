"""Enter a study: who the visitor is, what a session is assigned, and how one is continued.

Nothing is stored of a person before consent. A new visitor lives in the server's memory (`Visit`)
with all that the consent page needs, among it the scenario, the condition and the order of trials
that are kept for this person; the session is stored when the person agrees. Who declines or leaves
is forgotten, and may open the link again.

Condition, scenario and order are those that the fewest sessions have, visitors who still read the
consent included. A place of the study is taken by a finished session, and held by one that has come
through the practice and continues.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from secrets import token_hex
from typing import Any

from sqlalchemy import ColumnElement, Connection, and_, case, func, insert, or_, select

from physion.core.seeds import stable_hash
from physion.experiment.protocol import Enter, Kind, Refused
from physion.experiment.store.database import (
    PARTICIPANTS,
    PAUSES,
    RAW_IDS,
    SESSIONS,
    TOKENS,
)
from physion.experiment.store.sessions import (
    ACTIVE_WITHIN,
    ENTERED_AGAIN,
    SESSION_COLUMNS,
    Courses,
    Session,
    Step,
    end_of,
    insert_or_skip,
    new_session_of,
    session_from_row,
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
from physion.experiment.study.study import Study, under, variants


@dataclass(frozen=True)
class Visitor:
    """An identified visitor, with the random names of the token and of a new session."""

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
    raw_id = (enter.id or "").strip() or None
    needed = study.recruitment.id_needed or enter.source != "link"
    if raw_id is None and kind == "person" and needed:
        raise Refused("id_needed", "This link lacks your id; open the link that you were given.")
    if raw_id is not None and kind == "person" and not is_id_allowed(study, enter.source, raw_id):
        raise Refused("id_refused", "This study does not know the id of this link.")
    if enter.scenario is not None and enter.scenario not in study.scenarios:
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


@dataclass(frozen=True)
class Visit:
    """Somebody who reads the consent: the session as it will be, of which nothing is stored yet.

    ``values`` are the columns of the session that will be inserted, ``session`` those that
    determine how it continues.
    """

    visitor: Visitor
    session: Session
    values: dict[str, Any]


def enter_session(
    connection: Connection,
    study: Study,
    secrets: Secrets,
    courses: Courses,
    visitor: Visitor,
    others: Sequence[Visit] = (),
) -> Session | Visit:
    """Continue the session that the visitor has begun, with another token, or begin a `Visit`.

    A visitor who stopped gets a token for the ended session.

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
    others
        Who reads the consent at the moment.

    Raises
    ------
    Refused
        The visitor has taken part already, the session belongs to another browser, or the study is
        full, held or paused.
    """
    sessions = _sessions_of(connection, study, visitor)
    known = _known_session(connection, study, courses, sessions, visitor)
    if known is not None:
        return known
    own = next((each.condition for each in sessions if each.condition), None)
    done = {each.scenario for each in sessions}
    places = _Places(connection, study, visitor, others)
    chosen, scenario = _choose_course(study, places, visitor, done, own)
    number, seed = _assign_order(chosen, secrets, scenario, places)
    values = {
        "session": visitor.session,
        "participant": visitor.participant,
        "scenario": scenario,
        "condition": chosen.condition or None,
        "kind": visitor.kind,
        "source": visitor.enter.source,
        "study": study.digest,
        "reference": visitor.reference,
        "order_seed": seed,
        "order_number": number,
        "buttons": draw_buttons(chosen, visitor.participant),
        "language": _match_language(study, visitor.enter.language),
        "browser": visitor.browser,
        "started_at": visitor.now,
        "last_seen": visitor.now,
        "device": visitor.enter.device.model_dump(),
    }
    return Visit(visitor, new_session_of(values), values)


def begin_session(
    connection: Connection,
    study: Study,
    courses: Courses,
    visit: Visit,
    language: str | None,
    now: float,
) -> Session:
    """Store the session of a visitor who agreed, or continue the one begun meanwhile elsewhere.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    study, courses
        The study and the courses of its scenarios.
    visit
        Who agreed, and to what.
    language
        Language in which the consent was read.
    now
        Time of the server in seconds since 1970.

    Raises
    ------
    Refused
        The study has become full, held or paused while the consent was read, or the visitor has
        taken part already.
    """
    visitor = visit.visitor
    sessions = _sessions_of(connection, study, visitor)
    known = _known_session(connection, study, courses, sessions, visitor)
    if known is not None:
        return known
    scenario, condition = visit.session.scenario, visit.session.condition
    if scenario in {each.scenario for each in sessions}:
        raise Refused("already_took_part", "You have taken part already. Thank you!")
    _Places(connection, study, visitor).require(under(study, condition), (scenario,))
    times = dict.fromkeys(("consented_at", "progressed_at", "next_from", "last_seen"), now)
    values = visit.values | times | {"consent_version": study.consent_version}
    if language in study.languages:
        values["language"] = language
    seen = {"participant": visitor.participant, "first_seen": visitor.now}
    connection.execute(insert_or_skip(PARTICIPANTS), seen)
    connection.execute(insert(SESSIONS), values)
    _keep(connection, visitor, visit.session.session)
    return new_session_of(values)


def _sessions_of(connection: Connection, study: Study, visitor: Visitor) -> list[Session]:
    """Return the stored sessions of the visitor."""
    own = SESSIONS.c.participant == visitor.participant
    rows = connection.execute(select(*SESSION_COLUMNS).where(own))
    return [session_from_row(study, row) for row in rows]


def _known_session(
    connection: Connection,
    study: Study,
    courses: Courses,
    sessions: list[Session],
    visitor: Visitor,
) -> Session | None:
    """Return the session that the visitor continues or has stopped; None for a new one."""
    wanted = visitor.enter.scenario
    session = _find_unfinished(sessions, wanted)
    if session is not None:
        _check_browser(connection, session, visitor)
        step = Step(connection, study, courses.of(session), session, visitor.now)
        step.change(last_seen=visitor.now, **step.loaded())
        step.add_event(ENTERED_AGAIN, visitor.enter.device.model_dump())
    else:
        own = next((each.condition for each in sessions if each.condition), None)
        session = _find_ended(under(study, own), sessions, wanted)
        if session is None:
            return None
        _check_browser(connection, session, visitor)
    _keep(connection, visitor, session.session)
    return session


def _keep(connection: Connection, visitor: Visitor, session: str) -> None:
    """Store the visitor's token of a session, and the raw id for payment.

    The recruiter's parameters of the latest visit are kept.
    """
    token = {"token_hash": hash_token(visitor.token), "session": session, "made": visitor.now}
    connection.execute(insert_or_skip(TOKENS), token)
    if visitor.raw_id is None:
        return
    values = {
        "source": visitor.enter.source,
        "raw_id": visitor.raw_id,
        "recruiter": visitor.enter.recruiter,
        "seen": visitor.now,
    }
    statement = RAW_IDS.update().where(RAW_IDS.c.participant == visitor.participant)
    if connection.execute(statement.values(**values)).rowcount == 0:
        connection.execute(insert(RAW_IDS), {"participant": visitor.participant, **values})


def _check_browser(connection: Connection, session: Session, visitor: Visitor) -> None:
    """Raise `Refused` unless the visitor's browser may continue the session.

    It may with its own key, with a token of the session, or by a signed link.
    """
    if visitor.signed or (session.browser and session.browser == visitor.browser):
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
        if end_of(session) is None and scenario in (None, session.scenario)
    ]
    return max(unfinished, key=lambda session: session.started_at, default=None)


def _find_ended(study: Study, sessions: list[Session], scenario: str | None) -> Session | None:
    """Return the latest session, of ``scenario`` if it is given, if it was stopped.

    None if another scenario is left in which the visitor may begin, and for sessions that the lab
    ended. Who was screened out cannot begin in another scenario.
    """
    screened_out = [session for session in sessions if session.screened_out_at is not None]
    if screened_out:
        return max(screened_out, key=lambda session: session.started_at)
    known = {session.scenario for session in sessions}
    wanted = [session for session in sessions if scenario in (None, session.scenario)]
    if not wanted or (scenario is None and not set(study.scenarios) <= known):
        return None
    last = max(wanted, key=lambda session: session.started_at)
    by_lab = last.closed_at is not None or last.voided_at is not None
    return last if last.withdrawn_at is not None and not by_lab else None


def _match_language(study: Study, wanted: str) -> str:
    """Return the best matching language of the study; ``de-AT`` falls back to ``de``."""
    known = {language.lower(): language for language in study.languages}
    wanted = wanted.lower()
    return known.get(wanted) or known.get(wanted.partition("-")[0]) or study.languages[0]


@dataclass
class _Count:
    """Numbers of sessions of one scenario, condition and prepared order.

    Attributes
    ----------
    total
        Sessions that did not end early.
    counted
        The plausible ones that are finished, active, or hold a place.
    begun
        Finished and active ones.
    taken
        Places: plausible sessions that are finished, or held by people who continue.
    finished
        Plausible finished ones.
    """

    total: int = 0
    counted: int = 0
    begun: int = 0
    taken: int = 0
    finished: int = 0


class _Places:
    """Which scenarios, conditions and orders the sessions of the visitor's kind have.

    ``others``: visitors who read the consent; they count for the choice, but take no place.
    """

    def __init__(
        self,
        connection: Connection,
        study: Study,
        visitor: Visitor,
        others: Sequence[Visit] = (),
    ) -> None:
        self.visitor = visitor
        self._paused = visitor.kind == "person" and is_paused(connection)
        self.reading = [
            each
            for each in others
            if each.session.kind == visitor.kind
            and each.session.withdrawn_at is None
            and each.session.started_at >= visitor.now - ACTIVE_WITHIN
        ]
        columns = SESSIONS.c
        finished, active, held = in_use(study, visitor.now)
        plausible = columns.implausible.is_(None)

        def number(*conditions: ColumnElement[bool]) -> ColumnElement[int]:
            return func.sum(case((and_(*conditions), 1), else_=0))

        statement = (
            select(
                columns.scenario,
                columns.condition,
                columns.order_number,
                func.count(),
                number(plausible, or_(finished, active, held)),
                number(or_(finished, active)),
                number(plausible, or_(finished, held)),
                number(plausible, finished),
            )
            .where(*live(visitor.kind))
            .group_by(columns.scenario, columns.condition, columns.order_number)
        )
        self._rows = [
            (scenario, condition, order, _Count(*counts))
            for scenario, condition, order, *counts in connection.execute(statement)
        ]
        for each in self.reading:
            own, order = each.session, int(each.values["order_number"])
            self._rows.append((own.scenario, own.condition, order, _Count(1, 1, 1)))

    def count(self, what: str, **where: Any) -> int:
        """Sum a field of `_Count` over the rows of a scenario, condition or order."""
        names = ("scenario", "condition", "order")
        return sum(
            getattr(count, what)
            for *keys, count in self._rows
            if all(keys[names.index(name)] == value for name, value in where.items())
        )

    def require(self, study: Study, scenarios: Sequence[str]) -> list[str]:
        """Return the scenarios that have a place left; all of them unless people are counted.

        Raises
        ------
        Refused
            Recruitment is paused, or all places are taken or held.
        """
        if self._paused:
            raise Refused("paused", "The study takes in nobody at the moment; try again later.")
        if self.visitor.kind != "person":
            return list(scenarios)
        wanted = study.participants
        free = [each for each in scenarios if self.count("taken", scenario=each) < wanted]
        if free:
            return free
        if any(self.count("finished", scenario=each) < wanted for each in scenarios):
            minutes = study.recruitment.hold_minutes
            raise Refused(
                "held",
                "All places are taken at the moment, but not everybody may finish. Please come "
                f"back in {minutes} minutes.",
            )
        raise Refused(
            "study_full",
            "The study has all the participants that it needs. Thank you!",
            completion=ending_completion(study.full, self.visitor.enter.source),
        )


def is_paused(connection: Connection) -> bool:
    """Return whether recruitment is paused."""
    going = select(PAUSES.c.paused_at).where(PAUSES.c.resumed_at.is_(None)).limit(1)
    return connection.execute(going).first() is not None


def live(kind: str) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions for sessions of a kind that did not end early and are not void."""
    columns = SESSIONS.c
    return (
        columns.kind == kind,
        columns.withdrawn_at.is_(None),
        columns.voided_at.is_(None),
        columns.screened_out_at.is_(None),
    )


def in_use(study: Study, now: float) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions for sessions that are finished, active, or hold a place.

    A place is held once the practice is over, until no page or answer has come for
    ``hold_minutes``: a script that only sends the first pages takes no place from people.
    """
    columns = SESSIONS.c
    practised = or_(columns.ready_at.is_not(None), columns.answered_test > 0)
    held_since = now - 60 * study.recruitment.hold_minutes
    return (
        columns.finished_at.is_not(None),
        columns.last_seen >= now - ACTIVE_WITHIN,
        and_(practised, columns.progressed_at >= held_since),
    )


def _choose_course(
    study: Study, places: _Places, visitor: Visitor, done: set[str], own: str | None
) -> tuple[Study, str]:
    """Return the study under the condition of a new session, and its scenario.

    A person keeps the condition of earlier sessions; else the link fixes it, or it is the one with
    the fewest sessions that has a place left in a wanted scenario. If the link names a scenario,
    only sessions of this scenario count.

    Parameters
    ----------
    study, places, visitor
        The study, its sessions, and who enters.
    done
        Scenarios in which the visitor has a session already.
    own
        Condition of these sessions, if there are any.

    Raises
    ------
    Refused
        As `_choose_scenario` does, for all conditions.
    """
    wanted = visitor.enter.scenario
    fixed = own or visitor.enter.condition
    ranked: Iterable[Study] = (under(study, fixed),)
    if fixed is None:
        only = {} if wanted is None else {"scenario": wanted}

        def rank(variant: Study) -> tuple[int, int]:
            tie = stable_hash("condition", study.seed, visitor.participant, variant.condition)
            return places.count("counted", condition=variant.condition or None, **only), tie

        ranked = sorted(variants(study), key=rank)
    refused: Refused | None = None
    for variant in ranked:
        if wanted not in (None, *variant.scenarios):
            continue
        try:
            return variant, _choose_scenario(variant, places, wanted, done)
        except Refused as error:
            refused = refused or error
    raise refused or Refused("bad_link", "This link names a scenario that its condition lacks.")


def _choose_scenario(study: Study, places: _Places, wanted: str | None, done: set[str]) -> str:
    """Return the scenario of a new session: the wanted one, else the one with fewest sessions.

    Scenarios in ``done`` are excluded, and for people also those that have enough participants.
    """
    available = [each for each in study.scenarios if each not in done and wanted in (None, each)]
    if not available:
        raise Refused("already_took_part", "You have taken part already. Thank you!")
    free = places.require(study, available)
    return min(free, key=lambda scenario: places.count("begun", scenario=scenario))


def _assign_order(
    study: Study, secrets: Secrets, scenario: str, places: _Places
) -> tuple[int, int]:
    """Return the number of the prepared order of a new session, 0 if there is none, and its seed.

    The least used prepared order is taken.
    """
    if study.orders:
        own = {"scenario": scenario, "condition": study.condition or None}
        number = min(
            range(1, study.orders + 1),
            key=lambda order: (places.count("total", order=order, **own), order),
        )
        return number, prepared_order_seed(study, secrets, scenario, number)
    return 0, individual_order_seed(study, scenario, places.visitor.participant)
