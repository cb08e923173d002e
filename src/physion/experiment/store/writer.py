"""Writer thread with group commit: many commands per transaction, acknowledged after its commit.

A commit waits for the disk. Commands that arrive meanwhile share the next transaction, so an answer
costs little, and none is acknowledged before it is on disk.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, InvalidStateError
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from sqlalchemy import Connection
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from physion.core.errors import PhysionError
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.database import close_writer

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
