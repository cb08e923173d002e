"""Executors on this machine: in this process, or in a few processes that may die."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from physion.compute.executor import TaskOutcome
from physion.errors import PhysionError

T = TypeVar("T")
R = TypeVar("R")

TRIES = 3
"""Workers that one task may kill before it is put aside."""
_THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_READY = "ready"
_PATIENCE = 5.0
"""Seconds that an idle or dying process has to end by itself."""


class SerialExecutor:
    """Runs the tasks one after the other in this process: for a debugger, and for tiny sets."""

    def map(self, function: Callable[[T], R], tasks: Mapping[str, T]) -> Iterator[TaskOutcome[R]]:
        """See `physion.compute.executor.Executor`; outcomes come in the order of the tasks."""
        for key, task in tasks.items():
            yield _attempt(key, function, task)


class LocalExecutor:
    """Runs tasks in ``workers`` fresh processes of this machine, one core each.

    Processes are spawned, not forked, so that compiled code and engines start clean. A worker
    that dies (killed, out of memory, a crash in C) is replaced, and its task is tried again up
    to ``tries`` times; the other tasks never notice. ``timeout`` in seconds ends a task that
    hangs, which counts as a death. By default one worker a core.
    """

    def __init__(
        self, workers: int | None = None, *, tries: int = TRIES, timeout: float | None = None
    ) -> None:
        self.workers = workers if workers is not None else _cores()
        if self.workers < 1 or tries < 1:
            raise PhysionError(f"{workers} workers and {tries} tries: both must be at least 1")
        self.tries, self.timeout = tries, timeout

    def map(self, function: Callable[[T], R], tasks: Mapping[str, T]) -> Iterator[TaskOutcome[R]]:
        """See `physion.compute.executor.Executor`."""
        waiting = deque(_Job(key, task) for key, task in tasks.items())
        team = [_Worker(function) for _ in range(min(self.workers, len(tasks)))]
        stillborn = 0
        try:
            while team:
                done: list[TaskOutcome[R]] = []
                for worker in self._woken(team):
                    outcome = worker.listen(self.timeout)
                    if outcome is not None:
                        done.append(outcome)
                    stillborn = 0 if worker.ready else stillborn + worker.lost
                    if worker.lost:
                        team.remove(worker)
                        done += self._bury(worker, waiting)
                        if stillborn >= self.tries:
                            raise _stillborn(worker)
                        if waiting:
                            team.append(_Worker(function))
                # New work first, so that nobody idles while the caller looks at the outcomes.
                team = _hand_out(team, waiting)
                yield from done
        finally:
            for worker in team:
                worker.stop()

    def _woken(self, team: list[_Worker]) -> list[_Worker]:
        """Wait until a worker says something, dies, or has taken too long."""
        things: list[Any] = [worker.pipe for worker in team]
        things += [worker.process.sentinel for worker in team]
        pause = None
        if self.timeout is not None:
            ages = [time.monotonic() - worker.since for worker in team if worker.job]
            pause = max(self.timeout - max(ages), 0) if ages else None
        ready = wait(things, pause)
        return [
            worker
            for worker in team
            if worker.pipe in ready
            or worker.process.sentinel in ready
            or worker.overdue(self.timeout)
        ]

    def _bury(self, worker: _Worker, waiting: deque[_Job]) -> list[TaskOutcome[Any]]:
        """Take back the task of a dead worker, or give it up if it has killed enough of them."""
        job = worker.job
        worker.stop()
        if job is None:
            return []
        if job.tries >= self.tries:
            return [TaskOutcome(job.key, error=worker.last_words(), tries=job.tries)]
        # At the end, so that a poison task does not hold up the others.
        waiting.append(_Job(job.key, job.task, job.tries + 1))
        return []


@dataclass(frozen=True)
class _Job:
    """A task under its name, and which try this is."""

    key: str
    task: Any
    tries: int = 1


class _Worker:
    """The parent's side of one process: at most one task at a time, so blame is certain."""

    def __init__(self, function: Callable[..., Any]) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, far = context.Pipe()
        self.process: BaseProcess = context.Process(
            target=_serve, args=(far, function), daemon=True
        )
        with _one_thread():
            self.process.start()
        # Only the child holds the far end now, so that its death is the end of the pipe.
        far.close()
        self.job: _Job | None = None
        self.ready, self.lost, self.since = False, False, time.monotonic()
        self._late = False

    def start(self, job: _Job) -> None:
        """Hand over a task."""
        self.job, self.since = job, time.monotonic()
        # A worker that died just now is noticed at the next wait, and the task comes back.
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.pipe.send((job.key, job.task))

    def overdue(self, timeout: float | None) -> bool:
        """The task has run longer than ``timeout`` seconds."""
        if timeout is None or self.job is None:
            return False
        return time.monotonic() - self.since >= timeout

    def listen(self, timeout: float | None) -> TaskOutcome[Any] | None:
        """The outcome that the worker sent, or None; sets ``lost`` where it will send no more."""
        try:
            if self.pipe.poll():
                message: Any = self.pipe.recv()
                if message == _READY:
                    self.ready = True
                    return None
                job, self.job = self.job, None
                assert job is not None and message.key == job.key, "answers follow questions"
                outcome: TaskOutcome[Any] = dataclasses.replace(message, tries=job.tries)
                return outcome
        except (EOFError, ConnectionResetError):
            self.lost = True
            return None
        self._late = self.overdue(timeout)
        self.lost = self._late or not self.process.is_alive()
        return None

    def last_words(self) -> str:
        """Why a stopped process is gone, in one line."""
        if self._late:
            return f"still at work after {time.monotonic() - self.since:.0f} s, so it was ended"
        code = self.process.exitcode
        if code is not None and code < 0:
            return f"the worker process was ended by signal {signal.Signals(-code).name}"
        return f"the worker process ended with exit code {code}"

    def stop(self) -> None:
        """End the process: politely where it is idle, at once where it is at work."""
        self.pipe.close()
        idle = self.ready and self.job is None
        # A lost process is ending by itself, and its own exit code says more than a kill.
        self.process.join(_PATIENCE if idle or (self.lost and not self._late) else 0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _hand_out(team: list[_Worker], waiting: deque[_Job]) -> list[_Worker]:
    """Give every idle worker a task; the team without those for whom there is none."""
    staying = []
    for worker in team:
        if worker.job is None and worker.ready and waiting:
            worker.start(waiting.popleft())
        if worker.job is not None or waiting:
            staying.append(worker)
        else:
            worker.stop()
    return staying


def _stillborn(worker: _Worker) -> PhysionError:
    return PhysionError(
        f"worker processes end before they begin ({worker.last_words()}); a script that starts "
        "them needs: if __name__ == '__main__':"
    )


def _serve(pipe: Connection, function: Callable[..., Any]) -> None:
    """The worker's side: run what comes through the pipe until the parent hangs up or dies."""
    # Ctrl-C goes to the whole group of processes; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        pipe.send(_READY)
        while True:
            key, task = pipe.recv()
            outcome = _attempt(key, function, task)
            try:
                pipe.send(outcome)
            except (BrokenPipeError, ConnectionResetError):
                raise
            except Exception as error:
                pipe.send(TaskOutcome(key, error=f"the result cannot be sent: {error}"))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def _attempt(key: str, function: Callable[[T], R], task: T) -> TaskOutcome[R]:
    """Run the function and turn an exception into a failed outcome."""
    try:
        return TaskOutcome(key, function(task))
    except Exception as error:
        number = error.errno if isinstance(error, OSError) else None
        text = " ".join(str(error).split()) or "no message"
        line = text if isinstance(error, PhysionError) else f"{type(error).__name__}: {text}"
        return TaskOutcome(key, error=line, traceback=traceback.format_exc(), errno=number)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Children inherit one thread for their linear algebra: the cores are shared by processes."""
    missing = [name for name in _THREAD_LIMITS if name not in os.environ]
    os.environ.update(dict.fromkeys(missing, "1"))
    try:
        yield
    finally:
        for name in missing:
            del os.environ[name]


def _cores() -> int:
    """Cores that this process may use, which on shared machines are fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
