"""Opening a study's database: SQLite in the study folder or PostgreSQL, safe against crashes.

Both are opened so that a commit that returned is on the disk: SQLite with its write-ahead log and
``synchronous=FULL``, PostgreSQL with ``synchronous_commit=on``. One server at a time writes.
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

from physion.atomic import folder_lock
from physion.errors import BadInputError, PhysionError
from physion.seeds import stable_hash

DATABASE_FILE = "responses.sqlite"
BUSY_MS = 10_000
"""How long SQLite waits for another process's write, such as a copy being made."""
MIGRATIONS = Path(__file__).parent / "migrations"
_LOCK = stable_hash("physion experiment: one server") >> 65
_WRITES = "physion_writes"


def sqlite_url(folder: Path) -> str:
    """The database that a study has where no other is given."""
    return f"sqlite:///{folder.resolve() / DATABASE_FILE}"


def open_database(url: str, *, must_exist: bool = False) -> Engine:
    """An engine for ``sqlite:///FILE`` or ``postgresql://...``; nothing is asked of it yet.

    Errors tell statements without their values, for ids of people must reach no log. A new SQLite
    file is readable by its owner alone. With ``must_exist`` a missing one is refused with
    `BadInputError`, as is any other kind of address.
    """
    address = _address(url)
    if address.get_backend_name() == "postgresql":
        return _open_postgresql(address)
    assert address.database is not None
    path = Path(address.database)
    if must_exist and not path.exists():
        raise BadInputError(f"there is no database {path}; was the study served yet?")
    return _open_sqlite(address, path)


def _address(url: str) -> URL:
    try:
        address = make_url(url)
        backend = address.get_backend_name()
    except (ArgumentError, ValueError) as error:
        raise BadInputError("a database is sqlite:///FILE or postgresql://...") from error
    if backend in ("postgresql", "postgres"):
        return address.set(drivername="postgresql+psycopg")
    if backend != "sqlite" or address.database in (None, "", ":memory:"):
        raise BadInputError("a database is sqlite:///FILE or postgresql://...")
    return address.set(drivername="sqlite+pysqlite")


def _open_sqlite(address: URL, path: Path) -> Engine:
    if not path.parent.is_dir():
        raise BadInputError(f"there is no folder {path.parent} for the database")
    # SQLite gives its log files the mode of the database.
    os.close(os.open(path, os.O_CREAT | os.O_RDWR | getattr(os, "O_NOFOLLOW", 0), 0o600))
    engine = create_engine(address, hide_parameters=True, connect_args={"timeout": BUSY_MS / 1000})

    @event.listens_for(engine, "connect")
    def prepare(connection: Any, _: Any) -> None:
        # Transactions are begun by us: the driver would begin them too late, and not for reading.
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
    # A pooled connection may have died with a restart of the database: look before use.
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
        # PostgreSQL's further lines hold whole rows.
        for error in (context.original_exception, context.sqlalchemy_exception):
            if error is not None and error.args:
                error.args = (str(error.args[0]).partition("\n")[0], *error.args[1:])

    return engine


def connect_writer(engine: Engine) -> Connection:
    """The one connection that writes. On PostgreSQL it also keeps other servers away.

    Raises `PhysionError` where another server has the database.
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
        raise PhysionError("another server writes into this database; stop it first")
    return connection


def close_writer(connection: Connection) -> None:
    """Close the connection for good: a lock of PostgreSQL ends with it."""
    with contextlib.suppress(SQLAlchemyError):
        connection.invalidate()
    connection.close()


@contextlib.contextmanager
def one_server(engine: Engine) -> Iterator[None]:
    """Have the database to oneself among servers; `PhysionError` where another has it.

    On PostgreSQL the lock lies on the connection of `connect_writer`, and nothing is done here.
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
                f"another process writes into {folder}: stop the server that serves this study "
                "first, or wait for what else is at work there"
            ) from error
        yield


def _script() -> tuple[Any, Any]:
    from alembic.config import Config
    from alembic.script import ScriptDirectory

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    return config, ScriptDirectory.from_config(config)


def _version(connection: Connection) -> str | None:
    from alembic.runtime.migration import MigrationContext

    return MigrationContext.configure(connection).get_current_revision()


def upgrade(engine: Engine) -> None:
    """Bring the tables to the present version, all or nothing; an empty database gets them all.

    Raises `BadInputError` for a database of a newer version of this package, and `PhysionError`
    where the database does not answer.
    """
    from alembic import command

    config, script = _script()
    try:
        options = {_WRITES: True}
        with engine.execution_options(**options).begin() as connection:
            version = _version(connection)
            if version == script.get_current_head():
                return
            _refuse_unknown(engine, script, version)
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
    except DBAPIError as error:
        raise _no_answer(engine, error) from error


def check_version(engine: Engine) -> None:
    """`BadInputError` unless the tables have the present version; nothing is changed."""
    _, script = _script()
    try:
        with engine.connect() as connection:
            version = _version(connection)
    except SQLAlchemyError as error:
        raise _no_answer(engine, error) from error
    _refuse_unknown(engine, script, version)
    if version != script.get_current_head():
        raise BadInputError(
            f"{_shown(engine)} has no tables of the present version; serve the study once, "
            "which brings them"
        )


def _refuse_unknown(engine: Engine, script: Any, version: str | None) -> None:
    if version is not None and version not in {each.revision for each in script.walk_revisions()}:
        raise BadInputError(
            f"{_shown(engine)} was written by a newer version of this package "
            f"(tables {version[:40]}); install that version"
        )


def _no_answer(engine: Engine, error: SQLAlchemyError) -> PhysionError:
    reason = str(getattr(error, "orig", error)).splitlines()
    return PhysionError(f"{_shown(engine)} does not answer: {reason[0] if reason else 'no reason'}")


def _shown(engine: Engine) -> str:
    return engine.url.render_as_string(hide_password=True)
