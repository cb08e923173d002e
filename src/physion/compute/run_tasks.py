"""Run many tasks that write files: a failed task does not stop the others, a full disk stops all.

Generation of trials, export as shards, and export to and import from the official layout work in
this way.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

from physion.compute.local import TRIES, LocalExecutor
from physion.compute.tasks import Executor, Progress, TaskOutcome, tracked
from physion.core.errors import BadInputError, PhysionError

T = TypeVar("T")
R = TypeVar("R")

FATAL_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EIO}
"""System errors that every later task would meet too, such as a full disk."""


@dataclass(frozen=True)
class RunReport:
    """Result of a run over many trials.

    Parameters
    ----------
    made, kept
        Names of the trials that were written, and of those that existed before.
    failed
        Reason of the failure by name of the trial or file.
    index
        Path of the list of all trials in the folder.
    notes
        Remarks by name of the trial, such as what an import had to guess.
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
    """Run ``function`` on every task; an error in one task is recorded and the others go on.

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
    if executor is None:
        from physion.compute.local import LocalExecutor

        executor = LocalExecutor()
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
    tries: int = TRIES
    """How often a task is started, if its process or job ends without a result."""
    task_minutes: float | None = None
    """Limit of a task in minutes; a task of Slurm has 60 if this is not given."""
    task_cpus: int = 1
    """Processor cores of a task, on Slurm and Ray."""
    task_gpus: float = 0
    """Graphics cards of a task, on Slurm and Ray; Ray also takes fractions."""
    task_memory_gb: float | None = None
    """Memory of a task, on Slurm and Ray."""
    task_logs: Path | None = None
    """Folder for a log of each task; on Slurm it must be one that all nodes see. Default:
    runs/slurm for Slurm, else none."""
    jobs: int = 100
    """Jobs of Slurm at a time."""
    tasks_per_job: int = 1
    """Tasks that a job of Slurm runs one after the other."""
    partition: str = ""
    """Partition of Slurm."""
    slurm: tuple[str, ...] = ()
    """Further options of sbatch as NAME=VALUE, such as account=physics."""
    ray_address: str = ""
    """Address of a Ray cluster, or auto; default: Ray is started on this machine."""

    def open(self) -> Executor:
        """Return the executor; raise `BadInputError` for options that it cannot take."""
        if self.executor == "slurm":
            return self._open_slurm()
        seconds = None if self.task_minutes is None else self.task_minutes * 60
        if seconds is not None and seconds <= 0:
            raise BadInputError(f"--task-minutes must be above 0, not {self.task_minutes}")
        if self.executor == "ray":
            from physion.compute.ray import RayExecutor

            return RayExecutor(
                self.ray_address,
                workers=self.workers,
                cpus=self.task_cpus,
                gpus=self.task_gpus,
                memory_gb=self.task_memory_gb,
                tries=self.tries,
                timeout=seconds,
                logs=self.task_logs,
            )
        return LocalExecutor(self.workers, tries=self.tries, timeout=seconds, logs=self.task_logs)

    def _open_slurm(self) -> Executor:
        from physion.compute.slurm import SlurmExecutor, SlurmJobSettings

        if self.task_gpus != int(self.task_gpus):
            raise BadInputError(f"Slurm gives whole graphics cards, not {self.task_gpus}")
        pairs = [text.partition("=") for text in self.slurm]
        if any(not (name and sign) for name, sign, _ in pairs):
            raise BadInputError(f"--slurm takes NAME=VALUE, not {' '.join(self.slurm)!r}")
        minutes = 60 if self.task_minutes is None else max(1, round(self.task_minutes))
        settings = SlurmJobSettings(
            minutes=minutes * max(self.tasks_per_job, 1),
            cpus=self.task_cpus,
            gpus=int(self.task_gpus),
            memory_gb=self.task_memory_gb,
            partition=self.partition,
            jobs=self.jobs,
            tasks_per_job=self.tasks_per_job,
            more={name: value for name, _, value in pairs},
        )
        folder = self.task_logs if self.task_logs is not None else Path("runs/slurm")
        return SlurmExecutor(folder, settings, tries=self.tries)
