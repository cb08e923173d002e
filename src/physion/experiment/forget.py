"""Deleting the ids that recruiters gave, so that no byte of them stays in the database.

What is left tells who a participant is only to who has the study's key and tries the id itself.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, delete, select

from physion.errors import BadInputError, PhysionError
from physion.experiment.database import (
    check_version,
    close_writer,
    connect_writer,
    one_server,
    open_database,
)
from physion.experiment.tables import RAW_IDS

if TYPE_CHECKING:
    from physion.experiment.store import Store


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
    engine = open_database(url, must_exist=True)
    try:
        check_version(engine)
        with one_server(engine):
            connection = connect_writer(engine)
            try:
                with connection.begin():
                    count = _delete(connection, participants)
            finally:
                close_writer(connection)
            _overwrite(engine, compact=True)
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
    await asyncio.to_thread(_overwrite, store.engine, compact=False)
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


def _overwrite(engine: Engine, *, compact: bool) -> None:
    """Have the deleted bytes gone: an empty log, and with ``compact`` a file made anew."""
    connection = engine.raw_connection()
    try:
        driver: Any = connection.driver_connection
        if engine.dialect.name == "postgresql":
            driver.autocommit = True
            driver.execute("VACUUM FULL raw_ids")
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
            "the ids are deleted, but another program reads the database and keeps their bytes: "
            "close it, and say physion experiment forget again"
        )
