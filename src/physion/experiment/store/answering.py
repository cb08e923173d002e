"""Store answers: only to the next trial and each once; give feedback in familiarization."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, bindparam, select, update

from physion.experiment.protocol.messages import Answer, AnswerStored, Feedback
from physion.experiment.protocol.refused import Refused
from physion.experiment.protocol.stages import Course
from physion.experiment.store.plausibility import (
    TOLERANCE_S,
    Presentation,
    earliest_answer,
    judged,
    reasons,
    speed,
)
from physion.experiment.store.practice import judge_practice, repeated_response
from physion.experiment.store.sessions import (
    Session,
    answered,
    change_session,
    insert_or_skip,
    stage_of,
    state_of,
    with_check,
)
from physion.experiment.store.showings import read_presentation
from physion.experiment.store.tables import ANSWERS, SESSIONS
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media_links import session_tag, sign_media
from physion.experiment.study.orders import trial_order
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
    if connection.execute(insert_or_skip(connection, ANSWERS), row).rowcount != 1:
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
