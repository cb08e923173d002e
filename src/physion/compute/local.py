"""Executors on this machine: one in the calling process, and one with a pool of processes."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Self, TypeVar

from physion.compute.tasks import ONE_THREAD, TRIES, TaskOutcome, run_task
from physion.core.errors import PhysionError

T = TypeVar("T")
R = TypeVar("R")

_READY = "ready"
_EXIT_SECONDS = 5.0
"""Seconds to wait for a process to end by itself before it is killed."""


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
            worker.pipe.close()  # all end at the same time
        for worker in workers:
            worker.stop()

    def map(self, function: Callable[[T], R], tasks: Mapping[str, T]) -> Iterator[TaskOutcome[R]]:
        """Yield outcomes as they come; see `physion.compute.tasks.Executor`."""
        waiting = deque(_QueuedTask(key, task) for key, task in tasks.items())
        workers = self._start_workers(function, min(self.workers, len(tasks)))
        failed_starts = 0
        try:
            workers = self._assign(workers, waiting)
            while workers:
                done: list[TaskOutcome[R]] = []
                for worker in self._wait(workers):
                    outcome = worker.listen(self.timeout)
                    if outcome is not None:
                        done.append(outcome)
                    failed_starts = 0 if worker.ready else failed_starts + worker.lost
                    if worker.lost:
                        workers.remove(worker)
                        done += self._take_back(worker, waiting)
                        if failed_starts >= self.tries:
                            raise _startup_error(worker)
                        if waiting:
                            workers.append(_Worker(function, self.logs))
                # Before yielding, so that workers are busy while the caller handles the outcomes.
                workers = self._assign(workers, waiting)
                yield from done
        finally:
            for worker in workers:
                worker.stop()

    def _start_workers(self, function: Callable[..., Any], count: int) -> list[_Worker]:
        """Return ``count`` processes for ``function``: kept ones, and new ones for the rest."""
        workers = [self._kept.pop() for _ in range(min(count, len(self._kept)))]
        for worker in workers:
            worker.take(function)
        return workers + [_Worker(function, self.logs) for _ in range(count - len(workers))]

    def _assign(self, workers: list[_Worker], waiting: deque[_QueuedTask]) -> list[_Worker]:
        """Give a task to each idle worker, keep or stop those that have none; return the others."""
        busy = []
        for worker in workers:
            if worker.job is None and worker.ready and waiting:
                worker.start(waiting.popleft())
            if worker.job is not None or waiting:
                busy.append(worker)
            elif self._blocks:
                self._kept.append(worker)
            else:
                worker.stop()
        return busy

    def _wait(self, workers: list[_Worker]) -> list[_Worker]:
        """Wait until workers send a message, die or exceed the timeout; return these workers."""
        things: list[Any] = [worker.pipe for worker in workers]
        things += [worker.process.sentinel for worker in workers]
        pause = None
        if self.timeout is not None:
            ages = [time.monotonic() - worker.since for worker in workers if worker.job]
            pause = max(self.timeout - max(ages), 0) if ages else None
        ready = wait(things, pause)
        return [
            worker
            for worker in workers
            if worker.pipe in ready
            or worker.process.sentinel in ready
            or worker.overdue(self.timeout)
        ]

    def _take_back(self, worker: _Worker, waiting: deque[_QueuedTask]) -> list[TaskOutcome[Any]]:
        """Queue the task of a dead worker again, or return a failed outcome after the last try."""
        job = worker.job
        worker.stop()
        if job is None:
            return []
        if job.tries >= self.tries:
            return [TaskOutcome(job.key, error=worker.reason(), tries=job.tries)]
        # At the end of the queue, so that a task that kills workers does not delay the others.
        waiting.append(_QueuedTask(job.key, job.task, job.tries + 1))
        return []


@dataclass(frozen=True)
class _QueuedTask:
    """A task with its name and the number of this try."""

    key: str
    task: Any
    tries: int = 1


@dataclass(frozen=True)
class _NextFunction:
    """Message to a worker process: the function of the tasks that follow."""

    function: Callable[..., Any]


class _Worker:
    """Parent's handle of one worker process, which has at most one task at a time."""

    def __init__(self, function: Callable[..., Any], logs: Path | None) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, far = context.Pipe()
        self.process: BaseProcess = context.Process(
            target=_serve, args=(far, function, logs), daemon=True
        )
        with _one_thread(), _interrupts_blocked():
            self.process.start()
        # Only the child holds the far end now, so its death closes the pipe.
        far.close()
        self.job: _QueuedTask | None = None
        self.ready, self.lost, self.since = False, False, time.monotonic()
        self._late = False

    def take(self, function: Callable[..., Any]) -> None:
        """Send the function of the next tasks to a process that was kept."""
        self._send(_NextFunction(function))

    def start(self, job: _QueuedTask) -> None:
        """Send a task to the process."""
        self.job, self.since = job, time.monotonic()
        self._send((job.key, job.task))

    def _send(self, message: object) -> None:
        # A worker that has just died is noticed at the next wait, and its task is queued again.
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.pipe.send(message)

    def overdue(self, timeout: float | None) -> bool:
        """Return whether the task has run longer than ``timeout`` seconds."""
        if timeout is None or self.job is None:
            return False
        return time.monotonic() - self.since >= timeout

    def listen(self, timeout: float | None) -> TaskOutcome[Any] | None:
        """Return the outcome that the worker sent, or None; set ``lost`` if the worker is gone."""
        try:
            if self.pipe.poll():
                message: Any = self.pipe.recv()
                if message == _READY:
                    self.ready = True
                    return None
                job, self.job = self.job, None
                assert job is not None and message.key == job.key, (
                    "a worker answers the task that it was given"
                )
                outcome: TaskOutcome[Any] = dataclasses.replace(message, tries=job.tries)
                return outcome
        except (EOFError, ConnectionResetError):
            self.lost = True
            return None
        self._late = self.overdue(timeout)
        self.lost = self._late or not self.process.is_alive()
        return None

    def reason(self) -> str:
        """Return one line that says why a stopped process ended."""
        if self._late:
            return f"still running after {time.monotonic() - self.since:.0f} s, so it was stopped"
        code = self.process.exitcode
        if code is not None and code < 0:
            return f"the worker process was ended by signal {signal.Signals(-code).name}"
        return f"the worker process ended with exit code {code}"

    def stop(self) -> None:
        """End the process: let it finish if it is idle, kill it if it runs a task."""
        self.pipe.close()
        idle = self.ready and self.job is None
        # A lost process is ending by itself; its exit code says why; after a kill it would not.
        self.process.join(_EXIT_SECONDS if idle or (self.lost and not self._late) else 0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _startup_error(worker: _Worker) -> PhysionError:
    return PhysionError(
        f"worker processes end before they start working ({worker.reason()}); a script that "
        "starts them needs: if __name__ == '__main__':"
    )


def _serve(pipe: Connection, function: Callable[..., Any], logs: Path | None) -> None:
    """Run the tasks that come through the pipe, in the worker process, until it is closed."""
    # Ctrl-C is sent to all processes of the group; only the parent reacts to it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        pipe.send(_READY)
        while True:
            message = pipe.recv()
            if isinstance(message, _NextFunction):
                function = message.function
                continue
            key, task = message
            outcome = run_task(key, function, task, logs)
            try:
                pipe.send(outcome)
            except (BrokenPipeError, ConnectionResetError):
                raise
            except Exception as error:
                pipe.send(TaskOutcome(key, error=f"the result cannot be sent: {error}"))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Start child processes with Ctrl-C blocked, until they ignore it (`_serve`).

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
