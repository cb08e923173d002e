"""Tasks of a plan as tasks of an executor, each a cell that a process does by itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from physion.compute.run_tasks import FATAL_ERRNOS
from physion.compute.tasks import Executor, Progress, TaskOutcome
from physion.core.errors import BadInputError, PhysionError
from physion.readout.plans.tasks import EvaluationTask, TrainingTask

C = TypeVar("C")
R = TypeVar("R")
T = TypeVar("T", TrainingTask, EvaluationTask)


def run_cells(
    executor: Executor,
    function: Callable[[C], R],
    cells: Mapping[str, C],
    pending: Sequence[T],
    failed: dict[str, str],
    folder: Path,
    total: int,
    progress: Progress | None,
    on_task: Callable[[T, str, Sequence[T]], None] | None,
) -> Iterator[tuple[str, R]]:
    """Do the pending tasks of a plan; yield the key and the result of each that succeeds.

    Parameters
    ----------
    executor, function
        What does the tasks.
    cells
        Argument of ``function`` by key of the task.
    pending
        The tasks.
    failed
        Reasons by key, to which those of these tasks are added.
    folder, total
        Output folder, and number of tasks of the plan, for messages.
    progress, on_task
        Called after each task; ``on_task`` with the task, the reason if it failed, and those left.

    Raises
    ------
    PhysionError
        If nothing more can be written, or the only task of the plan fails.
    """
    left = {task.key: task for task in pending}
    done = total - len(left)
    if progress is not None:
        progress("plan", 0, len(pending))
    for outcome in executor.map(function, cells):
        task = left.pop(outcome.key)
        if outcome.error is None:
            done += 1
            yield task.key, outcome.value
        else:
            failed[task.key] = _reason(outcome, folder, done, total)
        if progress is not None:
            progress("plan", len(pending) - len(left), len(pending))
        if on_task is not None:
            on_task(task, failed.get(task.key, ""), list(left.values()))


def find_task(tasks: Sequence[T], key: str, what: str) -> T:
    """Return the task of a plan with this key; ``what`` is planned, for the message.

    Raises
    ------
    BadInputError
        If there is none: data, model or code are not those of the process that made the plan.
    """
    for task in tasks:
        if task.key == key:
            return task
    raise BadInputError(
        "this machine has other data, another model or another version of the package than the "
        f"one that planned the {what}"
    )


def _reason(outcome: TaskOutcome[R], folder: Path, done: int, total: int) -> str:
    """Return why a task failed; raise `PhysionError` if the plan cannot go on."""
    reason = str(outcome.error)
    if outcome.errno in FATAL_ERRNOS:
        raise PhysionError(
            f"cannot write into {folder}: {reason}; {done} of {total} are done, and the same "
            "command continues from there"
        )
    if total == 1:
        raise PhysionError(reason)
    return reason
