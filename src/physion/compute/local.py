"""Executors on this machine: one in the calling process, and one with a pool of processes."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Self, TypeVar

from physion.compute.tasks import ONE_THREAD, TRIES, TaskOutcome, run_task
from physion.core.errors import PhysionError

T = TypeVar("T")
R = TypeVar("R")


class SerialExecutor:
    """Executor that runs the tasks one after the other in the calling process."""

    def map(self, function: Callable[[T], R], tasks: Mapping[str, T]) -> Iterator[TaskOutcome[R]]:
        """Yield outcomes in the order of the tasks; see `physion.compute.tasks.Executor`."""
        for key, task in tasks.items():
            yield run_task(key, function, task)


class LocalExecutor:
    """Executor that runs tasks in several processes of this machine, with one thread each.

    Processes are spawned, not forked, so that no state of compiled code or engines is inherited.
    A worker process that dies (killed, out of memory, crash in C) is replaced, and its task is
    started again; other tasks are not affected.

    A process takes seconds to start, most of them to load kernels. In a ``with`` block of the
    executor, processes are kept for the next call of `map`, and end with the block.

    Parameters
    ----------
    workers
        Number of processes; by default one per available core.
    tries
        How often a task is started before it counts as failed because its process died.
    timeout
        Seconds after which the process of a task is killed, which counts as a death.
    logs
        Folder for a file of each task with what it prints; by default this process's output.
    """

    def __init__(
        self,
        workers: int | None = None,
        *,
        tries: int = TRIES,
        timeout: float | None = None,
        logs: Path | None = None,
    ) -> None:
        self.workers = workers if workers is not None else available_cores()
        if self.workers < 1 or tries < 1:
            raise PhysionError(f"{workers} workers and {tries} tries: both must be at least 1")
        self.tries, self.timeout, self.logs = tries, timeout, logs
        self._blocks = 0
        self._kept: list[_Worker] = []

    def __enter__(self) -> Self:
        self._blocks += 1
        return self

    def __exit__(self, *_: object) -> None:
        self._blocks -= 1
        if self._blocks:
            return  # the processes end with the outer block
        workers, self._kept = self._kept, []
        for worker in workers:
            worker.stop()

    def map(self, function: Callable[[T], R], tasks: Mapping[str, T]) -> Iterator[TaskOutcome[R]]:
        """Yield outcomes as they come; see `physion.compute.tasks.Executor`."""
        waiting = deque(_Job(key, task) for key, task in tasks.items())
        count = min(self.workers, len(tasks))
        workers = [self._kept.pop() for _ in range(min(count, len(self._kept)))]
        workers += [_Worker() for _ in range(count - len(workers))]
        failed_starts = 0
        try:
            workers = self._assign(workers, waiting, function)
            while workers:
                done: list[TaskOutcome[R]] = []
                for worker in self._wait(workers):
                    job, worker.job = worker.job, None
                    outcome = worker.outcome(job)
                    if outcome is None:
                        workers.remove(worker)
                        failed_starts += job is None
                        if failed_starts >= self.tries:
                            raise _startup_error(worker)
                        if job is not None and job.tries < self.tries:
                            # Last, so that a task that kills workers does not delay the others.
                            waiting.append(replace(job, tries=job.tries + 1))
                        elif job is not None:
                            outcome = TaskOutcome(job.key, error=worker.reason(), tries=job.tries)
                        if waiting:
                            workers.append(_Worker())
                    else:
                        failed_starts = 0
                    if outcome is not None and job is not None:
                        done.append(outcome)
                # Before yielding, so that workers are busy while the caller handles the outcomes.
                workers = self._assign(workers, waiting, function)
                yield from done
        finally:
            for worker in workers:
                worker.stop()

    def _assign(
        self, workers: list[_Worker], waiting: deque[_Job], function: Callable[..., Any]
    ) -> list[_Worker]:
        """Give a task to each idle worker, keep or stop those that have none; return the others."""
        busy = []
        for worker in workers:
            if worker.idle and waiting:
                worker.start(function, waiting.popleft(), self.logs)
            if worker.job is not None or waiting:
                busy.append(worker)
            elif self._blocks:
                self._kept.append(worker)
            else:
                worker.stop()
        return busy

    def _wait(self, workers: list[_Worker]) -> list[_Worker]:
        """Wait until workers have ended what they do, or were ended for its time; return them."""
        pause = None
        if self.timeout is not None:
            ends = [worker.since + self.timeout for worker in workers if worker.job is not None]
            pause = max(min(ends) - time.monotonic(), 0) if ends else None
        done, _ = wait([worker.future for worker in workers], pause, FIRST_COMPLETED)
        ended = [worker for worker in workers if worker.future in done]
        return ended + [worker for worker in workers if worker.end_late(self.timeout)]


@dataclass(frozen=True)
class _Job:
    """A task with its name and the number of this try."""

    key: str
    task: Any
    tries: int = 1


class _Worker:
    """One process, with at most one task at a time.

    Each is a pool of its own: where a process of a pool dies, all tasks of the pool are lost.
    """

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, context, _prepare)
        with _one_thread(), _interrupts_blocked():
            self.future: Future[Any] = self._pool.submit(os.getpid)  # starts the process
        (self._process,) = self._pool._processes.values()
        self.job: _Job | None = None
        self.since = time.monotonic()
        self._late = False

    @property
    def idle(self) -> bool:
        """Whether the process has started and has no task."""
        return self.job is None and self.future.done() and self.future.exception() is None

    def start(self, function: Callable[..., Any], job: _Job, logs: Path | None) -> None:
        """Send a task to the process."""
        self.job, self.since = job, time.monotonic()
        try:
            self.future = self._pool.submit(run_task, job.key, function, job.task, logs)
        except BrokenProcessPool as error:  # it died while it was idle
            self.future = Future()
            self.future.set_exception(error)

    def outcome(self, job: _Job | None) -> TaskOutcome[Any] | None:
        """Return the outcome of the task ``job``, or of the start; None if the process died."""
        key, tries = ("start", 1) if job is None else (job.key, job.tries)
        try:
            result = self.future.result()
        except BrokenProcessPool:
            self.stop()
            return None
        except Exception as error:
            return TaskOutcome(key, error=f"task or result cannot be sent: {error}", tries=tries)
        return TaskOutcome(key) if job is None else replace(result, tries=tries)

    def end_late(self, timeout: float | None) -> bool:
        """Kill the process if its task has run longer than ``timeout``; return whether it has."""
        if timeout is None or self.job is None or self.future.done():
            return False
        self._late = time.monotonic() - self.since >= timeout
        if self._late:
            self._process.kill()
        return self._late

    def reason(self) -> str:
        """Return one line that says why a stopped process ended."""
        if self._late:
            return f"still running after {time.monotonic() - self.since:.0f} s, so it was stopped"
        code = self._process.exitcode
        if code is not None and code < 0:
            return f"the worker process was ended by signal {signal.Signals(-code).name}"
        return f"the worker process ended with exit code {code}"

    def stop(self) -> None:
        """End the process: let it end by itself if it is idle, kill it if it runs a task."""
        if not self.future.done():
            self._process.kill()
        self._pool.shutdown()


def _startup_error(worker: _Worker) -> PhysionError:
    return PhysionError(
        f"worker processes end before they start working ({worker.reason()}); a script that "
        "starts them needs: if __name__ == '__main__':"
    )


def _prepare() -> None:
    """Prepare a new worker process: it leaves Ctrl-C to its parent, and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = multiprocessing.parent_process()
    assert parent is not None, "this runs in a child process"

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Start child processes with Ctrl-C blocked, until they ignore it (`_prepare`).

    Otherwise Ctrl-C while a child imports would print the child's traceback. This process handles
    one that comes in the meantime at the end of the block.
    """
    if not hasattr(signal, "pthread_sigmask"):  # pragma: no cover - Windows
        yield
        return
    # Started first, since the start of this helper process of Python unblocks Ctrl-C.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Limit child processes to one thread of linear algebra each: there is one process per core."""
    missing = {name: value for name, value in ONE_THREAD.items() if name not in os.environ}
    os.environ.update(missing)
    try:
        yield
    finally:
        for name in missing:
            del os.environ[name]


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
