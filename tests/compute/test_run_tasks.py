"""The loop over tasks: failures are recorded, fatal errors stop the run, progress is shown."""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest

from physion.compute.executor import TaskOutcome
from physion.compute.local import SerialExecutor
from physion.compute.progress import tracked
from physion.compute.run_tasks import RunReport, run_tasks
from physion.errors import PhysionError

T = TypeVar("T")


def half(number: int) -> float:
    """Return half of a number; fail for odd ones, and as on a full disk for negative ones."""
    if number < 0:
        raise OSError(errno.ENOSPC, "No space left on device")
    if number % 2:
        raise PhysionError("odd")
    return number / 2


def test_a_failed_task_does_not_stop_the_others(tmp_path: Path) -> None:
    seen: list[TaskOutcome[float]] = []
    results, failed = run_tasks(
        half,
        {"b": 4, "odd": 3, "a": 2},
        folder=tmp_path,
        what="halving",
        executor=SerialExecutor(),
        on_outcome=seen.append,
    )
    assert list(results.items()) == [("b", 2.0), ("a", 1.0)] and failed == {"odd": "odd"}
    assert [outcome.key for outcome in seen] == ["b", "odd", "a"]


def test_a_full_disk_stops_the_run(tmp_path: Path) -> None:
    seen: list[TaskOutcome[float]] = []
    with pytest.raises(PhysionError, match=r"No space left.*1 new trials are complete"):
        run_tasks(
            half,
            {"a": 2, "full": -1, "b": 4},
            folder=tmp_path,
            what="halving",
            executor=SerialExecutor(),
            on_outcome=seen.append,
        )
    assert [outcome.key for outcome in seen] == ["a"]


class Recorder:
    """Records the labels and totals of the loops that it tracks."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []

    def __call__(self, items: Iterable[T], what: str, total: int, /) -> Iterator[T]:
        """Pass the items on."""
        self.calls.append((what, total))
        yield from items


def test_progress_is_shown(tmp_path: Path) -> None:
    track = Recorder()
    run_tasks(
        half, {"a": 2}, folder=tmp_path, what="halving", executor=SerialExecutor(), track=track
    )
    assert list(tracked([1, 2], "counting", 2, track)) == [1, 2]
    assert list(tracked([1, 2], "counting", 2, None)) == [1, 2]
    assert track.calls == [("halving", 1), ("counting", 2)]


def test_exit_code(tmp_path: Path) -> None:
    assert RunReport(["a"], [], {}, tmp_path).exit_code == 0
    assert RunReport(["a"], [], {"b": "odd"}, tmp_path).exit_code == 1
