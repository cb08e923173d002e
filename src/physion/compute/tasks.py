"""One task in a worker: its result or its exception as an outcome, and its log."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar, cast

from physion.core.errors import PhysionError
from physion.core.registry import Registry

# Interface of executors, which run one function on many tasks, and the outcome of a task.
#
# A task is a pure function of its description and writes its files atomically, so an interrupted
# task can simply be run again. An executor therefore stores nothing; it guarantees that every task
# ends in exactly one outcome.

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class TaskOutcome(Generic[R]):
    """Result or error of one task.

    Parameters
    ----------
    key
        Name of the task.
    result
        Return value of the function; None if the task failed.
    error
        One line about the failure; None if the task succeeded.
    traceback
        Traceback of the exception; empty if the task succeeded or the worker process died.
    errno
        Error number of the operating system if an ``OSError`` ended the task, else None.
    tries
        How often the task was started; more than 1 if a worker process died.
    """

    key: str
    result: R | None = None
    error: str | None = None
    traceback: str = ""
    errno: int | None = None
    tries: int = 1

    @property
    def value(self) -> R:
        """Return value of the function; `PhysionError` if the task failed."""
        if self.error is not None:
            raise PhysionError(f"{self.key}: {self.error}")
        return cast(R, self.result)


class Executor(Protocol):
    """Runner of tasks; see `executors` for the implementations."""

    def map(self, function: Callable[[T], R], tasks: Mapping[str, T]) -> Iterator[TaskOutcome[R]]:
        """Run ``function`` on every task and yield outcomes as they come, in any order.

        An exception of the function becomes a failed outcome and is not retried: the same task
        would fail in the same way. If a worker process dies, its task is retried a limited number
        of times. Closing the iterator stops all running tasks.
        """
        ...


def workers_kept(executor: Executor) -> AbstractContextManager[object]:
    """Return a context in which an executor keeps its processes from one `map` to the next.

    That of an executor that has none, such as one that runs tasks as jobs of a cluster, is empty.
    """
    return executor if isinstance(executor, AbstractContextManager) else nullcontext()


executors: Registry[type] = Registry(
    "executor",
    {
        "local": "physion.compute.local:LocalExecutor",
        "serial": "physion.compute.local:SerialExecutor",
        "slurm": "physion.compute.slurm:SlurmExecutor",
        "ray": "physion.compute.ray:RayExecutor",
    },
)


_NAME_BYTES = 80
"""Longest readable part of the name of a log."""


def run_task(
    key: str, function: Callable[[T], R], task: T, logs: Path | None = None
) -> TaskOutcome[R]:
    """Run the function; return its result, or its exception as a failed outcome.

    With ``logs``, what the task and its libraries print is appended to a file of its own in this
    folder, with the traceback of a failure.
    """
    if logs is None:
        return _run(key, function, task)
    with _printing_into(log_path(logs, key)):
        outcome = _run(key, function, task)
        print(outcome.traceback.rstrip() or f"{key}: done", flush=True)
    return outcome


def log_path(logs: Path, key: str) -> Path:
    """Return the path of the log of a task; different keys have different names."""
    readable = re.sub(r"[^A-Za-z0-9._-]+", "-", key)[:_NAME_BYTES].strip("-.") or "task"
    if readable != key:
        readable += "-" + hashlib.sha256(key.encode()).hexdigest()[:8]
    return logs / f"{readable}.log"


def _run(key: str, function: Callable[[T], R], task: T) -> TaskOutcome[R]:
    try:
        return TaskOutcome(key, function(task))
    except Exception as error:
        number = error.errno if isinstance(error, OSError) else None
        text = " ".join(str(error).split()) or "no message"
        line = text if isinstance(error, PhysionError) else f"{type(error).__name__}: {text}"
        return TaskOutcome(key, error=line, traceback=traceback.format_exc(), errno=number)


@contextlib.contextmanager
def _printing_into(path: Path) -> Iterator[None]:
    """Lead standard output and error of the process, compiled code included, into a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    with path.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    try:
        # Other objects may stand in the place of the streams, such as those of a test.
        with (
            os.fdopen(os.dup(1), "w", encoding="utf-8") as out,
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(out),
        ):
            yield
    finally:
        for number, descriptor in zip((1, 2), kept, strict=True):
            os.dup2(descriptor, number)
            os.close(descriptor)


# Callback through which long-running functions report how far they are.


class Progress(Protocol):
    """Callback that is called after each step, and with ``done`` 0 where a loop begins.

    `physion.cli.output.Stages` is the one of the command line.
    """

    def __call__(self, what: str, done: int, total: int, /) -> None:
        """Show that ``done`` of ``total`` steps of the stage ``what`` are finished."""
        ...


def tracked(items: Iterable[T], what: str, total: int, progress: Progress | None) -> Iterator[T]:
    """Yield ``items``, of which there are ``total``; ``progress`` learns when each was used."""
    if progress is None:
        yield from items
        return
    progress(what, 0, total)
    for done, item in enumerate(items, start=1):
        yield item
        progress(what, done, total)


# The machine on which something was measured.


def processor() -> str:
    """Return the name of the processor, or its kind where the system does not tell the name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()


def processor_and_cores() -> str:
    """Return the name of the processor with the number of its cores."""
    return f"{processor()}, {os.cpu_count()} cores"
