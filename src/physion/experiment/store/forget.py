"""Deleting the ids that recruiters gave, or all of a session, so that no byte of them stays.

What is left tells who a participant is only to who has the study's key and tries the id itself.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, Table, delete, select, update

from physion.errors import BadInputError, PhysionError
from physion.experiment.store.database import (
    check_version,
    close_writer,
    connect_writer,
    one_server,
    open_database,
)
from physion.experiment.store.tables import ANSWERS, EVENTS, RAW_IDS, SESSIONS, TOKENS

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

_EMPTIED = dict.fromkeys((
    "instructed_at", "ready_at", "demographics_at", "finished_at", "loaded_at_phase",
    "loaded_at_trial", "age", "gender", "education", "difficulty", "technical_problems", "feedback",
)) | {"answered_familiarization": 0, "answered_test": 0, "loads": 0, "device": {}}  # fmt: skip
"""What a forgotten session has in place of what its participant did and said."""


def forget(url: str, participants: Sequence[str] | None) -> int:
    """Delete the raw ids of these participants (hashes), or of all for None; how many there were.

    In SQLite the deleted bytes are overwritten in the file and its log. PostgreSQL rewrites the
    table; its own log and backups keep old bytes for as long as they are kept.

    Raises:
        BadInputError: a name that is no hash, or a participant without an id here; then nothing is
            deleted.
        PhysionError: the study is being served, or another program reads the file: stop it first.
    """
    _check(participants)
    return _alone(url, lambda connection: _delete(connection, participants), (RAW_IDS,))


def forget_sessions(url: str, references: Sequence[str]) -> int:
    """Delete all that the participants of these sessions did and said; how many sessions it was.

    Answers, events, tokens, demographics, free text and device go, and the raw id where no other
    session of the person is left. The row stays as one of somebody who withdrew, so that the same
    id cannot take part again; one that was finished gives its place back. The bytes go as in
    `forget`, whose errors these are, too; a reference that no session has is a `BadInputError`.
    """
    wanted = list(dict.fromkeys(reference.strip().upper() for reference in references))

    def work(connection: Connection) -> int:
        for reference in wanted:
            _forget_session(connection, reference)
        return len(wanted)

    return _alone(url, work, (RAW_IDS, ANSWERS, EVENTS, TOKENS, SESSIONS))


def _alone(url: str, work: Callable[[Connection], int], tables: Sequence[Table]) -> int:
    """Do something in one transaction while nobody serves, and overwrite what it deleted."""
    engine = open_database(url, must_exist=True)
    try:
        check_version(engine)
        with one_server(engine):
            connection = connect_writer(engine)
            try:
                with connection.begin():
                    count = work(connection)
            finally:
                close_writer(connection)
            _overwrite(engine, tables, compact=True)
    finally:
        engine.dispose()
    return count


async def forget_raw_ids(store: Store, participants: Sequence[str] | None = None) -> int:
    """The same while the study is served; participants who come again leave their ids again.

    The file is not made anew, which would keep answers waiting: SQLite is set to overwrite what it
    deletes (``secure_delete``).
    """
    _check(participants)
    count = await store.write(lambda connection: _delete(connection, participants))
    await asyncio.to_thread(_overwrite, store.engine, (RAW_IDS,), compact=False)
    return count


def _check(participants: Sequence[str] | None) -> None:
    for name in participants or ():
        if not re.fullmatch(r"[0-9a-f]{32}", name):
            raise BadInputError(f"{name[:40]!r} is no participant: give the 32 digits of an export")


def _delete(connection: Connection, participants: Sequence[str] | None) -> int:
    if participants is None:
        return connection.execute(delete(RAW_IDS)).rowcount
    names = list(dict.fromkeys(participants))
    for name in names:
        found = select(RAW_IDS.c.participant).where(RAW_IDS.c.participant == name)
        if connection.execute(found).first() is None:
            raise BadInputError(f"there is no id of participant {name}; nothing was deleted")
    for name in names:
        connection.execute(delete(RAW_IDS).where(RAW_IDS.c.participant == name))
    return len(names)


def _forget_session(connection: Connection, reference: str) -> None:
    columns = SESSIONS.c
    named = select(columns.session, columns.participant, columns.withdrawn_at)
    found = connection.execute(named.where(columns.reference == reference)).all()
    if len(found) != 1:
        raise BadInputError(
            f"{len(found) or 'no'} sessions have the reference {reference[:40]!r}; nothing was "
            "deleted"
        )
    session, participant, withdrawn_at = found[0]
    for table in (ANSWERS, EVENTS, TOKENS):
        connection.execute(delete(table).where(table.c.session == session))
    values = _EMPTIED | {"withdrawn_at": withdrawn_at or time.time()}
    connection.execute(update(SESSIONS).where(columns.session == session).values(**values))
    # Who declined, or was forgotten, has no device: nothing is left there for which an id is kept.
    devices = select(columns.device).where(columns.participant == participant)
    if not any(connection.execute(devices).scalars()):
        connection.execute(delete(RAW_IDS).where(RAW_IDS.c.participant == participant))


def _overwrite(engine: Engine, tables: Sequence[Table], *, compact: bool) -> None:
    """Have the deleted bytes gone: an empty log, and with ``compact`` a file made anew."""
    connection = engine.raw_connection()
    try:
        driver: Any = connection.driver_connection
        if engine.dialect.name == "postgresql":
            driver.autocommit = True
            for table in tables:
                driver.execute(f"VACUUM FULL {table.name}")
            return
        if compact:
            driver.execute("VACUUM")
        _empty_log(driver)
    finally:
        connection.invalidate()
        connection.close()


def _empty_log(driver: Any) -> None:
    busy = driver.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]
    if busy:
        raise PhysionError(
            "all is deleted, but another program reads the database and keeps the bytes: "
            "close it, and say physion experiment forget again"
        )
