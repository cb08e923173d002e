"""Store answers: only to the next trial and each once; give feedback in familiarization."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, bindparam, select, update

from physion.experiment.protocol.messages import Answer, AnswerStored, Feedback
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.sessions import Session, answered, insert_or_skip, stage_of, state_of
from physion.experiment.store.tables import ANSWERS, SESSIONS
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media_links import sign_media
from physion.experiment.study.orders import trial_order
from physion.experiment.study.stimuli import PHASES, Stimulus
from physion.experiment.study.study import Study

MAX_DETAILS = 16 * 1024
_STORED = select(ANSWERS.c.key, ANSWERS.c.response).where(
    ANSWERS.c.session == bindparam("of_session"),
    ANSWERS.c.phase == bindparam("of_phase"),
    ANSWERS.c.trial == bindparam("of_trial"),
)
_COUNT = {
    phase: update(SESSIONS)
    .where(SESSIONS.c.session == bindparam("of_session"))
    .values({f"answered_{phase}": bindparam("count"), "last_seen": bindparam("now")})
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
    trials: Mapping[str, int],
    session: Session,
    answer: Answer,
    details: str,
    now: float,
) -> AnswerStored:
    """Store the answer to the next trial, unless the same answer is stored already.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    study, secrets
        The study and its keys.
    trials
        Number of trials in each phase of the session's scenario.
    session
        The session; its count of answers is increased.
    answer
        The answer as sent by the client.
    details
        `encode_details` of the answer.
    now
        Time of the server in seconds since 1970.

    Raises
    ------
    Refused
        Another trial is next, or the trial or the key has another answer.
    """
    known = answered(session, answer.phase)
    if answer.trial < known:
        response = _read_stored(connection, trials, session, answer)
        duplicate = True
    else:
        _check_next(trials, session, answer, known)
        response = answer.response
        duplicate = False
    # Stimuli cannot change while there are sessions, so an answered trial has this stimulus too.
    stimulus = trial_order(study, session.scenario, session.order_seed)[answer.phase][answer.trial]
    if not duplicate:
        _insert_answer(connection, trials, session, stimulus, answer, details, now)
    feedback = None
    if answer.phase == PHASES[0]:
        feedback = _build_feedback(study, secrets, session, stimulus, answer.trial, response)
    return AnswerStored(duplicate=duplicate, feedback=feedback, state=state_of(session, trials))


def _read_stored(
    connection: Connection, trials: Mapping[str, int], session: Session, answer: Answer
) -> str:
    """Return the stored response of a trial if it has the same key; else raise `Refused`."""
    row = connection.execute(
        _STORED,
        {"of_session": session.session, "of_phase": answer.phase, "of_trial": answer.trial},
    ).one()
    if row.key != answer.key:
        raise Refused(
            "already_answered", "This trial is already answered.", state_of(session, trials)
        )
    return str(row.response)


def _check_next(trials: Mapping[str, int], session: Session, answer: Answer, known: int) -> None:
    """Raise `Refused` unless this trial is the next one of the session."""
    stage = stage_of(session, trials)
    if stage not in PHASES:
        raise Refused("wrong_stage", "No trial is next.", state_of(session, trials))
    if stage != answer.phase or answer.trial != known:
        raise Refused("out_of_order", "Another trial is next.", state_of(session, trials))


def _insert_answer(
    connection: Connection,
    trials: Mapping[str, int],
    session: Session,
    stimulus: Stimulus,
    answer: Answer,
    details: str,
    now: float,
) -> None:
    """Insert the answer and increase the session's count of answers."""
    loaded = (session.loaded_at_phase, session.loaded_at_trial)
    values: dict[str, Any] = {
        **answer.model_dump(exclude={"details"}),
        "session": session.session,
        "stimulus": stimulus.stimulus,
        "frames_expected": stimulus.frames,
        "resumed": loaded == (answer.phase, answer.trial),
        "answered_at": now,
        "details": details,
    }
    # Only a key that another trial has can conflict; then nothing is written.
    if connection.execute(insert_or_skip(connection, ANSWERS), values).rowcount != 1:
        raise Refused(
            "already_answered", "This key belongs to another trial.", state_of(session, trials)
        )
    count = answer.trial + 1
    connection.execute(
        _COUNT[answer.phase], {"of_session": session.session, "count": count, "now": now}
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
            study, secrets, session.scenario, session.order_seed, PHASES[0], trial, "full"
        ),
        frames=stimulus.full_frames,
    )
