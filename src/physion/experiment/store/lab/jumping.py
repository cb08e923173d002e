"""Move a preview to any page or trial."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Connection, delete

from physion.experiment.protocol.messages import Jump, SessionState
from physion.experiment.protocol.refused import Refused
from physion.experiment.protocol.stages import PAGES, Course
from physion.experiment.store.sessions import Session, change_session, state_of
from physion.experiment.store.tables import ANSWERS, PRACTICE_REPEATS
from physion.experiment.study.stimuli import ATTENTION, PHASES

_ENDS = ("withdrawn_at", "closed_at", "screened_out_at", "screened_out_by")
"""Columns of sessions that ended early."""


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
    block = _block_of(course, to)
    done = course.stages[: course.stages.index(to.stage)]
    values: dict[str, Any] = dict.fromkeys(_ENDS)
    values |= {"comprehension_attempts": 0, "practice_repeats": 0, "failed_checks": None,
               "attention_failed": 0}  # fmt: skip
    repeated = PRACTICE_REPEATS.c.session == session.session
    connection.execute(delete(PRACTICE_REPEATS).where(repeated))
    for stage, page in PAGES.items():
        values[page.column] = now if stage in done else None
    for phase in PHASES:
        own = course.trials.blocks[block].of(phase)
        here = to.trial if phase == to.stage else own.start
        values[f"answered_{phase}"] = own.stop if phase in done else here
        open_from = values[f"answered_{phase}"]
        phases = (phase, ATTENTION) if phase == "test" else (phase,)
        of_phase = (ANSWERS.c.session == session.session) & ANSWERS.c.phase.in_(phases)
        connection.execute(delete(ANSWERS).where(of_phase, ANSWERS.c.trial >= open_from))
    change_session(connection, session, block=block, **values)
    return state_of(session, course)


def _block_of(course: Course, to: Jump) -> int:
    """Return the index of the block to which a jump goes; `Refused` if there is none."""
    last = len(course.trials.blocks) - 1
    if to.stage in PHASES:
        for index, block in enumerate(course.trials.blocks):
            if to.trial in block.of(to.stage):
                return index
        raise Refused("bad_request", f"trial: the last one is {course.trials[to.stage] - 1}")
    if to.stage == "block" or (to.stage == "ready" and last > 0):
        # No page follows the last block.
        most = last - 1 if to.stage == "block" else last
        if to.trial > most:
            raise Refused("bad_request", f"trial: the last such block is {most}")
        return to.trial
    return 0 if course.stages.index(to.stage) <= course.stages.index("ready") else last
