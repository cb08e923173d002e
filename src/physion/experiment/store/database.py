"""The database of a study: its tables, and one SQLite file in the study folder that holds them.

Times are seconds since 1970 (UTC) of the server's clock. Values that can be computed (order of
trials, correctness) are not stored; labels are in the study folder only.

A commit is on the disk when it returns (write-ahead log, ``synchronous=FULL``), and only one server
at a time writes: what was acknowledged survives ``kill -9`` and a power failure. The version of the
tables is in the file itself (``PRAGMA user_version``).
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from queue import SimpleQueue
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
    inspect,
)
from sqlalchemy.exc import OperationalError, SQLAlchemyError

from physion.core.errors import BadInputError, PhysionError
from physion.core.files import folder_lock
from physion.experiment.protocol import Refused

METADATA = MetaData()

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


def _columns(kind: Any, *names: str, **settings: Any) -> list[Column[Any]]:
    """Return new columns of one type."""
    return [Column(name, kind, **settings) for name in names]


SESSIONS = Table(
    "sessions",
    METADATA,
    Column("session", String(32), primary_key=True),
    Column("participant", ForeignKey("participants.participant"), nullable=False),
    Column("study", ForeignKey("studies.digest"), nullable=False),
    *_columns(String(200), "scenario", nullable=False),
    *_columns(String(20), "kind", "source", "reference", "buttons", "language", nullable=False),
    Column("order_seed", BigInteger, nullable=False),
    Column("order_number", Integer, nullable=False),
    *_columns(Float, "started_at", "last_seen", nullable=False),
    *_columns(Float, "consented_at", "instructed_at", "comprehended_at", "ready_at",
              "demographics_at", "questions_at", "finished_at", "withdrawn_at", "closed_at",
              "voided_at", "screened_out_at", "progressed_at", "next_from"),
    *_columns(Integer, "comprehension_attempts", "practice_repeats", "attention_failed",
              "answered_familiarization", "answered_test", "fast_answers", "unfetched",
              "replayed", "loads", nullable=False, default=0),
    *_columns(String(200), "consent_version", "questions_study", "screened_out_by", "browser",
              "failed_checks", "condition", "implausible", "loaded_at_phase", "gender",
              "education"),
    *_columns(Integer, "loaded_at_trial", "age", "difficulty"),
    Column("technical_problems", Boolean),
    Column("feedback", Text),
    Column("own_answers", JSON(none_as_null=True)),
    Column("device", JSON, nullable=False),
    UniqueConstraint("participant", "scenario"),
    CheckConstraint("kind IN ('person', 'simulated', 'preview')", name="kind"),
    CheckConstraint("buttons IN ('yes-no', 'no-yes')", name="buttons"),
    Index("ix_sessions_scenario_kind", "scenario", "kind"),
)  # fmt: skip
"""Sessions. ``kind`` is written when the session begins and never changed. ``order_number`` is the
number of the prepared order, 0 if the study has none; ``order_seed`` and the stimuli determine the
order of the trials. ``condition``: name of the between-subject condition; NULL without conditions.
``loaded_at_*``: the trial that was next when the page was last reloaded.
``own_answers``: answers to the lab's own questions, by name; ``questions_study``: digest of the
version of the study that asked them.
``closed_at``: when the lab ended the session for good, so that the participant cannot take it up
again: its data were deleted, or it was a preview of other stimuli. ``voided_at``: when the lab
decided that the session does not count.
``screened_out_at``: when the session ended because the participant failed the check
``screened_out_by``; ``comprehension_attempts``: how often the comprehension check was answered.
``attention_failed``: number of failed attention checks. ``practice_repeats``: how often the
practice was repeated; ``failed_checks``: names of the lab's checks that flag
the session, separated by commas; NULL without any.
``browser``: keyed hash of the key of the browser that began the session, empty if it sent none.
``progressed_at``: time of the last page or answer.
``next_from``: earliest time at which the next trial can have begun. ``fast_answers``,
``unfetched``, ``replayed``: number of answers that were too fast, whose media were not fetched, and
whose movie was shown too often. ``implausible``: reasons, separated by commas, for which the
session is not a person's (`judging.REASONS`); NULL without any."""

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
        *_columns(String(200), "key", "stimulus", "response", "input", nullable=False),
        *_columns(Float, "rt_ms", "answered_at", nullable=False),
        *_columns(Float, "fixation_ms", "cue_ms", "movie_ms", "break_ms"),
        Column("frames_expected", Integer, nullable=False),
        *_columns(Integer, "frames_shown", "frames_dropped", "visibility_changes", "window_width",
                  "window_height", "showings"),
        Column("resumed", Boolean, nullable=False),
        Column("void", String(10)),
        Column("details", Text, nullable=False),
    ]  # fmt: skip


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

DATABASE_FILE = "responses.sqlite"
SCHEMA = 2
"""Version of the tables above; raise it with every change of them."""
BUSY_MS = 10_000
"""Time in milliseconds that SQLite waits for a lock of another process, such as a backup."""
MAX_GROUP = 256
"""Commands in one transaction."""
_WRITES = "physion_writes"
T = TypeVar("T")
Command = Callable[[Connection], T]


def open_database(folder: Path) -> Engine:
    """Return an engine for the database of a study that has been served.

    Error messages contain statements without their values, so that no participant's id reaches a
    log.

    Raises
    ------
    BadInputError
        The study has no database yet, or it has tables of another version.
    PhysionError
        The file cannot be read, or is not a database.
    """
    path = folder / DATABASE_FILE
    if not path.exists():
        raise BadInputError(f"there is no database {path}; has the study been served yet?")
    engine = _engine(path)
    try:
        with engine.connect() as connection:
            version = connection.exec_driver_sql("PRAGMA user_version").scalar_one()
    except SQLAlchemyError as error:
        engine.dispose()
        raise _unreadable(path, error) from error
    if version != SCHEMA:
        engine.dispose()
        raise BadInputError(
            f"{path} has tables of version {version}, this package reads version {SCHEMA}: use the "
            "version of the package that wrote it"
        )
    return engine


def create_database(folder: Path) -> Engine:
    """Return an engine for the database of a study; make it with its tables if it is missing.

    A new file is readable by its owner only. Raises the errors of `open_database`.
    """
    path = folder / DATABASE_FILE
    # SQLite makes its log files with the permissions of the database file.
    os.close(os.open(path, os.O_CREAT | os.O_RDWR | getattr(os, "O_NOFOLLOW", 0), 0o600))
    engine = _engine(path)
    try:
        with engine.execution_options(**{_WRITES: True}).begin() as connection:
            # A server that was killed as it began leaves a file without tables.
            if not inspect(connection).get_table_names():
                METADATA.create_all(connection)
                connection.exec_driver_sql(f"PRAGMA user_version = {SCHEMA}")
    except SQLAlchemyError as error:
        raise _unreadable(path, error) from error
    finally:
        engine.dispose()
    return open_database(folder)


def _engine(path: Path) -> Engine:
    """Return an engine for an SQLite file, with durable commits and overwritten deletions."""
    engine = create_engine(
        f"sqlite:///{path.resolve()}",
        hide_parameters=True,
        connect_args={"timeout": BUSY_MS / 1000},
    )

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


def _unreadable(path: Path, error: SQLAlchemyError) -> PhysionError:
    """Return the error for a database that SQLite cannot open."""
    return PhysionError(f"{path} cannot be read: {getattr(error, 'orig', error)}")


@contextlib.contextmanager
def server_lock(folder: Path) -> Iterator[None]:
    """Hold the lock that keeps other servers from the database of a study.

    Raises
    ------
    PhysionError
        Another process holds the lock.
    """
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(folder_lock(folder.resolve()))
        except PhysionError as error:
            raise PhysionError(
                f"another process writes into {folder}; stop the server of this study first, or "
                "wait until the other process has finished"
            ) from error
        yield


class Writer:
    """One thread that runs commands; commands that wait while the disk syncs share a transaction.

    A command is a function of the connection. It is acknowledged after the commit; whatever it
    raises rolls back all that it wrote, and nothing else.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine.execution_options(**{_WRITES: True})
        self._queue: SimpleQueue[tuple[Command[Any], Future[Any]] | None] = SimpleQueue()
        self._closed, self._lock = False, threading.Lock()
        self._thread = threading.Thread(target=self._work, name="writer", daemon=True)
        self._thread.start()

    def submit(self, command: Command[T]) -> Future[T]:
        """Queue a command; the returned future is done once its effects are committed."""
        future: Future[T] = Future()
        with self._lock:  # no command may be queued after the end mark
            if self._closed:
                raise Refused("unavailable", "The server is stopping; try again soon.")
            self._queue.put((command, future))
        return future

    async def run(self, command: Command[T]) -> T:
        """Run a command and await its result."""
        return await asyncio.wrap_future(self.submit(command))

    def close(self) -> None:
        """Run all waiting commands, then stop the thread. Later commands are refused."""
        with self._lock:
            if not self._closed:
                self._queue.put(None)
            self._closed = True
        self._thread.join()

    def _work(self) -> None:
        """Write groups of commands until the writer is closed."""
        going = True
        while going:
            taken = [self._queue.get()]
            while len(taken) < MAX_GROUP and not self._queue.empty():
                taken.append(self._queue.get())
            going = None not in taken
            self._write([item for item in taken if item and item[1].set_running_or_notify_cancel()])

    def _write(self, group: list[tuple[Command[Any], Future[Any]]]) -> None:
        """Run commands in one transaction, each in a savepoint, and acknowledge them."""
        outcomes: list[tuple[Any, Exception | None]] = []
        try:
            with self._engine.begin() as connection:
                outcomes += [_run(connection, command) for command, _ in group]
        except OperationalError as error:  # a full disk, or a lock of another program
            refusal = Refused(
                "unavailable", "The server cannot write into its database; try again soon."
            )
            refusal.__cause__ = error
            outcomes = [(None, refusal)] * len(group)
        except Exception as error:
            outcomes = [(None, error)] * len(group)
        for (_, future), (value, failed) in zip(group, outcomes, strict=True):
            if failed is None:
                future.set_result(value)
            else:
                future.set_exception(failed)


def _run(connection: Connection, command: Command[Any]) -> tuple[Any, Exception | None]:
    """Return the result of a command and None, or None and the error that rolled it back."""
    try:
        with connection.begin_nested():
            return command(connection), None
    except OperationalError:
        raise
    except Exception as error:
        return None, error
