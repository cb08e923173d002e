"""Reading of batches ahead, in threads or processes.

Decoding of movies and the kernels of the renderer release Python's global lock, so that threads
read while a model trains. The renderer is partly Python itself: on more than a few cores, processes
render faster than threads.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from typing import Any, TypeVar

from physion.compute.executor import Executor, TaskOutcome
from physion.compute.local import available_cores
from physion.errors import BadInputError, PhysionError

Request = TypeVar("Request")
Read = TypeVar("Read")


def background(
    requests: Iterable[Request],
    read: Callable[[Request], Read],
    *,
    ahead: int = 2,
    threads: int | None = None,
    executor: Executor | None = None,
) -> Iterator[Read]:
    """Yield ``read(request)`` of every request, in order, read ahead in threads.

    An error of ``read`` or of ``requests`` is raised where its result would come. When the iterator
    ends, fails or is closed, all its threads and processes have ended.

    Parameters
    ----------
    requests
        Arguments of ``read``. They are taken in the calling thread, when there is room for them.
    read
        Function that reads, such as a method of a source. It is called in several threads at once.
    ahead
        Results that are read or being read before they are asked for; they are held in memory.
    threads
        Number of threads; by default one for each core, at most ``ahead``.
    executor
        Executor that reads in place of threads, such as
        `physion.compute.local.LocalExecutor`. Its workers decide how much is read ahead; all
        requests are taken at once; errors become `PhysionError`, and ``read`` must be picklable.
    """
    if ahead < 1 or (threads is not None and threads < 1):
        raise BadInputError(f"reading ahead needs 1 result and 1 thread, not {ahead} and {threads}")
    if executor is not None:
        return _read_by_executor(requests, read, executor)
    return _read_ahead(iter(requests), read, ahead, min(threads or available_cores(), ahead))


def _read_ahead(
    requests: Iterator[Request], read: Callable[[Request], Read], ahead: int, workers: int
) -> Iterator[Read]:
    waiting: deque[Future[Read]] = deque()
    failure: Exception | None = None
    exhausted = False
    pool = ThreadPoolExecutor(workers, thread_name_prefix="batches")
    try:
        while True:
            while not exhausted and len(waiting) < ahead:
                try:
                    request = next(requests)
                except StopIteration:
                    exhausted = True
                except Exception as error:
                    failure, exhausted = error, True
                else:
                    waiting.append(pool.submit(read, request))
            if not waiting:
                break
            yield waiting.popleft().result()
        if failure is not None:
            raise failure
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _read_by_executor(
    requests: Iterable[Request], read: Callable[[Request], Read], executor: Executor
) -> Iterator[Read]:
    """Yield the results of an executor, which come in any order, in the order of the requests."""
    tasks = {str(position): request for position, request in enumerate(requests)}
    early: dict[str, TaskOutcome[Read]] = {}
    outcomes: Any = executor.map(read, tasks)
    with closing(outcomes):
        for position in tasks:
            while position not in early:
                outcome = next(outcomes)
                early[outcome.key] = outcome
            outcome = early.pop(position)
            if outcome.error is not None:
                raise PhysionError(outcome.error)
            yield outcome.value
