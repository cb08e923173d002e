"""Showings of trials: store that one begins, and read what an answer needs of them."""

from __future__ import annotations

from sqlalchemy import Connection, bindparam, func, select

from physion.experiment.protocol.messages import Answer, Showing, Shown
from physion.experiment.protocol.refused import Refused
from physion.experiment.protocol.stages import Course
from physion.experiment.store.plausibility import Presentation
from physion.experiment.store.sessions import Session, answered, insert_or_skip, stage_of, state_of
from physion.experiment.store.tables import SHOWINGS
from physion.experiment.study.study import Study

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
        count += connection.execute(insert_or_skip(connection, SHOWINGS), row).rowcount
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
