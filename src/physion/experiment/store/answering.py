"""What a participant sends: answers, showings of trials, and the pages between the trials.

An answer is stored only to the next trial and each once; in familiarization it gets feedback. What
a request may change follows from the stage of the session, so every request may be sent again.
`FetchedMedia` remembers which movies and maps the server has sent.
"""

from __future__ import annotations

import json
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

from sqlalchemy import Connection, bindparam, func, insert, select, update

from physion.experiment.protocol import (
    ENDED,
    PAGES,
    STAGES,
    Answer,
    AnswerStored,
    Course,
    Feedback,
    PageDone,
    Refused,
    SessionState,
    Showing,
    Shown,
)
from physion.experiment.store.database import (
    ANSWERS,
    EVENTS,
    SESSIONS,
    SHOWINGS,
)
from physion.experiment.store.judging import (
    TOLERANCE_S,
    Presentation,
    earliest_answer,
    judge_practice,
    judged,
    reasons,
    repeated_response,
    speed,
)
from physion.experiment.store.sessions import (
    Session,
    answered,
    change_session,
    insert_or_skip,
    stage_of,
    state_of,
    with_check,
)
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media import MediaKind, session_tag, sign_media
from physion.experiment.study.orders import trial_order
from physion.experiment.study.settings import check_answers, check_attempt
from physion.experiment.study.stimuli import ATTENTION, PHASES, Stimulus
from physion.experiment.study.study import Study

MAX_DETAILS = 16 * 1024
_STORED = select(ANSWERS.c.key, ANSWERS.c.response).where(
    ANSWERS.c.session == bindparam("of_session"),
    ANSWERS.c.phase == bindparam("of_phase"),
    ANSWERS.c.trial == bindparam("of_trial"),
)
_JUDGED = ("fast_answers", "unfetched", "replayed", "implausible", "next_from")
"""Columns of a session that change with each answer, besides its number of answers."""
_COUNT = {
    phase: update(SESSIONS)
    .where(SESSIONS.c.session == bindparam("of_session"))
    .values(
        {f"answered_{phase}": bindparam("count")}
        | dict.fromkeys(("last_seen", "progressed_at"), bindparam("now"))
        | {name: bindparam(f"new_{name}") for name in _JUDGED}
    )
    for phase in PHASES
}


def encode_details(answer: Answer) -> str:
    """Return the further measurements of an answer as JSON text.

    Raises
    ------
    Refused
        They are not plain JSON values, or longer than `MAX_DETAILS` characters.
    """
    try:
        text = json.dumps(answer.details, allow_nan=False, separators=(",", ":"))
    except (ValueError, TypeError, RecursionError):
        raise Refused("bad_request", "details: only plain JSON values") from None
    if len(text) > MAX_DETAILS:
        raise Refused("bad_request", f"details: at most {MAX_DETAILS} characters as JSON")
    return text


def store_answer(
    connection: Connection,
    study: Study,
    secrets: Secrets,
    course: Course,
    session: Session,
    answer: Answer,
    details: str,
    now: float,
    fetched_at: float | None = None,
) -> AnswerStored:
    """Store the answer to the next trial, unless the same answer is stored already.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    study, secrets
        The study and its keys.
    course
        What the session consists of.
    session
        The session; its count of answers is increased.
    answer
        The answer as sent by the client.
    details
        `encode_details` of the answer.
    now
        Time of the server in seconds since 1970.
    fetched_at
        `FetchedMedia.sent_at` of the trial.

    Raises
    ------
    Refused
        Another trial is next, the trial or the key has another answer, or the trial was not shown
        or cannot have been shown until now.
    """
    known = answered(session, answer.phase)
    # Stimuli cannot change while there are sessions, so an answered trial has its stimulus still.
    order = trial_order(study, session.scenario, session.order_seed)[answer.phase]
    repeated = repeated_response(connection, session, answer)
    if repeated is not None:
        response, duplicate = repeated, True
    elif answer.trial < known:
        response = _read_stored(connection, course, session, answer, order[answer.trial])
        duplicate = True
    else:
        _check_next(course, session, answer, known)
        response = answer.response
        duplicate = False
    stimulus = order[answer.trial]
    if not duplicate:
        if answer.phase == PHASES[0] and session.practice_repeats > 0:
            fetched_at = None  # the browser may still have the media of the first practice
        shown = read_presentation(connection, study, course, session, answer, fetched_at)
        changes = _judge(study, session, answer, shown, now)
        values = {
            "phase": stimulus.phase,
            "stimulus": stimulus.stimulus,
            "frames_expected": stimulus.frames,
            "showings": shown.showings or None,
            "details": details,
        }
        _insert_answer(connection, course, session, answer, values, changes, now)
        if answer.phase == PHASES[0]:
            judge_practice(connection, study, course, session, now)
        if stimulus.phase == ATTENTION:
            _judge_attention(connection, study, session, answer, stimulus)
    feedback = None
    if answer.phase == PHASES[0] and study.familiarization_feedback:
        feedback = _build_feedback(study, secrets, session, stimulus, answer.trial, response)
    return AnswerStored(duplicate=duplicate, feedback=feedback, state=state_of(session, course))


def _judge_attention(
    connection: Connection, study: Study, session: Session, answer: Answer, check: Stimulus
) -> None:
    """Count a failed attention check, unless its movie was interrupted."""
    if (answer.response == "yes") == check.label or answer.void is not None:
        return
    failed = session.attention_failed + 1
    flag = with_check(session, ATTENTION) if failed > study.attention.max_failed else {}
    change_session(connection, session, attention_failed=failed, **flag)


def _read_stored(
    connection: Connection, course: Course, session: Session, answer: Answer, stimulus: Stimulus
) -> str:
    """Return the stored response of a trial if it has the same key; else raise `Refused`."""
    row = connection.execute(
        _STORED,
        {"of_session": session.session, "of_phase": stimulus.phase, "of_trial": answer.trial},
    ).one()
    if row.key != answer.key:
        raise Refused(
            "already_answered", "This trial is already answered.", state_of(session, course)
        )
    return str(row.response)


def _check_next(course: Course, session: Session, answer: Answer, known: int) -> None:
    """Raise `Refused` unless this trial is the next one of the session."""
    stage = stage_of(session, course)
    if stage not in PHASES:
        raise Refused("wrong_stage", "No trial is next.", state_of(session, course))
    if stage != answer.phase or answer.trial != known:
        raise Refused("out_of_order", "Another trial is next.", state_of(session, course))


def _judge(
    study: Study, session: Session, answer: Answer, shown: Presentation, now: float
) -> dict[str, Any]:
    """Return the columns of `_JUDGED` after an answer; raise `Refused` if it comes too early."""
    earliest = earliest_answer(study, session, answer.phase, answer.trial, shown)
    if study.plausibility.server_checks and now < earliest:
        raise Refused(
            "too_early",
            "The movie of this trial cannot have been shown yet.",
            wait_s=earliest - now,
        )
    changes: dict[str, Any] = judged(study, session, answer, shown)
    for name, value in changes.items():
        setattr(session, name, value)
    ended_at = earliest + (TOLERANCE_S + answer.rt_ms / 1000) / speed(study, session)
    return changes | {"implausible": reasons(study, session), "next_from": min(now, ended_at)}


def _insert_answer(
    connection: Connection,
    course: Course,
    session: Session,
    answer: Answer,
    values: Mapping[str, Any],
    changes: Mapping[str, Any],
    now: float,
) -> None:
    """Insert the answer with the further columns ``values``; count it and change the session."""
    loaded = (session.loaded_at_phase, session.loaded_at_trial)
    row: dict[str, Any] = {
        **answer.model_dump(exclude={"details"}),
        **values,
        "session": session.session,
        "resumed": loaded == (answer.phase, answer.trial),
        "answered_at": now,
    }
    # Only a key that another trial has can conflict; then nothing is written.
    if connection.execute(insert_or_skip(ANSWERS), row).rowcount != 1:
        raise Refused(
            "already_answered", "This key belongs to another trial.", state_of(session, course)
        )
    count = answer.trial + 1
    new = {f"new_{name}": value for name, value in changes.items()}
    connection.execute(
        _COUNT[answer.phase], {"of_session": session.session, "count": count, "now": now, **new}
    )
    setattr(session, f"answered_{answer.phase}", count)


def _build_feedback(
    study: Study,
    secrets: Secrets,
    session: Session,
    stimulus: Stimulus,
    trial: int,
    response: str,
) -> Feedback:
    """Return the feedback on a familiarization answer."""
    return Feedback(
        contact=stimulus.label,
        correct=(response == "yes") == stimulus.label,
        movie=sign_media(
            study,
            secrets,
            session.scenario,
            session.order_seed,
            PHASES[0],
            trial,
            "full",
            session_tag(secrets, session.session),
        ),
        frames=stimulus.full_frames,
    )


MAX_STORED = 50
"""Showings stored for one trial, so that nobody can fill the disk."""
_OF_TRIAL = select(func.count(), func.max(SHOWINGS.c.began_at)).where(
    SHOWINGS.c.session == bindparam("of_session"),
    SHOWINGS.c.phase == bindparam("of_phase"),
    SHOWINGS.c.trial == bindparam("of_trial"),
)


def store_showing(
    connection: Connection,
    course: Course,
    session: Session,
    showing: Showing,
    now: float,
) -> Shown:
    """Store that the next trial begins; the same key is stored once.

    It cannot have begun before the previous trial had ended (``Session.next_from``). A showing of a
    trial that is answered already, which was delayed on its way, is not stored.

    Raises
    ------
    Refused
        Another trial or another page is next.
    """
    phase, trial = showing.phase, showing.trial
    if trial < answered(session, phase):
        return Shown(showings=_read(connection, session, phase, trial)[0])
    if stage_of(session, course) != phase:
        raise Refused("wrong_stage", "No trial of this phase is next.", state_of(session, course))
    if trial != answered(session, phase):
        raise Refused("out_of_order", "Another trial is next.", state_of(session, course))
    count, _ = _read(connection, session, phase, trial)
    if count < MAX_STORED:
        row = {
            "session": session.session,
            "key": showing.key,
            "phase": phase,
            "trial": trial,
            "began_at": max(now - showing.ago_ms / 1000, session.next_from or 0.0),
            "stored_at": now,
        }
        count += connection.execute(insert_or_skip(SHOWINGS), row).rowcount
    return Shown(showings=count)


def read_presentation(
    connection: Connection,
    study: Study,
    course: Course,
    session: Session,
    answer: Answer,
    fetched_at: float | None,
) -> Presentation:
    """Return what is known of the showings of the trial of an answer.

    Parameters
    ----------
    connection
        Connection of the writer.
    study
        The study; without its ``server_checks`` a trial need not have been announced.
    course
        What the session consists of.
    session, answer
        The session, and its answer to the next trial.
    fetched_at
        `FetchedMedia.sent_at` of the trial.

    Raises
    ------
    Refused
        The trial was never announced.
    """
    count, began_at = _read(connection, session, answer.phase, answer.trial)
    if not study.plausibility.server_checks:
        return Presentation(count, began_at or 0.0, None)
    if began_at is None:
        raise Refused("not_shown", "This trial was not shown yet.", state_of(session, course))
    return Presentation(count, began_at, fetched_at)


def _read(
    connection: Connection, session: Session, phase: str, trial: int
) -> tuple[int, float | None]:
    """Return the number of showings of a trial, and the start of the last one."""
    values = {"of_session": session.session, "of_phase": phase, "of_trial": trial}
    count, began_at = connection.execute(_OF_TRIAL, values).one()
    return count, began_at


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
    return value.strip() or None


def _check_difficulty(value: Any) -> int:
    """Validate a rating from 1 to 5."""
    if isinstance(value, bool) or value not in (1, 2, 3, 4, 5):
        raise ValueError("a whole number from 1 (very easy) to 5 (very hard)")
    return int(value)


def _check_text(value: Any) -> str:
    """Validate a text, which may be empty."""
    if not isinstance(value, str):
        raise ValueError("text, which may be empty")
    return value.strip()


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
    try:
        return {"own_answers": check_answers(study.questions, data)}
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


def _columns(
    study: Study, session: Session, page: str, values: Mapping[str, Any], now: float
) -> dict[str, Any]:
    """Return the columns of SESSIONS that a page sets, besides the time at which it was sent."""
    match page:
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


ATTEMPT = "comprehension_attempt"
"""Kind of the event of an attempt; its data are its number, whether all was right, the answers."""


def judge_attempt(
    connection: Connection,
    study: Study,
    session: Session,
    answers: Mapping[str, str],
    now: float,
) -> dict[str, Any]:
    """Store an attempt as an event and return the columns of SESSIONS that it changes.

    After a wrong answer the instructions are next; after the last attempt the session has ended.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    study, session
        The study, and the session whose comprehension check is next.
    answers
        Answers from `study.comprehension.check_attempt`.
    now
        Time of the server in seconds since 1970.
    """
    attempts = session.comprehension_attempts + 1
    right = all(answers[each.name] == each.right for each in study.comprehension_questions)
    event = {
        "session": session.session,
        "kind": ATTEMPT,
        "at_ms": 0.0,
        "stored_at": now,
        "data": {"attempt": attempts, "right": right, **answers},
    }
    connection.execute(insert(EVENTS), event)
    columns: dict[str, Any] = {"comprehension_attempts": attempts}
    if right:
        return columns | {"comprehended_at": now}
    if attempts >= study.comprehension.attempts:
        return columns | {"screened_out_at": now, "screened_out_by": "comprehension"}
    return columns | {"instructed_at": None}


MAX_SESSIONS = 20_000
"""Sessions remembered; the least recently used are dropped first."""
_Trial = tuple[str, int]


class FetchedMedia:
    """When the media of each trial were first sent, by the tag of the session in their URLs."""

    def __init__(self, most: int = MAX_SESSIONS) -> None:
        self._most = most
        self._since = time.time()
        self._complete = True
        self._sent: OrderedDict[str, dict[_Trial, dict[MediaKind, float]]] = OrderedDict()
        self._lock = threading.Lock()

    def note(self, tag: str, phase: str, trial: int, kind: MediaKind, now: float) -> None:
        """Record that a file was sent at the time ``now`` in seconds since 1970."""
        with self._lock:
            trials = self._sent.setdefault(tag, {})
            trials.setdefault((phase, trial), {}).setdefault(kind, now)
            self._sent.move_to_end(tag)
            if len(self._sent) > self._most:
                self._sent.popitem(last=False)
                self._complete = False

    def sent_at(self, tag: str, started_at: float, phase: str, trial: int) -> float | None:
        """Return the time at which movie and map of a trial had both been asked for.

        Parameters
        ----------
        tag
            `media_links.session_tag` of the session.
        started_at
            When the session began.
        phase, trial
            The trial.

        Returns
        -------
        The time in seconds since 1970; infinity if one of them was never asked for; None if it is
        not known, because the session began before this server or was dropped from memory.
        """
        with self._lock:
            trials = self._sent.get(tag)
            if started_at < self._since or (trials is None and not self._complete):
                return None
            sent = (trials or {}).get((phase, trial), {})
            return max(sent.get("movie", float("inf")), sent.get("map", float("inf")))

    def forget(self, tag: str, phase: str, trial: int) -> None:
        """Forget the media of a trial, which was answered."""
        with self._lock:
            trials = self._sent.get(tag)
            if trials is not None:
                trials.pop((phase, trial), None)
