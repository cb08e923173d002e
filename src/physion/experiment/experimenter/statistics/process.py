"""The desk at which pages ask: a process that reads and counts, so that the server does not.

Counting in the server's own process would hold up participants' answers: Python runs one thread at
a time. The process is started by the first question and again where it died; it ends by itself when
the server is gone, since its end of the pipe closes.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import threading
import time
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from physion.errors import PhysionError
from physion.experiment.study.study import Study

LOG = logging.getLogger(__name__)
PATIENCE = 120.0
"""Seconds that a question may take before the process is given up."""
TRIES = 2
LOOK_UP = 0.25
"""Seconds after which a waiting thread looks whether the server is still there."""


class DeskError(PhysionError):
    """A question without an answer: the process died, took too long, or failed."""


class Desk:
    """Asks one question at a time of a `Clerk` in another process."""

    def __init__(self, study: Study, url: str, patience: float = PATIENCE) -> None:
        # Texts are not needed there.
        self._study, self._url, self._patience = replace(study, texts={}), url, patience
        self._lock = threading.Lock()
        self._threads = ThreadPoolExecutor(4, thread_name_prefix="desk")
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None

    async def ask(self, question: str, **arguments: Any) -> Any:
        """The answer to a question, a method of the clerk. Raises `PhysionError`."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, self._ask, question, arguments)

    @contextlib.asynccontextmanager
    async def closed(self) -> AsyncIterator[None]:
        """Nothing is read meanwhile; questions wait."""
        if self._process is not None:
            self._process.kill()
        await asyncio.to_thread(self._lock.acquire)
        try:
            await asyncio.to_thread(self._end)
            yield
        finally:
            self._lock.release()

    def close(self) -> None:
        """Ends the process, without waiting for an answer that is on its way."""
        if self._process is not None:
            self._process.kill()
        self._threads.shutdown(wait=True, cancel_futures=True)
        with self._lock:
            self._end()

    def _ask(self, question: str, arguments: dict[str, Any]) -> Any:
        for _ in range(TRIES):
            with self._lock:
                try:
                    kind, found = self._exchange(question, arguments)
                    break
                except (EOFError, OSError):
                    # It may have ended for want of questions just now: once more with a new one.
                    self._end()
        else:
            raise DeskError("the process that counts ended before it answered")
        if kind == "refused":
            raise PhysionError(found)
        if kind == "failed":
            LOG.error("the question %r failed:\n%s", question, found)
            raise DeskError("this could not be worked out; the server's log says why")
        return found

    def _exchange(self, question: str, arguments: dict[str, Any]) -> tuple[str, Any]:
        pipe = self._pipe if self._pipe is not None else self._begin()
        pipe.send((question, arguments))
        until = time.monotonic() + self._patience
        while not pipe.poll(LOOK_UP):
            # A server that ends must not wait for a page that nobody will see.
            if time.monotonic() > until or not threading.main_thread().is_alive():
                self._end()
                raise DeskError(f"no answer within {self._patience:g} s; try again later")
        kind, found = pipe.recv()
        return kind, found

    def _begin(self) -> Connection:
        from physion.experiment.experimenter.statistics.worker import serve_questions

        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=serve_questions,
            args=(self._study, self._url, theirs),
            name="physion-experimenter",
            daemon=True,
        )
        self._process.start()
        theirs.close()
        return self._pipe

    def _end(self) -> None:
        if self._pipe is not None:
            self._pipe.close()
        if self._process is not None:
            self._process.kill()
            self._process.join(5.0)
        self._pipe = self._process = None
