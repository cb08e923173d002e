"""Executor on Ray: a cluster by its address, or Ray started on this machine.

This process holds the names of tasks and small results; files are written by the tasks.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from physion.compute.local import available_cores
from physion.compute.tasks import ONE_THREAD, TaskOutcome, TaskSettings, run_task
from physion.core.errors import MissingExtraError, PhysionError

T = TypeVar("T")
R = TypeVar("R")

_WAITING_PER_CORE = 2
"""Tasks given to Ray for each core of the cluster; the others wait in this process."""


@dataclass
class _Connection:
    """Connection of this process to Ray.

    It stays between calls of `RayExecutor.map`, since a verb has several and each start takes
    seconds. ``of``: address and workers of the executor that connected; None if none did.
    ``calls``: calls of `map` that are not over.
    """

    of: tuple[str, int] | None = None
    calls: int = 0


_connection = _Connection()


class RayExecutor:
    """Executor that runs tasks on Ray.

    A task whose worker or node ends is started again on another; an exception of the function is
    not retried.

    Parameters
    ----------
    settings
        What a task takes, its limits, and the address of the cluster. Without an address Ray is
        started on this machine by the first call of `map`. It stops when this process ends, when a
        call of `map` is ended early, or when another executor wants another address or number of
        workers. The time of a task includes the start of its worker.
    workers
        Cores of a Ray that is started here; by default all.
    """

    def __init__(self, settings: TaskSettings | None = None, workers: int | None = None) -> None:
        settings = settings or TaskSettings()
        self.address, self.tries, self.timeout = settings.address, settings.tries, settings.seconds
        self.workers = workers if workers is not None else available_cores()
        self.logs = None if settings.logs is None else settings.logs.absolute()
        self._takes: dict[str, Any] = {"num_cpus": settings.cpus, "num_gpus": settings.gpus}
        if settings.memory_gb is not None:
            self._takes["memory"] = int(settings.memory_gb * 2**30)
        try:
            import ray
        except ImportError as error:
            raise MissingExtraError("the executor ray", "ray") from error
        self._ray: Any = ray

    def map(self, function: Callable[[T], R], tasks: Mapping[str, T]) -> Iterator[TaskOutcome[R]]:
        """Yield outcomes as they come; see `physion.compute.tasks.Executor`."""
        if not tasks:
            return
        ray = self._ray
        self._connect()
        running: dict[Any, _Started] = {}
        _connection.calls += 1
        try:
            remote = ray.remote(max_retries=0, **self._takes)(run_task)
            stored = ray.put(function)
            waiting = deque(_Queued(key) for key in tasks)
            window = self._window()
            while waiting or running:
                while waiting and len(running) < window:
                    queued = waiting.popleft()
                    ref = remote.remote(queued.key, stored, tasks[queued.key], self.logs)
                    running[ref] = _Started(queued, time.monotonic())
                ready, _ = ray.wait(list(running), num_returns=1, timeout=self._pause(running))
                for ref in ready:
                    done = running.pop(ref)
                    outcome: TaskOutcome[R] | None = self._collect(ref, done)
                    if outcome is None:
                        waiting.append(replace(done.queued, tries=done.queued.tries + 1))
                    else:
                        yield outcome
                self._stop_late(running)
        finally:
            for ref in running:
                ray.cancel(ref, force=True)
            _connection.calls -= 1
            if running and _connection.of is not None:
                # When this call returns, no task of it writes any more.
                self._disconnect()

    def _window(self) -> int:
        """Return how many tasks Ray is given at a time."""
        cores = self._ray.cluster_resources().get("CPU", 1)
        if self.timeout is None:
            return max(1, int(cores) * _WAITING_PER_CORE)
        # No more than can run, so that the time of a task does not count its waiting.
        return max(1, int(cores / max(self._takes["num_cpus"], 1)))

    def _connect(self) -> None:
        """Connect to the cluster or start Ray on this machine, unless that was done before.

        A Ray to which the caller of this package has connected is used as it is.
        """
        wanted = (self.address, 0 if self.address else self.workers)
        if _connection.of not in (None, wanted):
            if _connection.calls:
                raise PhysionError(
                    "Ray is in use with another address or number of workers; let that call end "
                    "first"
                )
            self._disconnect()
        if not self._ray.is_initialized():
            self._start()
            _connection.of = wanted

    def _disconnect(self) -> None:
        """Leave the cluster, or stop the Ray that was started here."""
        self._ray.shutdown()
        _connection.of = None

    def _start(self) -> None:
        """Connect to the cluster, or start Ray on this machine."""
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
        options["runtime_env"] = {"env_vars": ONE_THREAD}
        if self.address:
            options["address"] = self.address
        else:
            # Without "local" a cluster that runs on this machine would be taken.
            options |= {"address": "local", "num_cpus": self.workers, "include_dashboard": False}
        try:
            self._ray.init(**options)
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            text = " ".join(str(error).split())
            raise PhysionError(f"Ray cannot be reached at {self.address!r}: {text}") from error

    def _collect(self, ref: Any, done: _Started) -> TaskOutcome[Any] | None:
        """Return the outcome of a finished call; None if its task is to be started again."""
        tries = done.queued.tries
        try:
            outcome: TaskOutcome[Any] = self._ray.get(ref)
        except self._ray.exceptions.RayError as error:
            if tries < self.tries:
                return None
            if done.late:
                reason = f"still running after {self.timeout:.0f} s, so it was stopped"
            else:
                reason = f"its worker ended: {' '.join(str(error).split())}"
            return TaskOutcome(done.queued.key, error=reason, tries=tries)
        return replace(outcome, tries=tries)

    def _pause(self, running: Mapping[Any, _Started]) -> float | None:
        """Return how long to wait for a result until the next task exceeds its limit."""
        if self.timeout is None:
            return None
        first = min(started.since for started in running.values())
        return max(0.0, first + self.timeout - time.monotonic()) + 0.1

    def _stop_late(self, running: dict[Any, _Started]) -> None:
        """Stop the tasks that exceed their limit; their calls then fail."""
        if self.timeout is None:
            return
        for started in running.values():
            if not started.late and time.monotonic() - started.since >= self.timeout:
                started.late = True
        for ref, started in running.items():
            if started.late:
                self._ray.cancel(ref, force=True)


@dataclass(frozen=True)
class _Queued:
    """Name of a task, and the number of this try."""

    key: str
    tries: int = 1


@dataclass
class _Started:
    """A task that Ray has, since when, and whether it was stopped for its time."""

    queued: _Queued
    since: float
    late: bool = False
