"""Tasks and executors: their interface, the outcome of a task, its limits, its log.

An executor runs one function on many tasks. A task is a pure function of its description and writes
its files atomically, so an interrupted task can simply be run again. An executor therefore stores
nothing; it guarantees that every task ends in exactly one outcome. `physion.compute.run_tasks` is
how the package runs tasks that write files.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, Protocol, TypeVar, cast

from physion.core.errors import BadInputError, PhysionError, one_line
from physion.core.files import digest_of
from physion.core.registry import Registry

T = TypeVar("T")
R = TypeVar("R")

TRIES = 3
"""How often a task is started before it counts as failed because its process or job ended."""
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of a task with one core: libraries of linear algebra use one thread."""
_NAME_BYTES = 80
"""Longest readable part of the name of a log."""


@dataclass(frozen=True)
class TaskOutcome(Generic[R]):
    """Result or error of one task.

    - ``key``: name of the task.
    - ``result``: return value of the function; None if the task failed.
    - ``error``: one line about the failure; None if the task succeeded.
    - ``traceback``: traceback of the exception; empty if the task succeeded or the worker process
      died.
    - ``errno``: error number of the operating system if an ``OSError`` ended the task, else None.
    - ``tries``: how often the task was started; more than 1 if a worker process died.
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
        return cast("R", self.result)


class Executor(Protocol):
    """Runner of tasks; see `executors` and `SerialExecutor` for the implementations."""

    def map(self, function: Callable[[T], R], tasks: Mapping[str, T]) -> Iterator[TaskOutcome[R]]:
        """Run ``function`` on every task and yield outcomes as they come, in any order.

        An exception of the function becomes a failed outcome and is not retried: the same task
        would fail in the same way. If a worker process dies, its task is retried a limited number
        of times. Closing the iterator stops all running tasks.
        """
        ...


def workers_kept(executor: Executor) -> AbstractContextManager[object]:
    """Return a context in which an executor keeps its processes from one `map` to the next.

    The context of an executor without processes, such as one that runs tasks as jobs of a cluster,
    is empty.
    """
    return executor if isinstance(executor, AbstractContextManager) else nullcontext()


executors: Registry[type] = Registry(
    "executor",
    {
        "local": "physion.compute.local:LocalExecutor",
        "slurm": "physion.compute.slurm:SlurmExecutor",
        "ray": "physion.compute.ray:RayExecutor",
    },
)


@dataclass(frozen=True)
class TaskSettings:
    """Limits of a task and what it takes; on the command line ``--task NAME=VALUE``.

    - ``tries``: how often a task is started, if its process or job ends without a result.
    - ``minutes``: limit of a task; on Slurm 60 if it is not given.
    - ``cpus``, ``gpus``, ``memory_gb``: what a task takes, on Slurm and Ray. On Ray, fractions of a
      graphics card let tasks share it.
    - ``logs``: folder for a log of each task, on clusters one that all nodes see; on Slurm by
      default ``runs/slurm``, else there are no logs.
    - ``jobs``: jobs of Slurm at a time. ``per_job``: tasks that a job runs one after the other,
      since short jobs cost the cluster more than they do. ``partition``: of Slurm. ``sbatch``:
      further options of sbatch by name, as in ``--task sbatch.account=physics``.
    - ``address``: of a Ray cluster, or ``auto``; if empty, Ray is started on this machine.
    """

    tries: int = TRIES
    minutes: float | None = None
    cpus: int = 1
    gpus: float = 0
    memory_gb: float | None = None
    logs: Path | None = None
    jobs: int = 100
    per_job: int = 1
    partition: str = ""
    sbatch: Mapping[str, str] = field(default_factory=dict)
    address: str = ""

    def __post_init__(self) -> None:
        """Raise `BadInputError` for numbers below what they must be."""
        for name in ("tries", "cpus", "jobs", "per_job"):
            if getattr(self, name) < 1:
                raise BadInputError(f"{name} of a task must be 1 or more")
        if self.gpus < 0 or (self.minutes is not None and self.minutes <= 0):
            raise BadInputError("minutes of a task must be above 0, and gpus not below")

    @property
    def seconds(self) -> float | None:
        """Limit of a task in seconds, or None."""
        return None if self.minutes is None else 60 * self.minutes


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
        readable += "-" + digest_of(key)[:8]
    return logs / f"{readable}.log"


def _run(key: str, function: Callable[[T], R], task: T) -> TaskOutcome[R]:
    try:
        return TaskOutcome(key, function(task))
    except Exception as error:
        number = error.errno if isinstance(error, OSError) else None
        return TaskOutcome(
            key, error=one_line(error), traceback=traceback.format_exc(), errno=number
        )


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
        # Other objects may stand in the place of the streams, such as in a test.
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


# Progress: a callback through which long-running functions report how far they are.


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
