"""Attempts at the comprehension check: the next page after each, and the end after too many."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, insert

from physion.experiment.store.sessions import Session
from physion.experiment.store.tables import EVENTS
from physion.experiment.study.study import Study

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
