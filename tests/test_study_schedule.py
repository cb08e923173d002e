"""The schedule of `benchmarks/trials/study_plan.py`, compared with closed forms."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest

FILE = Path(__file__).parents[1] / "benchmarks" / "trials" / "study_schedule.py"


@pytest.fixture(scope="module")
def study() -> Any:
    spec = importlib.util.spec_from_file_location("study_schedule", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # a dataclass looks its module up
    spec.loader.exec_module(module)
    return module


def length(study: Any, tasks: list[Any], cores: int, devices: int = 0) -> float:
    return float(max(study.schedule(tasks, cores, devices).values()))


@pytest.mark.parametrize(("count", "cores"), [(1, 1), (7, 3), (9, 3), (17, 64), (100, 7)])
def test_equal_tasks_take_whole_turns(study: Any, count: int, cores: int) -> None:
    tasks = [study.Task(f"t{number}", "s", 2.5) for number in range(count)]
    assert length(study, tasks, cores) == 2.5 * -(-count // cores)


def test_a_chain_takes_its_sum_on_any_number_of_cores(study: Any) -> None:
    chain = [study.Task("t0", "s", 1.0)]
    chain += [study.Task(f"t{n}", "s", n + 1.0, after=(f"t{n - 1}",)) for n in range(1, 6)]
    ends = study.schedule(chain[::-1], 8, 0)
    assert [ends[f"t{n}"] for n in range(6)] == [1, 3, 6, 10, 15, 21]


def test_one_core_takes_the_sum_of_all_tasks(study: Any) -> None:
    tasks = [study.Task(f"t{n}", "s", float(n)) for n in range(1, 10)]
    tasks.append(study.Task("last", "s", 5.0, after=("t3", "t9", "t3")))
    assert length(study, tasks, 1) == 45 + 5


def test_longest_first_as_in_grahams_example(study: Any) -> None:
    """On m cores 2 m + 1 tasks take 4 m - 1, where the shortest schedule has 3 m (Graham 1969)."""
    for m in (2, 3, 5):
        sizes = [m, *range(m, 2 * m), *range(m, 2 * m)]
        tasks = [study.Task(f"t{n:02}", "s", float(size)) for n, size in enumerate(sizes)]
        assert len(tasks) == 2 * m + 1
        assert length(study, tasks, m) == 4 * m - 1


def test_cores_and_devices_are_held_until_the_end(study: Any) -> None:
    on_devices = [study.Task(f"d{n}", "s", 4.0, cores=3, devices=1) for n in range(4)]
    assert length(study, on_devices, 64, 2) == 8, "a device each, two at a time"
    assert length(study, on_devices, 5, 2) == 16, "the cores suffice for one at a time"
    small = [study.Task(f"c{n}", "s", 2.0) for n in range(4)]
    assert length(study, [*on_devices, *small], 8, 2) == 8, "small ones use the cores that are left"


def test_what_can_never_run_is_an_error(study: Any) -> None:
    with pytest.raises(ValueError, match="big needs 2 cores"):
        study.schedule([study.Task("big", "s", 1.0, cores=2)], 1, 0)
    with pytest.raises(ValueError, match="d needs 1 cores and 1 devices"):
        study.schedule([study.Task("d", "s", 1.0, devices=1)], 1, 0)
    circle = [study.Task("a", "s", 1.0, after=("b",)), study.Task("b", "s", 1.0, after=("a",))]
    with pytest.raises(ValueError, match="a waits for a task that never ends"):
        study.schedule(circle, 1, 0)
