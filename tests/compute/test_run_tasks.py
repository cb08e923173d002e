"""The loop over tasks: failures are recorded, fatal errors stop the run, progress is shown."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from physion.compute.local import SerialExecutor
from physion.compute.run_tasks import RunReport, run_tasks
from physion.compute.tasks import TaskOutcome, tracked
from physion.core.errors import PhysionError


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
    with pytest.raises(PhysionError, match=r"No space left.*1 of 3 are complete"):
        run_tasks(
            half,
            {"a": 2, "full": -1, "b": 4},
            folder=tmp_path,
            what="halving",
            executor=SerialExecutor(),
            on_outcome=seen.append,
        )
    assert [outcome.key for outcome in seen] == ["a"]


def test_progress_is_shown(tmp_path: Path) -> None:
    steps: list[tuple[str, int, int]] = []

    def note(what: str, done: int, total: int) -> None:
        steps.append((what, done, total))

    run_tasks(
        half, {"a": 2}, folder=tmp_path, what="halving", executor=SerialExecutor(), progress=note
    )
    assert steps == [("halving", 0, 1), ("halving", 1, 1)]
    assert list(tracked([1, 2], "counting", 2, None)) == [1, 2]


def test_an_item_counts_as_done_once_it_was_used() -> None:
    done: list[int] = []
    before = [list(done) for _ in tracked("ab", "counting", 2, lambda *step: done.append(step[1]))]
    assert before == [[0], [0, 1]] and done == [0, 1, 2]


def test_exit_code(tmp_path: Path) -> None:
    assert RunReport(["a"], [], {}, tmp_path).exit_code == 0
    assert RunReport(["a"], [], {"b": "odd"}, tmp_path).exit_code == 1
