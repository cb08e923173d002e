"""Schedule of tasks on cores and devices, by list scheduling, longest first. Nothing is run.

Whenever a task ends, the ready tasks are looked through from the longest to the shortest, and each
that fits the free cores and devices starts (Graham 1969, "Bounds on multiprocessing timing
anomalies"). `tests/test_study_schedule.py` compares it with closed forms.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Task:
    """Work that holds ``cores`` and ``devices`` for ``seconds``, once the tasks ``after`` ended.

    ``stage``: what it is counted under.
    """

    name: str
    stage: str
    seconds: float
    cores: int = 1
    devices: int = 0
    after: tuple[str, ...] = ()


def schedule(tasks: Sequence[Task], cores: int, devices: int) -> dict[str, float]:
    """Return at which second each task ends, by name.

    Parameters
    ----------
    tasks
        Tasks with different names.
    cores, devices
        What there is.

    Raises
    ------
    ValueError
        If a task needs more than there is, or waits for one that never ends.
    """
    waiting = {task.name: len(set(task.after)) for task in tasks}
    followers: dict[str, list[Task]] = {}
    ready: list[tuple[float, str, Task]] = []
    for task in tasks:
        if task.cores > cores or task.devices > devices:
            raise ValueError(f"{task.name} needs {task.cores} cores and {task.devices} devices")
        for name in set(task.after):
            followers.setdefault(name, []).append(task)
        if not task.after:
            ready.append((-task.seconds, task.name, task))
    heapq.heapify(ready)
    running: list[tuple[float, str, Task]] = []
    ends: dict[str, float] = {}
    now = 0.0
    while ready or running:
        kept = []
        while ready and cores:
            entry = heapq.heappop(ready)
            task = entry[2]
            if task.cores <= cores and task.devices <= devices:
                cores, devices = cores - task.cores, devices - task.devices
                heapq.heappush(running, (now + task.seconds, task.name, task))
            else:
                kept.append(entry)
        for entry in kept:
            heapq.heappush(ready, entry)
        now, name, ended = heapq.heappop(running)
        ends[name] = now
        cores, devices = cores + ended.cores, devices + ended.devices
        for task in followers.get(name, ()):
            waiting[task.name] -= 1
            if not waiting[task.name]:
                heapq.heappush(ready, (-task.seconds, task.name, task))
    if len(ends) < len(tasks):
        never = sorted({task.name for task in tasks} - set(ends))
        raise ValueError(f"{never[0]} waits for a task that never ends")
    return ends
