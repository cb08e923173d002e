"""Executor on a cluster with Slurm: tasks are jobs of job arrays, submitted by submitit.

submitit writes the function and its tasks into a folder that all nodes see, calls ``sbatch``, and
reads the results back. This process waits; if it ends, the same command submits what is missing.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from physion.compute.tasks import ONE_THREAD, TaskOutcome, TaskSettings, log_path, run_task
from physion.core.errors import BadInputError, MissingExtraError, PhysionError

T = TypeVar("T")
R = TypeVar("R")

_MINUTES = 60
"""Limit of a task that has none of its own."""
_ARRAY_JOBS = 1000
"""Jobs of one array; Slurm refuses more than 1001 unless it is configured otherwise."""


class SlurmExecutor:
    """Executor that runs tasks as jobs of Slurm.

    A job that ends without results (its node failed, its time or memory was used up) is submitted
    again, each of its tasks in a job of its own, so that one bad task costs the others nothing.

    Parameters
    ----------
    settings
        What a task takes and its limits. The folder of logs is one that all nodes see: it holds
        jobs (``jobs/``) and a log of each task (``logs/``). Only the user may be able to write
        there, since Python objects are read from it.
    check_seconds
        Seconds between questions to Slurm about the state of jobs.
    grace_seconds
        Seconds to wait for the result of a job that has ended, for slow file systems.
    """

    def __init__(
        self,
        settings: TaskSettings | None = None,
        *,
        check_seconds: float = 30.0,
        grace_seconds: float = 15.0,
    ) -> None:
        self.settings = settings or TaskSettings()
        if self.settings.gpus != int(self.settings.gpus):
            raise BadInputError(f"Slurm gives whole graphics cards, not {self.settings.gpus}")
        self.folder = (self.settings.logs or Path("runs/slurm")).absolute()
        self.tries, self._check, self._grace = self.settings.tries, check_seconds, grace_seconds
        if shutil.which("sbatch") is None:
            raise BadInputError(
                "sbatch was not found; start the command where jobs of Slurm are submitted, or "
                "leave out --executor slurm"
            )
        try:
            import submitit
        except ImportError as error:
            raise MissingExtraError("the executor slurm", "slurm") from error
        self._submitit: Any = submitit

    def map(self, function: Callable[[T], R], tasks: Mapping[str, T]) -> Iterator[TaskOutcome[R]]:
        """Yield outcomes as they come; see `physion.compute.tasks.Executor`."""
        size = self.settings.per_job
        keys = list(tasks)
        groups = [_Group(tuple(keys[i : i + size])) for i in range(0, len(keys), size)]
        running: dict[Any, _Group] = {}
        try:
            running.update(self._submit(function, tasks, groups))
            asked = time.monotonic()
            while running:
                ask = time.monotonic() - asked >= self._check
                asked = time.monotonic() if ask else asked
                again: list[_Group] = []
                ended = [job for job in running if job.done(force_check=ask)]
                for job in ended:
                    group = running.pop(job)
                    outcomes: Sequence[TaskOutcome[R]] | None = self._results(job)
                    if outcomes is None:
                        # It may still run, if Slurm's account of it was wrong.
                        _cancel([job])
                    if outcomes is not None:
                        yield from (replace(o, tries=group.tries) for o in outcomes)
                    elif group.tries < self.tries:
                        again += [_Group((key,), group.tries + 1) for key in group.keys]
                    else:
                        yield from (self._lost(key, job, group.tries) for key in group.keys)
                if again:
                    running.update(self._submit(function, tasks, again))
                if running and not ended:
                    time.sleep(min(1.0, self._check))
        finally:
            _cancel(running)

    def parameters(self) -> dict[str, Any]:
        """Return what a job asks for, under the names of submitit."""
        task = self.settings
        minutes = _MINUTES if task.minutes is None else max(1, round(task.minutes))
        values: dict[str, Any] = {
            "job_name": "physion",
            "time": minutes * task.per_job,
            "cpus_per_task": task.cpus,
            "array_parallelism": task.jobs,
            "additional_parameters": dict(task.sbatch),
        }
        if task.cpus == 1:
            values["setup"] = [f"export {name}={value}" for name, value in ONE_THREAD.items()]
        if task.gpus:
            values["gpus_per_node"] = int(task.gpus)
        if task.memory_gb is not None:
            values["mem"] = f"{max(1, round(task.memory_gb * 1024))}MB"
        if task.partition:
            values["partition"] = task.partition
        return values

    def _submit(
        self, function: Callable[[T], R], tasks: Mapping[str, T], groups: Sequence[_Group]
    ) -> dict[Any, _Group]:
        """Submit a job for each group, as job arrays, and return the jobs."""
        executor = self._submitit.SlurmExecutor(folder=self.folder / "jobs")
        executor.update_parameters(**self.parameters())
        submitted: dict[Any, _Group] = {}
        for start in range(0, len(groups), _ARRAY_JOBS):
            part = groups[start : start + _ARRAY_JOBS]
            try:
                jobs = executor.map_array(
                    _RunGroup(function, self.folder / "logs"),
                    [[(key, tasks[key]) for key in group.keys] for group in part],
                )
            except (OSError, subprocess.SubprocessError, RuntimeError) as error:
                text = " ".join(str(error).split())
                raise PhysionError(f"the jobs could not be submitted to Slurm: {text}") from error
            submitted.update(zip(jobs, part, strict=True))
        return submitted

    def _results(self, job: Any) -> Sequence[TaskOutcome[Any]] | None:
        """Return the outcomes of an ended job; None if it ended without them."""
        deadline = time.monotonic() + self._grace
        while not job.paths.result_pickle.exists():
            if time.monotonic() >= deadline:
                return None
            time.sleep(min(1.0, max(self._grace, 0.01)))
        failed = job.exception()
        if failed is not None:
            raise PhysionError(f"job {job.job_id} of Slurm failed: {str(failed).splitlines()[-1]}")
        outcomes: Sequence[TaskOutcome[Any]] = job.result()
        return outcomes

    def _lost(self, key: str, job: Any, tries: int) -> TaskOutcome[Any]:
        """Return the outcome of a task whose last job ended without a result."""
        state = job.get_info(mode="force").get("State", "unknown")
        log = log_path(self.folder / "logs", key)
        reason = (
            f"its job {job.job_id} ended in the state {state}; see {log} and {job.paths.stderr}"
        )
        return TaskOutcome(key, error=reason, tries=tries)


def _cancel(jobs: Iterable[Any]) -> None:
    """Cancel jobs; those that have ended are not affected."""
    for job in jobs:
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            job.cancel(check=False)


@dataclass(frozen=True)
class _Group:
    """Names of the tasks of a job, and the number of this try."""

    keys: tuple[str, ...]
    tries: int = 1


@dataclass(frozen=True)
class _RunGroup:
    """Function of a job: runs some tasks one after the other."""

    function: Callable[[Any], Any]
    logs: Path

    def __call__(self, tasks: Sequence[tuple[str, Any]]) -> list[TaskOutcome[Any]]:
        """Return the outcomes of the tasks, in their order."""
        return [run_task(key, self.function, task, self.logs) for key, task in tasks]
