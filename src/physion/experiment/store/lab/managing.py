"""Changes that an experimenter makes while a study is served: pause recruitment, void a session."""

from __future__ import annotations

from sqlalchemy import Connection, insert, select, update

from physion.experiment.store.tables import PAUSES, SESSIONS


def is_paused(connection: Connection) -> bool:
    """Return whether recruitment is paused."""
    going = select(PAUSES.c.paused_at).where(PAUSES.c.resumed_at.is_(None)).limit(1)
    return connection.execute(going).first() is not None


def set_paused(connection: Connection, paused: bool, now: float) -> bool:
    """Pause or resume recruitment; return whether anything changed.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    paused
        Whether new people are refused from now on. Those who have entered can go on.
    now
        Time of the server in seconds since 1970.
    """
    if is_paused(connection) == paused:
        return False
    if paused:
        connection.execute(insert(PAUSES), {"paused_at": now, "resumed_at": None})
    else:
        going = PAUSES.c.resumed_at.is_(None)
        connection.execute(update(PAUSES).where(going).values(resumed_at=now))
    return True


def set_voided(connection: Connection, session: str, voided: bool, now: float) -> bool:
    """Void a session, or count it again; return whether anything changed.

    A void session is not exported, gives no completion code if it is not finished, and its place is
    given to another participant. Its answers are kept.

    Parameters
    ----------
    connection
        Connection of the writer, in a transaction.
    session
        Identifier of the session.
    voided
        Whether it is void from now on.
    now
        Time of the server in seconds since 1970.
    """
    columns = SESSIONS.c
    change = columns.voided_at.is_(None) if voided else columns.voided_at.is_not(None)
    values = {"voided_at": now if voided else None}
    changed = update(SESSIONS).where(columns.session == session, change).values(**values)
    return connection.execute(changed).rowcount > 0
