"""Delete recruiters' ids, or all data of a session, so that the bytes cannot be recovered.

The remaining keyed hash identifies a participant only to someone who has the study's key and the
id itself.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, Table, delete, select, update

from physion.core.errors import BadInputError, PhysionError
from physion.experiment.store.database import (
    check_version,
    close_writer,
    connect_writer,
    open_database,
    server_lock,
)
from physion.experiment.store.lab.actions import note_action
from physion.experiment.store.tables import (
    ANSWERS,
    EVENTS,
    PRACTICE_REPEATS,
    RAW_IDS,
    SESSIONS,
    SHOWINGS,
    TOKENS,
)

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

_OF_SESSION = (ANSWERS, PRACTICE_REPEATS, SHOWINGS, EVENTS, TOKENS)
"""Tables whose rows of a forgotten session are deleted."""
_EMPTIED = dict.fromkeys((
    "instructed_at", "comprehended_at", "screened_out_at", "screened_out_by", "failed_checks",
    "ready_at", "demographics_at", "questions_at", "questions_study", "own_answers", "finished_at",
    "loaded_at_phase", "loaded_at_trial", "block_at", "browser", "progressed_at", "next_from",
    "implausible", "age", "gender", "education", "difficulty", "technical_problems", "feedback",
)) | {"answered_familiarization": 0, "answered_test": 0, "block": 0, "comprehension_attempts": 0,
      "practice_repeats": 0, "attention_failed": 0, "fast_answers": 0, "unfetched": 0,
      "replayed": 0, "loads": 0, "device": {}}  # fmt: skip
"""Column values that replace the data of a forgotten session."""


def forget(url: str, participants: Sequence[str] | None) -> int:
    """Delete the raw ids of these participants (hashes; None for all) and return their number.

    In SQLite the deleted bytes are overwritten in the file and its log. PostgreSQL rewrites the
    table; its write-ahead log and backups keep the old bytes for as long as they exist.

    Raises
    ------
    BadInputError
        A name is not a participant hash, or a participant has no id; then nothing is deleted.
    PhysionError
        The study is being served, or another program reads the database.
    """
    _check_participants(participants)

    def work(connection: Connection) -> int:
        count = _delete_raw_ids(connection, participants)
        note_action(connection, "deleted ids", f"{count}")
        return count

    return _run_exclusively(url, work, (RAW_IDS,))


def forget_sessions(url: str, references: Sequence[str]) -> int:
    """Delete all data of the sessions with these references and return the number of sessions.

    Deleted are answers, events, tokens, demographics, free text and device, and the raw id if the
    person has no other session. The row of the session stays, marked as withdrawn, so that the same
    id cannot take part again; a finished session no longer counts as a participant. Bytes are
    overwritten as in `forget`.

    Raises
    ------
    BadInputError
        No session has one of the references; then nothing is deleted.
    PhysionError
        The study is being served, or another program reads the database.
    """
    wanted = list(dict.fromkeys(reference.strip().upper() for reference in references))

    now = time.time()

    def work(connection: Connection) -> int:
        for reference in wanted:
            _forget_session(connection, reference, now)
            note_action(connection, "deleted a session", reference)
        return len(wanted)

    return _run_exclusively(url, work, (RAW_IDS, *_OF_SESSION, SESSIONS))


def _run_exclusively(url: str, work: Callable[[Connection], int], tables: Sequence[Table]) -> int:
    """Run ``work`` in one transaction while no server runs, then vacuum ``tables``.

    Vacuuming overwrites the deleted rows, so that they cannot be recovered from the file.
    """
    engine = open_database(url, must_exist=True)
    try:
        check_version(engine)
        with server_lock(engine):
            connection = connect_writer(engine)
            try:
                with connection.begin():
                    count = work(connection)
            finally:
                close_writer(connection)
            _erase_deleted_bytes(engine, tables, compact=True)
    finally:
        engine.dispose()
    return count


async def forget_raw_ids(store: Store, participants: Sequence[str] | None = None) -> int:
    """Delete raw ids as `forget` does, while the study is served.

    The file is not vacuumed, which would delay answers: SQLite overwrites deleted rows by itself
    (``secure_delete``). Participants who enter again leave their ids again.
    """
    _check_participants(participants)
    count = await store.write(lambda connection: _delete_raw_ids(connection, participants))
    await asyncio.to_thread(_erase_deleted_bytes, store.engine, (RAW_IDS,), compact=False)
    return count


async def forget_session(store: Store, reference: str) -> None:
    """Delete all data of one session as `forget_sessions` does, while the study is served.

    In PostgreSQL only the raw ids are rewritten, which is quick; the other deleted rows are
    overwritten when the database vacuums by itself.
    """
    now = time.time()
    await store.write(lambda connection: _forget_session(connection, reference, now))
    await asyncio.to_thread(_erase_deleted_bytes, store.engine, (RAW_IDS,), compact=False)


def _check_participants(participants: Sequence[str] | None) -> None:
    """Raise `BadInputError` unless all names are participant hashes."""
    for name in participants or ():
        if not re.fullmatch(r"[0-9a-f]{32}", name):
            raise BadInputError(
                f"{name[:40]!r} is not a participant; give the 32 hexadecimal digits of the export"
            )


def _delete_raw_ids(connection: Connection, participants: Sequence[str] | None) -> int:
    """Delete raw ids and return their number."""
    if participants is None:
        return connection.execute(delete(RAW_IDS)).rowcount
    names = list(dict.fromkeys(participants))
    for name in names:
        known = select(RAW_IDS.c.participant).where(RAW_IDS.c.participant == name)
        if connection.execute(known).first() is None:
            raise BadInputError(f"there is no id of participant {name}; nothing was deleted")
    for name in names:
        connection.execute(delete(RAW_IDS).where(RAW_IDS.c.participant == name))
    return len(names)


def _forget_session(connection: Connection, reference: str, now: float) -> None:
    """Delete the data of the session with this reference."""
    columns = SESSIONS.c
    query = select(columns.session, columns.participant, columns.withdrawn_at)
    rows = connection.execute(query.where(columns.reference == reference)).all()
    if len(rows) != 1:
        raise BadInputError(
            f"{len(rows) or 'no'} sessions have the reference {reference[:40]!r}; nothing was "
            "deleted"
        )
    session, participant, withdrawn_at = rows[0]
    for table in _OF_SESSION:
        connection.execute(delete(table).where(table.c.session == session))
    values = _EMPTIED | {"withdrawn_at": withdrawn_at or now, "closed_at": now}
    connection.execute(update(SESSIONS).where(columns.session == session).values(**values))
    # Declined and forgotten sessions have no device; if all are such, the id is not needed.
    devices = select(columns.device).where(columns.participant == participant)
    if not any(connection.execute(devices).scalars()):
        connection.execute(delete(RAW_IDS).where(RAW_IDS.c.participant == participant))


def _erase_deleted_bytes(engine: Engine, tables: Sequence[Table], *, compact: bool) -> None:
    """Remove deleted bytes from disk: empty the log and, with ``compact``, vacuum the file."""
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
    """Truncate SQLite's write-ahead log."""
    busy = driver.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]
    if busy:
        raise PhysionError(
            "the data are deleted, but another program reads the database and keeps the old bytes; "
            "close that program and run physion experiment forget again"
        )
