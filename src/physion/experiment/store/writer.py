"""The one thread that writes: many commands in one transaction, acknowledged after its commit.

A commit waits for the disk. While it does, more commands come in; the next transaction takes all of
them. So each answer costs little, and none is acknowledged before it is safe.
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

from physion.errors import PhysionError
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.database import close_writer

T = TypeVar("T")
Command = Callable[[Connection], T]
GROUP = 256
WAITING = 10_000
PATIENCE_S = 20.0
"""How long commands wait for a database that went away, such as one that is restarted."""
PAUSE_S = 0.1
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Item:
    command: Command[Any]
    future: Any
    loop: asyncio.AbstractEventLoop | None


@dataclass(slots=True)
class _Outcome:
    value: Any = None
    error: BaseException | None = None


class Writer:
    """Runs commands one after the other in a thread of its own, in groups of one transaction.

    A command takes the connection, and returns or raises. It is run again where a group failed, so
    it draws nothing itself (names, tokens, times come from outside) and can meet its own effect: a
    connection may be lost after the database committed and before it said so. `Refused` must be
    raised before anything is written; what else it raises undoes all that it wrote.
    """

    def __init__(
        self,
        connect: Callable[[], Connection],
        *,
        group: int = GROUP,
        waiting: int = WAITING,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._connect, self._group, self._waiting = connect, group, waiting
        self._patience_s = patience_s
        self._queue: SimpleQueue[_Item | None] = SimpleQueue()
        self._closing = False
        self._lock = threading.Lock()
        self._down_since: float | None = None
        self._connection: Connection | None = connect()
        self._thread = threading.Thread(target=self._work, name="writer", daemon=True)
        self._thread.start()

    def submit(self, command: Command[T]) -> Future[T]:
        """Have a command run; the future is done once its effects are on the disk."""
        future: Future[T] = Future()
        self._put(_Item(command, future, None))
        return future

    async def run(self, command: Command[T]) -> T:
        """The same for a coroutine: one wake-up of the event loop for a whole group."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[T] = loop.create_future()
        self._put(_Item(command, future, loop))
        return await future

    def close(self) -> None:
        """Run what waits, then stop. Later commands are refused."""
        with self._lock:
            if not self._closing:
                self._closing = True
                self._queue.put(None)
        self._thread.join()

    def _put(self, item: _Item) -> None:
        if self._queue.qsize() >= self._waiting:
            raise Refused("unavailable", "The server has too much to do; try again soon.")
        with self._lock:  # nothing may come after the end mark
            if self._closing:
                raise Refused("unavailable", "The server is stopping; try again soon.")
            self._queue.put(item)

    def _work(self) -> None:
        ended = False
        while not ended:
            group, ended = self._take()
            if group:
                self._perform(group)
        self._drop()

    def _take(self) -> tuple[list[_Item], bool]:
        """All that waits, up to one group; waits for the first."""
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

    def _perform(self, group: list[_Item]) -> None:
        """Run a group and acknowledge it; where it fails, wait for the database or split it."""
        while True:
            try:
                connection = self._begin()
            except Exception as error:
                self._drop()
                if self._wait(group, error):
                    continue
                return
            try:
                outcomes = [_run(item.command, connection) for item in group]
                connection.commit()
            except Exception as error:
                if self._undo(error):
                    if self._wait(group, error):
                        continue
                elif len(group) > 1:
                    for item in group:
                        self._perform([item])
                else:
                    _settle(group, [_Outcome(error=error)])
                return
            self._down_since = None
            _settle(group, outcomes)
            return

    def _begin(self) -> Connection:
        """A connection with a transaction begun."""
        if self._connection is None:
            self._connection = self._connect()
        self._connection.begin()
        return self._connection

    def _undo(self, error: Exception) -> bool:
        """Take back what a group wrote. Was it the connection, and not what was asked of it?"""
        connection = self._connection
        lost = isinstance(error, DBAPIError) and error.connection_invalidated
        try:
            assert connection is not None
            connection.rollback()
        except Exception:
            lost = True
        if lost:
            self._drop()
        return lost

    def _wait(self, group: list[_Item], error: Exception) -> bool:
        """Wait a moment for the database; False, and the group is refused, where it took long."""
        now = time.monotonic()
        if self._down_since is None:
            self._down_since = now
            _log.warning("the database does not answer: %s", _first_line(error))
        if self._closing or now - self._down_since > self._patience_s:
            _settle(group, [_Outcome(error=_unavailable(error)) for _ in group])
            return False
        time.sleep(PAUSE_S)
        return True

    def _drop(self) -> None:
        if self._connection is not None:
            with contextlib.suppress(SQLAlchemyError):
                close_writer(self._connection)
            self._connection = None


def _run(command: Command[Any], connection: Connection) -> _Outcome:
    try:
        return _Outcome(value=command(connection))
    except Refused as refusal:
        return _Outcome(error=refusal)


def _settle(group: Sequence[_Item], outcomes: Sequence[_Outcome]) -> None:
    """Hand the outcomes over, with one wake-up for each event loop."""
    by_loop: dict[asyncio.AbstractEventLoop | None, list[tuple[Any, _Outcome]]] = {}
    for item, outcome in zip(group, outcomes, strict=True):
        by_loop.setdefault(item.loop, []).append((item.future, outcome))
    for loop, pairs in by_loop.items():
        if loop is None:
            _resolve(pairs)
            continue
        with contextlib.suppress(RuntimeError):  # the loop has ended, nobody waits
            loop.call_soon_threadsafe(_resolve, pairs)


def _resolve(pairs: Sequence[tuple[Any, _Outcome]]) -> None:
    for future, outcome in pairs:
        if future.done():  # whoever asked has gone away
            continue
        with contextlib.suppress(InvalidStateError):  # gone away this very moment
            if outcome.error is not None:
                future.set_exception(outcome.error)
            else:
                future.set_result(outcome.value)


def _unavailable(error: Exception) -> Refused:
    refusal = Refused("unavailable", "The server cannot reach its database; try again soon.")
    refusal.__cause__ = error
    return refusal


def _first_line(error: Exception) -> str:
    original = getattr(error, "orig", None) if not isinstance(error, PhysionError) else error
    return str(original or error).partition("\n")[0]
