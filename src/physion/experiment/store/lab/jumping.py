"""Move a preview to any page or trial."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, delete

from physion.experiment.protocol.messages import Jump, SessionState
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.sessions import STAGES, Session, change_session, state_of
from physion.experiment.store.tables import ANSWERS
from physion.experiment.study.stimuli import PHASES

_TIMES = {
    "consent": "consented_at",
    "instructions": "instructed_at",
    "ready": "ready_at",
    "demographics": "demographics_at",
    "feedback": "finished_at",
}
"""Column that says when a page was submitted."""


def jump(
    connection: Connection, trials: Mapping[str, int], session: Session, to: Jump, now: float
) -> SessionState:
    """Move a preview to a page or trial: all before it is taken as done, all from it on as open.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    trials
        Number of trials in each phase of the session's scenario.
    session
        The session; it is updated.
    to
        The page, or the phase and the trial.
    now
        Time of the server in seconds since 1970.

    Raises
    ------
    Refused
        The session is no preview, or the phase has no such trial.
    """
    if session.kind != "preview":
        raise Refused("bad_request", "Only a preview can go to any page.")
    if to.stage in PHASES and to.trial >= trials[to.stage]:
        raise Refused("bad_request", f"trial: the last one is {trials[to.stage] - 1}")
    target = STAGES.index(to.stage)
    values: dict[str, Any] = {"withdrawn_at": None, "closed_at": None}
    for page, column in _TIMES.items():
        values[column] = now if STAGES.index(page) < target else None  # type: ignore[arg-type]
    for phase in PHASES:
        position = STAGES.index(phase)  # type: ignore[arg-type]
        here = to.trial if position == target else 0
        values[f"answered_{phase}"] = trials[phase] if position < target else here
        open_from = values[f"answered_{phase}"]
        of_phase = (ANSWERS.c.session == session.session) & (ANSWERS.c.phase == phase)
        connection.execute(delete(ANSWERS).where(of_phase, ANSWERS.c.trial >= open_from))
    change_session(connection, session, **values)
    return state_of(session, trials)
