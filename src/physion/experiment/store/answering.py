"""Storing answers: only the next trial, each once, and the feedback of familiarization."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, bindparam, select, update

from physion.experiment.protocol.messages import Answer, AnswerStored, Feedback
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.sessions import Session, answered, insert_new, stage_of, state_of
from physion.experiment.store.tables import ANSWERS, SESSIONS
from physion.experiment.study.identity import Secrets
from physion.experiment.study.orders import order_of
from physion.experiment.study.stimuli import PHASES, Stimulus
from physion.experiment.study.study import Study
from physion.experiment.web.media_links import sign_media

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


def write_details(answer: Answer) -> str:
    """Further measures as JSON text; `Refused` where they are too long or no JSON."""
    try:
        text = json.dumps(answer.details, allow_nan=False, separators=(",", ":"))
    except (ValueError, TypeError, RecursionError):
        raise Refused("bad_request", "details: plain JSON values alone") from None
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
    """Store the answer to the next trial, or find that this very answer is stored already."""
    known = answered(session, answer.phase)
    if answer.trial < known:
        response = _stored_before(connection, trials, session, answer)
        duplicate = True
    else:
        _check_turn(trials, session, answer, known)
        response = answer.response
        duplicate = False
    # A trial that is over was one of this study: stimuli do not change while there are sessions.
    stimulus = order_of(study, session.scenario, session.order_seed)[answer.phase][answer.trial]
    if not duplicate:
        _store(connection, trials, session, stimulus, answer, details, now)
    feedback = None
    if answer.phase == PHASES[0]:
        feedback = _feedback(study, secrets, session, stimulus, answer.trial, response)
    return AnswerStored(duplicate=duplicate, feedback=feedback, state=state_of(session, trials))


def _stored_before(
    connection: Connection, trials: Mapping[str, int], session: Session, answer: Answer
) -> str:
    """The response that is stored under the same key."""
    row = connection.execute(
        _STORED,
        {"of_session": session.session, "of_phase": answer.phase, "of_trial": answer.trial},
    ).one()
    if row.key != answer.key:
        raise Refused("already_answered", "This trial has its answer.", state_of(session, trials))
    return str(row.response)


def _check_turn(trials: Mapping[str, int], session: Session, answer: Answer, known: int) -> None:
    stage = stage_of(session, trials)
    if stage not in PHASES:
        raise Refused("wrong_stage", "No trial comes now.", state_of(session, trials))
    if stage != answer.phase or answer.trial != known:
        raise Refused("out_of_order", "Another trial comes now.", state_of(session, trials))


def _store(
    connection: Connection,
    trials: Mapping[str, int],
    session: Session,
    stimulus: Stimulus,
    answer: Answer,
    details: str,
    now: float,
) -> None:
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
    # A key of another trial is the one thing that can be in the way, and then nothing is written.
    if connection.execute(insert_new(connection, ANSWERS), values).rowcount != 1:
        raise Refused(
            "already_answered", "This key belongs to another trial.", state_of(session, trials)
        )
    count = answer.trial + 1
    connection.execute(
        _COUNT[answer.phase], {"of_session": session.session, "count": count, "now": now}
    )
    setattr(session, f"answered_{answer.phase}", count)


def _feedback(
    study: Study,
    secrets: Secrets,
    session: Session,
    stimulus: Stimulus,
    trial: int,
    response: str,
) -> Feedback:
    return Feedback(
        contact=stimulus.label,
        correct=(response == "yes") == stimulus.label,
        movie=sign_media(
            study, secrets, session.scenario, session.order_seed, PHASES[0], trial, "full"
        ),
        frames=stimulus.full_frames,
    )
