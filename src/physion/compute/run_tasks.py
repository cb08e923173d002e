"""Run many tasks that write files: a failed task does not stop the others, a full disk stops all.

Generation of trials, and export to and import from the official layout work in this way.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

from physion.compute.local import LocalExecutor
from physion.compute.tasks import Executor, Progress, TaskOutcome, TaskSettings, tracked
from physion.core.errors import PhysionError
from physion.core.settings import read_pairs

T = TypeVar("T")
R = TypeVar("R")

FATAL_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EIO}
"""System errors that every later task would meet too, such as a full disk."""


@dataclass(frozen=True)
class RunReport:
    """Result of a run over many trials.

    - ``made``, ``kept``: names of the trials that were written, and of those that existed before.
    - ``failed``: reason of the failure by name of the trial or file.
    - ``index``: path of the list of all trials in the folder.
    - ``notes``: remarks by name of the trial, such as what an import had to guess.
    """

    made: Sequence[str]
    kept: Sequence[str]
    failed: Mapping[str, str]
    index: Path
    notes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """Exit status of the command line: 1 if something failed, else 0."""
        return 1 if self.failed else 0


def run_tasks(
    function: Callable[[T], R],
    tasks: Mapping[str, T],
    *,
    folder: Path,
    what: str,
    executor: Executor | None = None,
    progress: Progress | None = None,
    on_outcome: Callable[[TaskOutcome[R]], None] | None = None,
) -> tuple[dict[str, R], dict[str, str]]:
    """Run ``function`` on every task; an error in one task is recorded and the others continue.

    Parameters
    ----------
    function
        Pure function of a task that writes the task's files.
    tasks
        Tasks by name.
    folder
        Folder that the tasks write into; named in errors.
    what
        Label of the progress, such as ``generating``.
    executor
        Where to run; by default one process per core.
    progress
        Shows the progress.
    on_outcome
        Called with each outcome as it comes.

    Returns
    -------
    results, failed
        Results in the order of ``tasks``, and the reasons of failures, both by name.

    Raises
    ------
    PhysionError
        If nothing more can be written into ``folder`` (see `FATAL_ERRNOS`).
    """
    executor = executor if executor is not None else LocalExecutor()
    results: dict[str, R] = {}
    failed: dict[str, str] = {}
    outcomes = executor.map(function, tasks)
    try:
        for outcome in tracked(outcomes, what, len(tasks), progress):
            if outcome.error is None:
                results[outcome.key] = outcome.value
            elif outcome.errno in FATAL_ERRNOS:
                raise PhysionError(
                    f"cannot write into {folder}: {outcome.error}; {len(results)} of {len(tasks)} "
                    "are complete, and the same command continues from there"
                )
            else:
                failed[outcome.key] = outcome.error
            if on_outcome is not None:
                on_outcome(outcome)
    finally:
        # Workers must have stopped before another process may lock the folder.
        if isinstance(outcomes, Generator):
            outcomes.close()
    return {name: results[name] for name in tasks if name in results}, failed


# Options of the command line that say where tasks run.


@dataclass(frozen=True)
class ExecutorSettings:
    """Where tasks run, and their limits."""

    executor: Literal["local", "slurm", "ray"] = "local"
    """Where tasks run: in processes of this machine, as jobs of Slurm, or on Ray."""
    workers: int = os.cpu_count() or 1
    """Processes of the executor local, or cores of a Ray that is started on this machine."""
    task: tuple[str, ...] = ()
    """Limits and needs of a task: tries, minutes, cpus, gpus, memory_gb, logs; on Slurm also jobs,
    per_job, partition and sbatch.NAME; on Ray also address. Example: --task minutes=240 gpus=1
    partition=gpu."""

    def open(self) -> Executor:
        """Return the executor; raise `BadInputError` for limits that it cannot take."""
        limits = read_pairs(TaskSettings, self.task, "--task")
        if self.executor == "slurm":
            from physion.compute.slurm import SlurmExecutor

            return SlurmExecutor(limits)
        if self.executor == "ray":
            from physion.compute.ray import RayExecutor

            return RayExecutor(limits, self.workers)
        return LocalExecutor(
            self.workers, tries=limits.tries, timeout=limits.seconds, logs=limits.logs
        )
