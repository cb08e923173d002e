"""Open a study's database: SQLite in the study folder, or PostgreSQL.

Both are configured so that a commit is on disk when it returns: SQLite with its write-ahead log and
``synchronous=FULL``, PostgreSQL with ``synchronous_commit=on``. Only one server at a time writes.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, text
from sqlalchemy.engine import URL, ExceptionContext, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError

from physion.core.errors import BadInputError, PhysionError
from physion.core.files import folder_lock
from physion.core.seeds import stable_hash

DATABASE_FILE = "responses.sqlite"
BUSY_MS = 10_000
"""Time in milliseconds that SQLite waits for a lock of another process, such as a backup."""
MIGRATIONS = Path(__file__).parent / "migrations"
_LOCK = stable_hash("physion experiment: one server") >> 65
_WRITES = "physion_writes"


def sqlite_url(folder: Path) -> str:
    """Return the URL of the default database of a study folder."""
    return f"sqlite:///{folder.resolve() / DATABASE_FILE}"


def open_database(url: str, *, must_exist: bool = False) -> Engine:
    """Return an engine for ``sqlite:///FILE`` or ``postgresql://...``, without connecting yet.

    Error messages contain statements without their values, so that no participant's id reaches a
    log. A new SQLite file is readable by its owner only.

    Raises
    ------
    BadInputError
        The URL is of another kind, or with ``must_exist`` the SQLite file does not exist.
    """
    address = _parse_url(url)
    if address.get_backend_name() == "postgresql":
        return _open_postgresql(address)
    assert address.database is not None
    path = Path(address.database)
    if must_exist and not path.exists():
        raise BadInputError(f"there is no database {path}; has the study been served yet?")
    return _open_sqlite(address, path)


def _parse_url(url: str) -> URL:
    """Parse a database URL and choose its driver."""
    try:
        address = make_url(url)
        backend = address.get_backend_name()
    except (ArgumentError, ValueError) as error:
        raise BadInputError("a database URL is sqlite:///FILE or postgresql://...") from error
    if backend in ("postgresql", "postgres"):
        return address.set(drivername="postgresql+psycopg")
    if backend != "sqlite" or address.database in (None, "", ":memory:"):
        raise BadInputError("a database URL is sqlite:///FILE or postgresql://...")
    return address.set(drivername="sqlite+pysqlite")


def _open_sqlite(address: URL, path: Path) -> Engine:
    """Return an engine for an SQLite file, which is created if it is missing."""
    if not path.parent.is_dir():
        raise BadInputError(f"there is no folder {path.parent} for the database")
    # SQLite creates its log files with the permissions of the database file.
    os.close(os.open(path, os.O_CREAT | os.O_RDWR | getattr(os, "O_NOFOLLOW", 0), 0o600))
    engine = create_engine(address, hide_parameters=True, connect_args={"timeout": BUSY_MS / 1000})

    @event.listens_for(engine, "connect")
    def prepare(connection: Any, _: Any) -> None:
        # We begin transactions ourselves: the driver begins them late, and none for reading.
        connection.isolation_level = None
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "fullfsync=ON", "foreign_keys=ON",
                       "secure_delete=ON", f"busy_timeout={BUSY_MS}"):  # fmt: skip
            connection.execute(f"PRAGMA {pragma}").close()

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        writes = connection.get_execution_options().get(_WRITES, False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    return engine


def _open_postgresql(address: URL) -> Engine:
    """Return an engine for a PostgreSQL database."""
    # Test pooled connections before use: a restart of the database closes them.
    engine = create_engine(
        address,
        hide_parameters=True,
        pool_pre_ping=True,
        pool_size=8,
        connect_args={"connect_timeout": 10},
    )

    @event.listens_for(engine, "connect")
    def prepare(connection: Any, _: Any) -> None:
        connection.autocommit = True
        connection.execute("SET synchronous_commit = on")
        connection.execute("SET timezone = 'UTC'")
        connection.autocommit = False

    @event.listens_for(engine, "handle_error")
    def shorten(context: ExceptionContext) -> None:
        # Lines after the first contain the values of whole rows.
        for error in (context.original_exception, context.sqlalchemy_exception):
            if error is not None and error.args:
                error.args = (str(error.args[0]).partition("\n")[0], *error.args[1:])

    return engine


def connect_writer(engine: Engine) -> Connection:
    """Open the single writing connection; on PostgreSQL it also holds the server lock.

    Raises
    ------
    PhysionError
        Another server uses the database.
    """
    connection = engine.connect().execution_options(**{_WRITES: True})
    if engine.dialect.name != "postgresql":
        return connection
    try:
        free = connection.scalar(text("SELECT pg_try_advisory_lock(:key)"), {"key": _LOCK})
        connection.commit()
    except BaseException:
        connection.invalidate()
        connection.close()
        raise
    if not free:
        connection.close()
        raise PhysionError("another server uses this database; stop it first")
    return connection


def close_writer(connection: Connection) -> None:
    """Close the connection without returning it to the pool, which releases its server lock."""
    with contextlib.suppress(SQLAlchemyError):
        connection.invalidate()
    connection.close()


@contextlib.contextmanager
def server_lock(engine: Engine) -> Iterator[None]:
    """Hold the lock that keeps other servers from the database.

    On PostgreSQL this does nothing, since the connection of `connect_writer` holds the lock.

    Raises
    ------
    PhysionError
        Another process holds the lock.
    """
    if engine.dialect.name == "postgresql":
        yield
        return
    assert engine.url.database is not None
    folder = Path(engine.url.database).resolve().parent
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(folder_lock(folder))
        except PhysionError as error:
            raise PhysionError(
                f"another process writes into {folder}; stop the server of this study first, or "
                "wait until the other process has finished"
            ) from error
        yield


def _load_migrations() -> tuple[Any, Any]:
    """Return Alembic's configuration and directory of migration scripts."""
    from alembic.config import Config
    from alembic.script import ScriptDirectory

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    return config, ScriptDirectory.from_config(config)


def _read_version(connection: Connection) -> str | None:
    """Return the schema version of the database, None if it is empty."""
    from alembic.runtime.migration import MigrationContext

    return MigrationContext.configure(connection).get_current_revision()


def upgrade(engine: Engine) -> None:
    """Migrate the tables to the current version, in one transaction; create missing tables.

    Raises
    ------
    BadInputError
        A newer version of this package wrote the database.
    PhysionError
        The database does not answer.
    """
    from alembic import command

    config, script = _load_migrations()
    try:
        options = {_WRITES: True}
        with engine.execution_options(**options).begin() as connection:
            version = _read_version(connection)
            if version == script.get_current_head():
                return
            _refuse_unknown(engine, script, version)
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
    except DBAPIError as error:
        raise _unreachable(engine, error) from error


def check_version(engine: Engine) -> None:
    """Raise `BadInputError` unless the tables have the current version; change nothing."""
    _, script = _load_migrations()
    try:
        with engine.connect() as connection:
            version = _read_version(connection)
    except SQLAlchemyError as error:
        raise _unreachable(engine, error) from error
    _refuse_unknown(engine, script, version)
    if version != script.get_current_head():
        raise BadInputError(
            f"{_display_url(engine)} lacks the tables of the current version; serve the study once "
            "to create them"
        )


def _refuse_unknown(engine: Engine, script: Any, version: str | None) -> None:
    """Raise `BadInputError` if the schema version is newer than this package."""
    if version is not None and version not in {each.revision for each in script.walk_revisions()}:
        raise BadInputError(
            f"{_display_url(engine)} was written by a newer version of this package "
            f"(tables {version[:40]}); install that version"
        )


def _unreachable(engine: Engine, error: SQLAlchemyError) -> PhysionError:
    """Return the error for a database that does not answer."""
    reason = str(getattr(error, "orig", error)).splitlines()
    return PhysionError(
        f"{_display_url(engine)} does not answer: {reason[0] if reason else 'no reason given'}"
    )


def _display_url(engine: Engine) -> str:
    """Return the URL of the database without its password."""
    return engine.url.render_as_string(hide_password=True)
