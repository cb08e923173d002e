"""Interface of executors, which run one function on many tasks, and the outcome of a task.

A task is a pure function of its description and writes its files atomically, so an interrupted
task can simply be run again. An executor therefore stores nothing; it guarantees that every task
ends in exactly one outcome.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar, cast

from physion.errors import PhysionError
from physion.registry import Registry

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
