"""Log of what experimenters did: who paused, voided, deleted, exported, and when."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import Connection, func, insert, select

from physion.experiment.store.tables import ACTIONS

Action = Literal[
    "logged in",
    "paused recruitment",
    "resumed recruitment",
    "made a session void",
    "counted a session again",
    "deleted a session",
    "deleted ids",
    "opened the payments",
    "downloaded the payments",
    "exported",
]

PAGE = 100
"""Actions on one page of the log."""


@dataclass(frozen=True)
class LogPage:
    """One page of the log, latest first; ``lines`` have the columns of the table ``actions``."""

    lines: tuple[tuple[float, str, str, str, str], ...]
    page: int
    pages: int


def note_action(
    connection: Connection, action: Action, subject: str = "", account: str = "", role: str = ""
) -> None:
    """Add an action to the log, in the transaction of ``connection``.

    ``subject``: what it was about, cut after 200 characters, never an id; ``account`` and ``role``
    are empty for the command line.
    """
    connection.execute(
        insert(ACTIONS),
        {
            "at": time.time(),
            "account": account,
            "role": role,
            "action": action,
            "subject": subject[:200],
        },
    )


def read_log(connection: Connection, page: int) -> LogPage:
    """Return a page of the log; a number beyond the last page gives the last page."""
    total = connection.scalar(select(func.count()).select_from(ACTIONS)) or 0
    pages = max(1, -(-total // PAGE))
    page = min(max(1, page), pages)
    columns = ACTIONS.c
    rows = connection.execute(
        select(columns.at, columns.account, columns.role, columns.action, columns.subject)
        .order_by(columns.action_number.desc())
        .limit(PAGE)
        .offset((page - 1) * PAGE)
    )
    return LogPage(tuple((r.at, r.account, r.role, r.action, r.subject) for r in rows), page, pages)
