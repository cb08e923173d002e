"""The practice criterion: practice is repeated, ends the session, or is flagged.

The answers of a practice that is repeated are kept in PRACTICE_REPEATS, so that ANSWERS has one
answer for each trial: that of the last repeat.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import Connection, delete, insert, literal, select

from physion.experiment.protocol.messages import Answer
from physion.experiment.protocol.stages import Course
from physion.experiment.store.sessions import Session, block_of, change_session, with_check
from physion.experiment.store.tables import ANSWERS, PRACTICE_REPEATS, SHOWINGS
from physion.experiment.study.orders import trial_order
from physion.experiment.study.stimuli import PHASES
from physion.experiment.study.study import Study

PRACTICE = "practice"
"""Name of this check in ``screened_out_by`` and ``failed_checks`` of a session."""


def repeated_response(connection: Connection, session: Session, answer: Answer) -> str | None:
    """Return the stored response of this answer, by its key, in an earlier repeat; else None."""
    if answer.phase != PHASES[0] or session.practice_repeats == 0:
        return None
    own = PRACTICE_REPEATS.c.session == session.session
    same = select(PRACTICE_REPEATS.c.response).where(own, PRACTICE_REPEATS.c.key == answer.key)
    return connection.execute(same).scalar()


def judge_practice(
    connection: Connection, study: Study, course: Course, session: Session, now: float
) -> None:
    """Judge the practice of the current block when its last trial has been answered.

    With fewer right answers than ``practice.min_correct`` it is repeated ``practice.repeats``
    times; afterwards the session ends or is flagged.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    study, course
        The study, and what the session consists of.
    session
        The session, to whose last practice trial an answer was stored; it is updated.
    now
        Time of the server in seconds since 1970.
    """
    rules, trials = study.practice, block_of(session, course).familiarization
    if session.answered_familiarization < trials.stop or not trials:
        return
    if _count_right(connection, study, session, trials) >= min(rules.min_correct, len(trials)):
        return
    if session.practice_repeats < rules.repeats:
        changes = _repeat(connection, session, trials)
    elif rules.failed == "end":
        changes = {"screened_out_at": now, "screened_out_by": PRACTICE}
    else:
        changes = with_check(session, PRACTICE)
    change_session(connection, session, **changes)


def _count_right(connection: Connection, study: Study, session: Session, trials: range) -> int:
    """Count the right answers to these practice trials."""
    order = trial_order(study, session.scenario, session.order_seed)[PHASES[0]]
    rows = connection.execute(
        select(ANSWERS.c.trial, ANSWERS.c.response).where(*_of(ANSWERS, session, trials))
    )
    return sum((response == "yes") == order[trial].label for trial, response in rows)


def _repeat(connection: Connection, session: Session, trials: range) -> dict[str, Any]:
    """Move the answers to these practice trials away; return the changed columns of the session."""
    columns = list(ANSWERS.c)
    moved = select(literal(session.practice_repeats), *columns).where(
        *_of(ANSWERS, session, trials)
    )
    names = ["repeat", *(column.name for column in columns)]
    connection.execute(insert(PRACTICE_REPEATS).from_select(names, moved))
    for table in (ANSWERS, SHOWINGS):
        connection.execute(delete(table).where(*_of(table, session, trials)))
    return {
        "answered_familiarization": trials.start,
        "practice_repeats": session.practice_repeats + 1,
        "loaded_at_phase": None,
        "loaded_at_trial": None,
    }


def _of(table: Any, session: Session, trials: range) -> tuple[Any, ...]:
    """Return the conditions for the rows of these practice trials of a session."""
    return (
        table.c.session == session.session,
        table.c.phase == PHASES[0],
        table.c.trial >= trials.start,
        table.c.trial < trials.stop,
    )
