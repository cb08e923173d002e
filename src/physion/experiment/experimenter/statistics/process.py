"""Background process that computes the statistics of the pages, so the server is not blocked.

In the server's own process, the computation would delay participants' answers, since only one
Python thread runs at a time. The process is started by the first request and restarted if it has
died. It ends when the server ends, because the pipe between them is then stopped.
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

from physion.core.errors import PhysionError
from physion.experiment.study.study import Study

LOG = logging.getLogger(__name__)
TIMEOUT = 120.0
"""Seconds that a request may take before the process is killed."""
ATTEMPTS = 2
POLL_INTERVAL = 0.25
"""Interval in seconds at which a waiting thread checks whether the server is still running."""


class StatisticsError(PhysionError):
    """The statistics process died, took too long, or failed."""


class StatisticsProcess:
    """Client of a `StatisticsWorker` in another process; sends one request at a time."""

    def __init__(self, study: Study, url: str, timeout: float = TIMEOUT) -> None:
        # The worker does not need the texts.
        self._study, self._url, self._timeout = replace(study, texts={}), url, timeout
        self._lock = threading.Lock()
        self._threads = ThreadPoolExecutor(4, thread_name_prefix="desk")
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None

    async def query(self, request: str, **arguments: Any) -> Any:
        """Call the worker's method ``request`` and return its result; may raise `PhysionError`."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, self._query, request, arguments)

    @contextlib.asynccontextmanager
    async def stopped(self) -> AsyncIterator[None]:
        """Stop the process for the duration of the context, so that it reads nothing."""
        if self._process is not None:
            self._process.kill()
        await asyncio.to_thread(self._lock.acquire)
        try:
            await asyncio.to_thread(self._end)
            yield
        finally:
            self._lock.release()

    def close(self) -> None:
        """Stop the process without waiting for pending results."""
        if self._process is not None:
            self._process.kill()
        self._threads.shutdown(wait=True, cancel_futures=True)
        with self._lock:
            self._end()

    def _query(self, request: str, arguments: dict[str, Any]) -> Any:
        """Send a request, restarting the process once if it has ended; return the result."""
        for _ in range(ATTEMPTS):
            with self._lock:
                try:
                    kind, result = self._exchange(request, arguments)
                    break
                except (EOFError, OSError):
                    # The process may just have ended after its idle time: retry with a new one.
                    self._end()
        else:
            raise StatisticsError("the statistics process ended without a result")
        if kind == "refused":
            raise PhysionError(result)
        if kind == "failed":
            LOG.error("the request %r failed:\n%s", request, result)
            raise StatisticsError("the statistics could not be computed; see the server's log")
        return result

    def _exchange(self, request: str, arguments: dict[str, Any]) -> tuple[str, Any]:
        """Send one request over the pipe and wait for the reply."""
        pipe = self._pipe if self._pipe is not None else self._begin()
        pipe.send((request, arguments))
        deadline = time.monotonic() + self._timeout
        while not pipe.poll(POLL_INTERVAL):
            # Do not block a server that is shutting down.
            if time.monotonic() > deadline or not threading.main_thread().is_alive():
                self._end()
                raise StatisticsError(f"no result within {self._timeout:g} s; try again later")
        kind, result = pipe.recv()
        return kind, result

    def _begin(self) -> Connection:
        """Start the process; return the connection to it."""
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
        """Kill the process and close the connection."""
        if self._pipe is not None:
            self._pipe.close()
        if self._process is not None:
            self._process.kill()
            self._process.join(5.0)
        self._pipe = self._process = None
