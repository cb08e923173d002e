"""Submitted pages between the trials: validate their fields and write them to the session."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sqlalchemy import Connection, delete, select, update

from physion.experiment.protocol.messages import PageDone, SessionState
from physion.experiment.protocol.refused import Refused
from physion.experiment.protocol.stages import ENDED, PAGES, STAGES, Course
from physion.experiment.store.comprehension import judge_attempt
from physion.experiment.store.plausibility import reasons
from physion.experiment.store.sessions import (
    ENTERED_AGAIN,
    Session,
    change_session,
    stage_of,
    state_of,
    storable,
)
from physion.experiment.store.tables import EVENTS, RAW_IDS, SESSIONS
from physion.experiment.study.comprehension import check_attempt
from physion.experiment.study.questions import check_answers
from physion.experiment.study.study import Study

MIN_AGE, MAX_AGE = 18, 130
MAX_LABEL = 200
"""Characters of a short text such as gender."""


def _check_bool(value: Any) -> bool:
    """Validate a boolean."""
    if not isinstance(value, bool):
        raise ValueError("true or false")
    return value


def _check_age(value: Any) -> int | None:
    """Validate an age in years or null."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or value != int(value):
        raise ValueError(f"a whole number from {MIN_AGE} to {MAX_AGE}, or null")
    if not MIN_AGE <= value <= MAX_AGE:
        raise ValueError(f"a whole number from {MIN_AGE} to {MAX_AGE}, or null")
    return int(value)


def _check_label(value: Any) -> str | None:
    """Validate a short text or null."""
    if value is None:
        return None
    if not isinstance(value, str) or len(value) > MAX_LABEL:
        raise ValueError(f"text of at most {MAX_LABEL} characters, or null")
    return storable(value).strip() or None


def _check_difficulty(value: Any) -> int:
    """Validate a rating from 1 to 5."""
    if isinstance(value, bool) or value not in (1, 2, 3, 4, 5):
        raise ValueError("a whole number from 1 (very easy) to 5 (very hard)")
    return int(value)


def _check_text(value: Any) -> str:
    """Validate a text, which may be empty."""
    if not isinstance(value, str):
        raise ValueError("text, which may be empty")
    return storable(value).strip()


def _check_index(value: Any) -> int:
    """Validate an index from 0."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 100_000:
        raise ValueError("a whole number of at least 0")
    return value


FIELDS: Mapping[str, Mapping[str, Callable[[Any], Any]]] = {
    "consent": {"agreed": _check_bool},
    "instructions": {},
    "ready": {},
    "block": {},
    "demographics": {"age": _check_age, "gender": _check_label, "education": _check_label},
    "feedback": {
        "difficulty": _check_difficulty,
        "technical_problems": _check_bool,
        "text": _check_text,
    },
    "withdraw": {},
}
"""Required fields of each page with their validators; null means "prefer not to say"."""
OPTIONAL: Mapping[str, Mapping[str, Callable[[Any], Any]]] = {
    "consent": {"language": _check_label},
    "ready": {"block": _check_index},
    "block": {"block": _check_index},
}
"""Optional fields of each page."""


def check_page(study: Study, done: PageDone) -> dict[str, Any]:
    """Return the validated values of a page.

    Raises
    ------
    Refused
        A field is missing, invalid or unknown; the message names the first one.
    """
    if done.page == "questions":
        return _check_own_questions(study, done.data)
    if done.page == "comprehension":
        try:
            return dict(check_attempt(study.comprehension_questions, done.data))
        except ValueError as error:
            raise Refused("bad_request", f"data.{error}") from None
    if done.page not in FIELDS:
        raise Refused("bad_request", f"page: {done.page} is no page that is submitted")
    optional = OPTIONAL.get(done.page, {})
    expected = {**FIELDS[done.page], **{k: v for k, v in optional.items() if k in done.data}}
    unknown = sorted(set(done.data) - set(expected))
    if unknown:
        name = ascii(unknown[0][:40])
        raise Refused("bad_request", f"data: the page {done.page} has no field {name}")
    values = {}
    for name, check in expected.items():
        if name not in done.data:
            raise Refused("bad_request", f"data.{name} is missing")
        try:
            values[name] = check(done.data[name])
        except (ValueError, OverflowError) as error:
            raise Refused("bad_request", f"data.{name}: {error}") from None
    return values


def _check_own_questions(study: Study, data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the validated answers to the lab's own questions."""
    given = {
        name: storable(value) if isinstance(value, str) else value for name, value in data.items()
    }
    try:
        return {"own_answers": check_answers(study.questions, given)}
    except ValueError as error:
        raise Refused("bad_request", f"data.{error}") from None


def submit_page(
    connection: Connection,
    study: Study,
    course: Course,
    session: Session,
    page: str,
    values: Mapping[str, Any],
    now: float,
) -> SessionState:
    """Apply a submitted page to the session; a page that was submitted before changes nothing.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    study
        The study.
    course
        What the session consists of.
    session
        The session; it is updated.
    page, values
        Name of the page and its values from `check_page`.
    now
        Time of the server in seconds since 1970.

    Raises
    ------
    Refused
        The page is not the next one.
    """
    stage = stage_of(session, course)
    if page == "withdraw" or values.get("agreed") is False:
        if stage == "done":
            raise Refused("wrong_stage", "This session is finished.", state_of(session, course))
        if stage not in ENDED:
            change_session(connection, session, withdrawn_at=now, last_seen=now)
            if session.consented_at is None:
                _forget_declined(connection, session)
        return state_of(session, course)
    if "block" in values and values["block"] < session.block and stage not in ENDED:
        return state_of(session, course)  # a page of an earlier block, sent again
    if stage in ENDED or STAGES.index(stage) < STAGES.index(page):  # type: ignore[arg-type]
        raise Refused("wrong_stage", "This page is not next.", state_of(session, course))
    if stage == page:
        if stage == "comprehension":
            columns = judge_attempt(connection, study, session, values, now)
        else:
            columns = {PAGES[stage].column: now, **_columns(study, session, page, values, now)}
        times = dict.fromkeys(("last_seen", "progressed_at", "next_from"), now)
        change_session(connection, session, **times, **columns)
    return state_of(session, course)


def _forget_declined(connection: Connection, session: Session) -> None:
    """Delete the data of a person who declined: the device, and the raw id if no other session
    needs it.
    """
    change_session(connection, session, device={})
    again = (EVENTS.c.session == session.session) & (EVENTS.c.kind == ENTERED_AGAIN)
    connection.execute(update(EVENTS).where(again).values(data={}))
    other = select(SESSIONS.c.session).where(
        SESSIONS.c.participant == session.participant, SESSIONS.c.session != session.session
    )
    own = RAW_IDS.c.participant == session.participant
    connection.execute(delete(RAW_IDS).where(own, ~other.exists()))


def _columns(
    study: Study, session: Session, page: str, values: Mapping[str, Any], now: float
) -> dict[str, Any]:
    """Return the columns of SESSIONS that a page sets, besides the time at which it was sent."""
    match page:
        case "consent":
            # Store the language in which the consent was read.
            known = values.get("language") in study.languages
            language = {"language": values["language"]} if known else {}
            return {"consent_version": study.consent_version, **language}
        case "block":
            return {"block": session.block + 1, "ready_at": None, "practice_repeats": 0}
        case "demographics":
            return dict(values)
        case "questions":
            return {**values, "questions_study": study.digest}
        case "feedback":
            return {
                "implausible": reasons(study, session, now),
                "difficulty": values["difficulty"],
                "technical_problems": values["technical_problems"],
                "feedback": values["text"],
            }
        case _:
            return {}
