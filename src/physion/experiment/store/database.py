"""Tables of a study's database, the same for SQLite and PostgreSQL.

Times are seconds since 1970 (UTC) of the server's clock. Values that can be computed (order of
trials, correctness) are not stored; labels are in the study folder only.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, InvalidStateError
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    Connection,
    Engine,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
    create_engine,
    event,
    text,
)
from sqlalchemy.engine import URL, ExceptionContext, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError

from physion.core.errors import BadInputError, PhysionError
from physion.core.files import folder_lock
from physion.core.seeds import stable_hash
from physion.experiment.protocol import Refused

METADATA = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)

STUDIES = Table(
    "studies",
    METADATA,
    Column("digest", String(64), primary_key=True),
    Column("name", String(200), nullable=False),
    Column("version", String(200), nullable=False),
    Column("stimuli_digest", String(64), nullable=False),
    Column("settings", JSON, nullable=False),
    Column("first_served", Float, nullable=False),
)
"""Each version of the study folder that was served; ``settings`` is the folder without media."""

PARTICIPANTS = Table(
    "participants",
    METADATA,
    Column("participant", String(32), primary_key=True),
    Column("first_seen", Float, nullable=False),
)
"""Participants; ``participant`` is the keyed hash of source and id."""

RAW_IDS = Table(
    "raw_ids",
    METADATA,
    Column("participant", String(32), primary_key=True),
    Column("source", String(20), nullable=False),
    Column("raw_id", String(200), nullable=False),
    Column("recruiter", JSON, nullable=False),
    Column("seen", Float, nullable=False),
)
"""Recruiters' ids, for payment only; no table refers to it, so it can be emptied at any time."""

SESSIONS = Table(
    "sessions",
    METADATA,
    Column("session", String(32), primary_key=True),
    Column("participant", ForeignKey("participants.participant"), nullable=False),
    Column("scenario", String(200), nullable=False),
    Column("kind", String(10), nullable=False),
    Column("source", String(20), nullable=False),
    Column("study", ForeignKey("studies.digest"), nullable=False),
    Column("reference", String(20), nullable=False),
    Column("order_seed", BigInteger, nullable=False),
    Column("order_number", Integer, nullable=False),
    Column("buttons", String(6), nullable=False),
    Column("language", String(20), nullable=False),
    Column("started_at", Float, nullable=False),
    Column("consent_version", String(200)),
    Column("consented_at", Float),
    Column("instructed_at", Float),
    Column("comprehended_at", Float),
    Column("comprehension_attempts", Integer, nullable=False, server_default="0"),
    Column("ready_at", Float),
    Column("demographics_at", Float),
    Column("questions_at", Float),
    Column("questions_study", String(64)),
    Column("finished_at", Float),
    Column("withdrawn_at", Float),
    Column("closed_at", Float),
    Column("voided_at", Float),
    Column("screened_out_at", Float),
    Column("screened_out_by", String(20)),
    Column("browser", String(32)),
    Column("progressed_at", Float),
    Column("next_from", Float),
    Column("practice_repeats", Integer, nullable=False, server_default="0"),
    Column("failed_checks", String(100)),
    Column("attention_failed", Integer, nullable=False, server_default="0"),
    Column("answered_familiarization", Integer, nullable=False, default=0),
    Column("answered_test", Integer, nullable=False, default=0),
    Column("block", Integer, nullable=False, server_default="0"),
    Column("block_at", Float),
    Column("condition", String(40)),
    Column("fast_answers", Integer, nullable=False, server_default="0"),
    Column("unfetched", Integer, nullable=False, server_default="0"),
    Column("replayed", Integer, nullable=False, server_default="0"),
    Column("implausible", String(100)),
    Column("loads", Integer, nullable=False, default=0),
    Column("loaded_at_phase", String(15)),
    Column("loaded_at_trial", Integer),
    Column("last_seen", Float, nullable=False),
    Column("age", Integer),
    Column("gender", String(200)),
    Column("education", String(200)),
    Column("difficulty", Integer),
    Column("technical_problems", Boolean),
    Column("feedback", Text),
    Column("own_answers", JSON(none_as_null=True)),
    Column("device", JSON, nullable=False),
    UniqueConstraint("participant", "scenario"),
    CheckConstraint("kind IN ('person', 'simulated', 'preview')", name="kind"),
    CheckConstraint("buttons IN ('yes-no', 'no-yes')", name="buttons"),
    Index("ix_sessions_scenario_kind", "scenario", "kind"),
)
"""Sessions. ``kind`` is written when the session begins and never changed. ``order_number`` is the
number of the prepared order, 0 if the study has none; ``order_seed`` and the stimuli determine the
order of the trials. ``scenario`` is `study.ALL_SCENARIOS` in sessions of several scenarios, and
``block`` the index of the current block, to which ``ready_at`` belongs; ``block_at``: when the page
before it was sent. ``condition``: name of the between-subject condition; NULL without conditions.
``loaded_at_*``: the trial that was next when the page was last reloaded.
``own_answers``: answers to the lab's own questions, by name; ``questions_study``: digest of the
version of the study that asked them.
``closed_at``: when the lab ended the session for good, so that the participant cannot take it up
again: its data were deleted, or it was a preview of other stimuli. ``voided_at``: when the lab
decided that the session does not count.
``screened_out_at``: when the session ended since the participant failed the check
``screened_out_by``; ``comprehension_attempts``: how often the comprehension check was answered.
``attention_failed``: number of failed attention checks. ``practice_repeats``: how often the
practice of the current block was repeated; ``failed_checks``: names of the lab's checks that flag
the session, separated by commas; NULL without any.
``browser``: keyed hash of the key of the browser that began the session, empty if it sent none,
NULL in sessions of older versions. ``progressed_at``: time of the last page or answer.
``next_from``: earliest time at which the next trial can have begun. ``fast_answers``,
``unfetched``, ``replayed``: number of answers that were too fast, whose media were not fetched, and
whose movie was shown too often. ``implausible``: reasons, separated by commas, for which the
session is no person's (`plausibility.REASONS`); NULL without any."""

PAUSES = Table(
    "pauses",
    METADATA,
    Column("paused_at", Float, primary_key=True, autoincrement=False),
    Column("resumed_at", Float),
)
"""Pauses of recruitment; ``resumed_at`` is empty while a pause lasts."""

TOKENS = Table(
    "tokens",
    METADATA,
    Column("token_hash", String(64), primary_key=True),
    Column("session", ForeignKey("sessions.session"), nullable=False, index=True),
    Column("made", Float, nullable=False),
)
"""SHA-256 hashes of tokens; each token gives access to one session."""


def _answer_columns() -> list[Column[Any]]:
    """Return new columns of what is stored of an answer, besides session, phase and trial."""
    return [
        Column("key", String(64), nullable=False),
        Column("stimulus", String(200), nullable=False),
        Column("response", String(3), nullable=False),
        Column("rt_ms", Float, nullable=False),
        Column("input", String(8), nullable=False),
        Column("fixation_ms", Float),
        Column("cue_ms", Float),
        Column("frames_expected", Integer, nullable=False),
        Column("frames_shown", Integer),
        Column("frames_dropped", Integer),
        Column("movie_ms", Float),
        Column("visibility_changes", Integer),
        Column("window_width", Integer),
        Column("window_height", Integer),
        Column("break_ms", Float),
        Column("resumed", Boolean, nullable=False),
        Column("showings", Integer),
        Column("void", String(10)),
        Column("answered_at", Float, nullable=False),
        Column("details", Text, nullable=False),
    ]


ANSWERS = Table(
    "answers",
    METADATA,
    Column("session", ForeignKey("sessions.session"), primary_key=True),
    Column("phase", String(15), primary_key=True),
    Column("trial", Integer, primary_key=True),
    *_answer_columns(),
    UniqueConstraint("session", "key"),
    UniqueConstraint("session", "phase", "stimulus"),
    CheckConstraint("response IN ('yes', 'no')", name="response"),
)
"""Answers, one row per session and trial; ``details`` is JSON text. Attention checks are trials of
the test whose phase here is ``attention``. ``showings``: how often the movie was shown, counted
over all loads of the page; ``void``: what interrupted the movie."""

PRACTICE_REPEATS = Table(
    "practice_repeats",
    METADATA,
    Column("session", ForeignKey("sessions.session"), primary_key=True),
    Column("phase", String(15), primary_key=True),
    Column("trial", Integer, primary_key=True),
    Column("repeat", Integer, primary_key=True),
    *_answer_columns(),
)
"""Answers to practice trials that were repeated afterwards. ``repeat``: how often the practice had
been repeated before, from 0."""

SHOWINGS = Table(
    "showings",
    METADATA,
    Column("session", ForeignKey("sessions.session"), primary_key=True),
    Column("key", String(64), primary_key=True),
    Column("phase", String(15), nullable=False),
    Column("trial", Integer, nullable=False),
    Column("began_at", Float, nullable=False),
    Column("stored_at", Float, nullable=False),
    Index("ix_showings_session_phase_trial", "session", "phase", "trial"),
)
"""Showings of trials, one row each; ``began_at`` is the start of the fixation cross, from the
server's time of the request and the browser's report of how long ago it was."""

EVENTS = Table(
    "events",
    METADATA,
    Column("event", Integer, primary_key=True, autoincrement=True),
    Column("session", ForeignKey("sessions.session"), nullable=False, index=True),
    Column("batch", String(64)),
    Column("kind", String(40), nullable=False),
    Column("at_ms", Float, nullable=False),
    Column("stored_at", Float, nullable=False),
    Column("data", JSON, nullable=False),
)
"""Other events in the browser or of the session. ``batch`` is the key under which the browser sent
several events together."""

ACTIONS = Table(
    "actions",
    METADATA,
    Column("action_number", Integer, primary_key=True, autoincrement=True),
    Column("at", Float, nullable=False),
    Column("account", String(40), nullable=False),
    Column("role", String(20), nullable=False),
    Column("action", String(40), nullable=False),
    Column("subject", String(200), nullable=False),
)
"""Log of what experimenters did, one row an action; ``account`` is empty for the command line.
``subject``: reference of a session, or a number; never an id or an answer."""


# Open a study's database: SQLite in the study folder, or PostgreSQL.
#
# Both are configured so that a commit is on disk when it returns: SQLite with its write-ahead log
# and ``synchronous=FULL``, PostgreSQL with ``synchronous_commit=on``. Only one server at a time
# writes.

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


# Writer thread with group commit: many commands per transaction, acknowledged after its commit.
#
# A commit waits for the disk. Commands that arrive meanwhile share the next transaction, so an
# answer costs little, and none is acknowledged before it is on disk.

T = TypeVar("T")
Command = Callable[[Connection], T]
MAX_GROUP = 256
"""Commands in one transaction."""
MAX_WAITING = 10_000
"""Commands in the queue; more are refused."""
PATIENCE_S = 20.0
"""Time that commands wait for an unreachable database, such as one that is restarting."""
PAUSE_S = 0.1
"""Pause between attempts to reach the database."""
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _QueuedCommand:
    """A queued command with the future of its result and the future's event loop."""

    command: Command[Any]
    future: Any
    loop: asyncio.AbstractEventLoop | None


@dataclass(slots=True)
class _Outcome:
    """Result or error of a command."""

    value: Any = None
    error: BaseException | None = None


class Writer:
    """Thread that runs commands one after the other, in groups of one transaction each.

    A command is a function of the connection. It is run again if its group failed, so it must not
    draw random names or read the clock, and it must be idempotent: the connection may be lost after
    the database committed but before it confirmed. A command must raise `Refused` before it writes
    anything; any other exception rolls back all that it wrote.

    Parameters
    ----------
    connect
        Opens the writing connection; called again after the connection was lost.
    group
        Largest number of commands in one transaction.
    waiting
        Largest number of commands in the queue.
    patience_s
        Seconds that commands wait for an unreachable database.
    """

    def __init__(
        self,
        connect: Callable[[], Connection],
        *,
        group: int = MAX_GROUP,
        waiting: int = MAX_WAITING,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._connect, self._group, self._waiting = connect, group, waiting
        self._patience_s = patience_s
        self._queue: SimpleQueue[_QueuedCommand | None] = SimpleQueue()
        self._closing = False
        self._lock = threading.Lock()
        self._down_since: float | None = None
        self._connection: Connection | None = connect()
        self._thread = threading.Thread(target=self._work, name="writer", daemon=True)
        self._thread.start()

    def submit(self, command: Command[T]) -> Future[T]:
        """Queue a command; the returned future is done once its effects are committed."""
        future: Future[T] = Future()
        self._put(_QueuedCommand(command, future, None))
        return future

    async def run(self, command: Command[T]) -> T:
        """Run a command and await its result; a whole group wakes the event loop only once."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[T] = loop.create_future()
        self._put(_QueuedCommand(command, future, loop))
        return await future

    def close(self) -> None:
        """Run all waiting commands, then stop the thread. Later commands are refused."""
        with self._lock:
            if not self._closing:
                self._closing = True
                self._queue.put(None)
        self._thread.join()

    def _put(self, item: _QueuedCommand) -> None:
        """Queue a command, or raise `Refused` if the writer is overloaded or closing."""
        if self._queue.qsize() >= self._waiting:
            raise Refused("unavailable", "The server is overloaded; try again soon.")
        with self._lock:  # no command may be queued after the end mark
            if self._closing:
                raise Refused("unavailable", "The server is stopping; try again soon.")
            self._queue.put(item)

    def _work(self) -> None:
        """Run groups of commands until the writer is closed."""
        ended = False
        while not ended:
            group, ended = self._take_group()
            if group:
                self._run_group(group)
        self._disconnect()

    def _take_group(self) -> tuple[list[_QueuedCommand], bool]:
        """Wait for a command; return it with the other waiting ones, and whether to stop then."""
        first = self._queue.get()
        if first is None:
            return [], True
        group = [first]
        while len(group) < self._group:
            try:
                item = self._queue.get_nowait()
            except Empty:
                break
            if item is None:
                return group, True
            group.append(item)
        return group, False

    def _run_group(self, group: list[_QueuedCommand]) -> None:
        """Run and acknowledge a group; on failure wait for the database or run items one by one."""
        while True:
            try:
                connection = self._begin()
            except Exception as error:
                self._disconnect()
                if self._wait(group, error):
                    continue
                return
            try:
                outcomes = [_run(item.command, connection) for item in group]
                connection.commit()
            except Exception as error:
                if self._roll_back(error):
                    if self._wait(group, error):
                        continue
                elif len(group) > 1:
                    for item in group:
                        self._run_group([item])
                else:
                    _set_outcomes(group, [_Outcome(error=error)])
                return
            self._down_since = None
            _set_outcomes(group, outcomes)
            return

    def _begin(self) -> Connection:
        """Return the connection, with a transaction begun."""
        if self._connection is None:
            self._connection = self._connect()
        self._connection.begin()
        return self._connection

    def _roll_back(self, error: Exception) -> bool:
        """Roll back a group; return whether it failed because the connection was lost."""
        connection = self._connection
        lost = isinstance(error, DBAPIError) and error.connection_invalidated
        try:
            assert connection is not None
            connection.rollback()
        except Exception:
            lost = True
        if lost:
            self._disconnect()
        return lost

    def _wait(self, group: list[_QueuedCommand], error: Exception) -> bool:
        """Pause until the next attempt; after ``patience_s`` refuse the group and return False."""
        now = time.monotonic()
        if self._down_since is None:
            self._down_since = now
            _log.warning("the database does not answer: %s", _first_line(error))
        if self._closing or now - self._down_since > self._patience_s:
            _set_outcomes(group, [_Outcome(error=_unavailable(error)) for _ in group])
            return False
        time.sleep(PAUSE_S)
        return True

    def _disconnect(self) -> None:
        """Close the connection if there is one."""
        if self._connection is not None:
            with contextlib.suppress(SQLAlchemyError):
                close_writer(self._connection)
            self._connection = None


def _run(command: Command[Any], connection: Connection) -> _Outcome:
    """Run a command; a refusal becomes its outcome, other errors are raised."""
    try:
        return _Outcome(value=command(connection))
    except Refused as refusal:
        return _Outcome(error=refusal)


def _set_outcomes(group: Sequence[_QueuedCommand], outcomes: Sequence[_Outcome]) -> None:
    """Set the futures of a group, with one wake-up of each event loop."""
    by_loop: dict[asyncio.AbstractEventLoop | None, list[tuple[Any, _Outcome]]] = {}
    for item, outcome in zip(group, outcomes, strict=True):
        by_loop.setdefault(item.loop, []).append((item.future, outcome))
    for loop, pairs in by_loop.items():
        if loop is None:
            _set_futures(pairs)
            continue
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(_set_futures, pairs)


def _set_futures(pairs: Sequence[tuple[Any, _Outcome]]) -> None:
    """Set the results or errors of futures."""
    for future, outcome in pairs:
        if future.done():  # cancelled
            continue
        with contextlib.suppress(InvalidStateError):  # cancelled just now
            if outcome.error is not None:
                future.set_exception(outcome.error)
            else:
                future.set_result(outcome.value)


def _unavailable(error: Exception) -> Refused:
    """Return the refusal for an unreachable database."""
    refusal = Refused("unavailable", "The server cannot reach its database; try again soon.")
    refusal.__cause__ = error
    return refusal


def _first_line(error: Exception) -> str:
    """Return the first line of the database driver's error message."""
    original = getattr(error, "orig", None) if not isinstance(error, PhysionError) else error
    return str(original or error).partition("\n")[0]
