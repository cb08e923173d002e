"""Options of the command line that say where tasks run."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from physion.compute.executor import Executor
from physion.compute.local import TRIES, LocalExecutor
from physion.errors import BadInputError


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
