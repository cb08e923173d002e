"""Back up a study while it is served: a consistent copy of its database, settings and texts."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import Engine

from physion.core.errors import BadInputError, PhysionError
from physion.core.files import sync_folder
from physion.experiment.store.database import (
    DATABASE_FILE,
    check_version,
    open_database,
    sqlite_url,
)
from physion.experiment.study.identity import SECRET_FILE
from physion.experiment.study.stimuli import MEDIA_FOLDER, STIMULI_FILE
from physion.experiment.study.study import STUDY_FILE
from physion.experiment.study.texts import TEXTS_FOLDER

DUMP_FILE = "responses.dump"
"""Copy of a PostgreSQL database, for ``pg_restore``."""


def back_up(
    study: Path, out: Path, url: str | None = None, *, media: bool = False, secret: bool = False
) -> Path:
    """Copy database, settings, texts and stimuli into a new folder below ``out``; return it.

    The folder is called by the time in UTC and complete or absent; only its owner may read it. A
    server may be running. A copy of SQLite is checked for damage.

    Parameters
    ----------
    study
        The study folder.
    out
        Folder of all backups of the study; made if it is missing.
    url
        URL of the database; SQLite in the study folder if None.
    media
        Whether to copy the movies and maps too, which never change.
    secret
        Whether to copy ``secret.json``, with which ids can be guessed from their hashes.

    Raises
    ------
    BadInputError
        There is no such study or database, or a backup was made in the same second.
    PhysionError
        The database does not answer, the copy is damaged, or ``pg_dump`` is missing or fails.
    """
    if not (study / STUDY_FILE).is_file():
        raise BadInputError(f"{study} is no study folder: it has no {STUDY_FILE}")
    target = out / datetime.now(UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
    if target.exists():
        raise BadInputError(f"{target} is there already; wait a second and try again")
    engine = open_database(url or sqlite_url(study), must_exist=True)
    part = out / f".{target.name}.part"
    out.mkdir(parents=True, exist_ok=True)
    part.mkdir(mode=0o700)
    try:
        check_version(engine)
        if engine.dialect.name == "postgresql":
            _dump_postgresql(engine, part / DUMP_FILE)
        else:
            assert engine.url.database is not None
            _copy_sqlite(Path(engine.url.database), part / DATABASE_FILE)
        names = [STUDY_FILE, STIMULI_FILE, TEXTS_FOLDER]
        names += [MEDIA_FOLDER] if media else []
        names += [SECRET_FILE] if secret else []
        for name in names:
            _copy(study / name, part / name)
        part.rename(target)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    finally:
        engine.dispose()
    sync_folder(out)
    return target


def _copy_sqlite(path: Path, copy: Path) -> None:
    """Copy an SQLite database with the content of its write-ahead log, and check the copy."""
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


def _dump_postgresql(engine: Engine, copy: Path) -> None:
    """Write a PostgreSQL database in the custom format of ``pg_dump``."""
    address = engine.url
    given = {
        "--host": address.host or address.query.get("host"),
        "--port": address.port or address.query.get("port"),
        "--username": address.username,
        "--dbname": address.database,
    }
    options = [f"{name}={value}" for name, value in given.items() if value]
    # Not as an option, where other users of the machine could read it.
    password = {"PGPASSWORD": address.password} if address.password else {}
    os.close(os.open(copy, os.O_CREAT | os.O_EXCL, 0o600))
    command = ["pg_dump", "--format=custom", f"--file={copy}", "--no-password", *options]
    try:
        done = subprocess.run(
            command, env={**os.environ, **password}, capture_output=True, text=True, check=False
        )
    except FileNotFoundError as error:
        raise PhysionError(
            "pg_dump is missing: install the client programs of PostgreSQL"
        ) from error
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        raise PhysionError(f"pg_dump failed: {lines[0] if lines else done.returncode}")
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
