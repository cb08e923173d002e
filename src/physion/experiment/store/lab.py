"""What a lab does with a stored study: pause it, void sessions, back it up, and forget people.

Forgetting deletes recruiters' ids, or all data of a session, so that the bytes cannot be recovered
from the file. The remaining keyed hash identifies a participant only to someone who has the study's
key and the id itself.
"""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import sqlite3
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, delete, func, insert, select, update

from physion.core.errors import BadInputError, PhysionError
from physion.core.files import sync_folder
from physion.experiment.store.database import (
    ANSWERS,
    DATABASE_FILE,
    EVENTS,
    PAUSES,
    PRACTICE_REPEATS,
    RAW_IDS,
    SESSIONS,
    SHOWINGS,
    TOKENS,
    Writer,
    open_database,
    server_lock,
)
from physion.experiment.store.entry import is_paused
from physion.experiment.study.identity import SECRET_FILE
from physion.experiment.study.stimuli import MEDIA_FOLDER, STIMULI_FILE
from physion.experiment.study.study import STUDY_FILE
from physion.experiment.study.texts import TEXTS_FOLDER

if TYPE_CHECKING:
    from physion.experiment.store.store import Store

_OF_SESSION = (ANSWERS, PRACTICE_REPEATS, SHOWINGS, EVENTS, TOKENS)
"""Tables whose rows of a forgotten session are deleted."""
_KEPT = (
    "session", "participant", "scenario", "kind", "source", "study", "reference", "order_seed",
    "order_number", "buttons", "language", "condition", "started_at", "last_seen",
    "consent_version", "consented_at", "voided_at",
)  # fmt: skip
"""Columns of a forgotten session that stay, so that the same person cannot take part again."""
_EMPTIED: dict[str, Any] = {
    column.name: 0 if column.default else None for column in SESSIONS.c if column.name not in _KEPT
} | {"device": {}}
"""Column values that replace the data of a forgotten session."""


def set_paused(connection: Connection, paused: bool, now: float) -> bool:
    """Pause or resume recruitment; return whether anything changed.

    While it is paused, new people are refused. Those who have entered can continue.
    """
    if is_paused(connection) == paused:
        return False
    if paused:
        connection.execute(insert(PAUSES), {"paused_at": now, "resumed_at": None})
    else:
        going = PAUSES.c.resumed_at.is_(None)
        connection.execute(update(PAUSES).where(going).values(resumed_at=now))
    return True


def set_voided(connection: Connection, session: str, voided: bool, now: float) -> str | None:
    """Void a session, or count it again; return its reference, None if there is no such session.

    A void session is not exported, gives no completion code if it is not finished, and its place is
    given to another participant. Its answers are kept.
    """
    columns, own = SESSIONS.c, SESSIONS.c.session == session
    at = func.coalesce(columns.voided_at, now) if voided else None
    connection.execute(update(SESSIONS).where(own).values(voided_at=at))
    return connection.scalar(select(columns.reference).where(own))


def back_up(study: Path, out: Path, *, media: bool = False, secret: bool = False) -> Path:
    """Copy database, settings, texts and stimuli into a new folder below ``out``; return it.

    The folder is called by the time in UTC and complete or absent; only its owner may read it. A
    server may be running. The copy is checked for damage.

    Parameters
    ----------
    study
        The study folder.
    out
        Folder of all backups of the study; made if it is missing.
    media
        Whether to copy the movies and maps too, which never change.
    secret
        Whether to copy ``secret.json``, with which ids can be guessed from their hashes.

    Raises
    ------
    BadInputError
        There is no such study or database, or a backup was made in the same second.
    PhysionError
        The database cannot be read, or the copy is damaged.
    """
    if not (study / STUDY_FILE).is_file():
        raise BadInputError(f"{study} is not a study folder: it has no {STUDY_FILE}")
    target = out / datetime.now(UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
    if target.exists():
        raise BadInputError(f"{target} is there already; wait a second and try again")
    open_database(study).dispose()  # refuses a database of another version
    part = out / f".{target.name}.part"
    out.mkdir(parents=True, exist_ok=True)
    part.mkdir(mode=0o700)
    try:
        _copy_database(study / DATABASE_FILE, part / DATABASE_FILE)
        names = [STUDY_FILE, STIMULI_FILE, TEXTS_FOLDER]
        names += [MEDIA_FOLDER] if media else []
        names += [SECRET_FILE] if secret else []
        for name in names:
            _copy(study / name, part / name)
        part.rename(target)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    sync_folder(out)
    return target


def _copy_database(path: Path, copy: Path) -> None:
    """Copy a database with the content of its write-ahead log, and check the copy."""
    os.close(os.open(copy, os.O_CREAT | os.O_EXCL, 0o600))
    try:
        with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(copy)) as target:
            source.backup(target)
            # One file without a log, so that it can be moved.
            target.execute("PRAGMA journal_mode=DELETE")
            (found,) = target.execute("PRAGMA integrity_check").fetchone()
    except sqlite3.Error as error:
        raise PhysionError(f"{path} could not be copied: {error}") from error
    if found != "ok":
        raise PhysionError(f"the copy of {path} is damaged: {found}; check the disk")
    _sync(copy)


def _copy(source: Path, copy: Path) -> None:
    """Copy a file or folder, with its permissions, and sync it."""
    if source.is_dir():
        shutil.copytree(source, copy, symlinks=True)
    else:
        shutil.copy2(source, copy, follow_symlinks=False)
    for path in [copy, *copy.rglob("*")] if copy.is_dir() else [copy]:
        if path.is_file() and not path.is_symlink():
            _sync(path)


def _sync(path: Path) -> None:
    """Flush a file to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def forget(folder: Path, participants: Sequence[str] | None) -> int:
    """Delete the raw ids of these participants (hashes; None for all) and return their number.

    The deleted bytes are overwritten in the file and its log.

    Raises
    ------
    BadInputError
        A name is not a participant hash, or a participant has no id; then nothing is deleted.
    PhysionError
        The study is being served, or another program reads the database.
    """
    _check_participants(participants)
    return _run_exclusively(folder, lambda connection: _delete_raw_ids(connection, participants))


def forget_sessions(folder: Path, references: Sequence[str]) -> int:
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
        return len(wanted)

    return _run_exclusively(folder, work)


def _run_exclusively(folder: Path, work: Callable[[Connection], int]) -> int:
    """Run ``work`` in one transaction while no server runs, then vacuum the file.

    Vacuuming overwrites the deleted rows, so that they cannot be recovered from the file.
    """
    engine = open_database(folder)
    try:
        with server_lock(folder):
            writer = Writer(engine)
            try:
                count = writer.submit(work).result()
            finally:
                writer.close()
            _erase_deleted_bytes(engine, compact=True)
    finally:
        engine.dispose()
    return count


async def forget_raw_ids(store: Store) -> int:
    """Delete all raw ids as `forget` does, while the study is served.

    The file is not vacuumed, which would delay answers: SQLite overwrites deleted rows by itself
    (``secure_delete``). Participants who enter again leave their ids again.
    """
    count = await store.write(lambda connection: _delete_raw_ids(connection, None))
    await asyncio.to_thread(_erase_deleted_bytes, store.engine, compact=False)
    return count


async def forget_session(store: Store, session: str) -> str:
    """Delete all data of one session as `forget_sessions` does, while the study is served.

    Returns the reference of the session.
    """
    now = time.time()

    def work(connection: Connection) -> str:
        reference = select(SESSIONS.c.reference).where(SESSIONS.c.session == session)
        return _forget_session(connection, connection.scalar(reference) or session, now)

    reference = await store.write(work)
    await asyncio.to_thread(_erase_deleted_bytes, store.engine, compact=False)
    return reference


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


def _forget_session(connection: Connection, reference: str, now: float) -> str:
    """Delete the data of the session with this reference, and return the reference."""
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
    return reference


def _erase_deleted_bytes(engine: Engine, *, compact: bool) -> None:
    """Remove deleted bytes from disk: empty the log and, with ``compact``, vacuum the file."""
    connection = engine.raw_connection()
    try:
        driver: Any = connection.driver_connection
        if compact:
            driver.execute("VACUUM")
        busy = driver.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]
    finally:
        connection.invalidate()
        connection.close()
    if busy:
        raise PhysionError(
            "the data are deleted, but another program reads the database and keeps the old bytes; "
            "close that program and run physion experiment forget again"
        )
