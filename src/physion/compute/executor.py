"""What an executor is: something that runs one function on many tasks, wherever it likes.

Durability is not its business: a task is a pure function of its description and writes its own
files atomically, so whatever dies can be run again. An executor only promises that every task
ends in exactly one outcome.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar, cast

from physion.errors import PhysionError
from physion.registry import Registry

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class TaskOutcome(Generic[R]):
    """How one task ended.

    - ``key``: the task's name. ``error``: one line, None where the task succeeded.
    - ``traceback``: the worker's own, empty where it succeeded or died without a word.
    - ``errno``: the system's error number where an ``OSError`` ended the task, else None.
    - ``tries``: how often the task was started; more than 1 where a worker died.
    """

    key: str
    result: R | None = None
    error: str | None = None
    traceback: str = ""
    errno: int | None = None
    tries: int = 1

    @property
    def value(self) -> R:
        """What the function returned; `PhysionError` where the task failed."""
        if self.error is not None:
            raise PhysionError(f"{self.key}: {self.error}")
        return cast(R, self.result)


class Executor(Protocol):
    """Runs tasks. Implementations: this machine's processes, Ray, Slurm."""

    def map(self, function: Callable[[T], R], tasks: Mapping[str, T]) -> Iterator[TaskOutcome[R]]:
        """Run ``function`` on every task and yield outcomes as they come, in any order.

        An exception of the function becomes a failed outcome and is not tried again: the same
        task would fail the same way. A worker that dies is replaced and its task is tried
        again, a few times at most. Closing the iterator stops what still runs.
        """
        ...


executors: Registry[type] = Registry(
    "executor",
    {
        "local": "physion.compute.local:LocalExecutor",
        "serial": "physion.compute.local:SerialExecutor",
    },
)
