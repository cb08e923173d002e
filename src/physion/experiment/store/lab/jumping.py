"""Move a preview to any page or trial."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Connection, delete

from physion.experiment.protocol.messages import Jump, SessionState
from physion.experiment.protocol.refused import Refused
from physion.experiment.protocol.stages import PAGES, Course
from physion.experiment.store.sessions import Session, change_session, state_of
from physion.experiment.store.tables import ANSWERS
from physion.experiment.study.stimuli import PHASES


def jump(
    connection: Connection, course: Course, session: Session, to: Jump, now: float
) -> SessionState:
    """Move a preview to a page or trial: all before it is taken as done, all from it on as open.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    course
        What the session consists of.
    session
        The session; it is updated.
    to
        The page, or the phase and the trial.
    now
        Time of the server in seconds since 1970.

    Raises
    ------
    Refused
        The session is no preview, or the study has no such page or trial.
    """
    if session.kind != "preview":
        raise Refused("bad_request", "Only a preview can go to any page.")
    if to.stage not in course.stages:
        raise Refused("bad_request", f"stage: the study has no {to.stage}")
    if to.stage in PHASES and to.trial >= course.trials[to.stage]:
        raise Refused("bad_request", f"trial: the last one is {course.trials[to.stage] - 1}")
    done = course.stages[: course.stages.index(to.stage)]
    values: dict[str, Any] = {"withdrawn_at": None, "closed_at": None}
    for stage, page in PAGES.items():
        values[page.column] = now if stage in done else None
    for phase in PHASES:
        here = to.trial if phase == to.stage else 0
        values[f"answered_{phase}"] = course.trials[phase] if phase in done else here
        open_from = values[f"answered_{phase}"]
        of_phase = (ANSWERS.c.session == session.session) & (ANSWERS.c.phase == phase)
        connection.execute(delete(ANSWERS).where(of_phase, ANSWERS.c.trial >= open_from))
    change_session(connection, session, **values)
    return state_of(session, course)
