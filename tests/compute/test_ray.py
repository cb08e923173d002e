"""The executor of Ray, started on this machine."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from physion.compute.ray import RayExecutor
from physion.compute.tasks import TaskSettings, log_path
from support.paths import FIND_TESTS, ROOT
from support.tasks import die_on_two, die_once, fail_on_three, square

ray = pytest.importorskip("ray", reason="the extra 'ray' is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.nightly]


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    """One Ray with two cores for all tests; an executor uses the one that is connected."""
    with pytest.MonkeyPatch.context() as patch:
        path = f"{FIND_TESTS['PYTHONPATH']}{os.pathsep}{ROOT / 'src'}"
        patch.setenv("PYTHONPATH", path)
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        environment = {"env_vars": {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}}
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, runtime_env=environment)
        yield
        ray.shutdown()


STAYS = """
import time
import ray
from physion.compute.ray import RayExecutor
from physion.compute.tasks import TaskSettings
from support.tasks import process_of

def node():
    return ray.get_runtime_context().get_node_id()

from physion.core.errors import PhysionError

executor = RayExecutor(workers=1)
first, second = ({o.value for o in executor.map(process_of, {"a": 1, "b": 2})} for _ in range(2))
assert len(first) == 1 and first == second, (first, second)
before = node()
assert ray.cluster_resources()["CPU"] == 1
outcomes = RayExecutor(workers=2).map(time.sleep, {"short": 0, "long": 600})
next(outcomes)
assert node() != before and ray.cluster_resources()["CPU"] == 2
try:
    next(executor.map(process_of, {"a": 1}))
except PhysionError as error:
    assert "in use" in str(error)
else:
    raise AssertionError("tasks must not run on the Ray of another executor")
outcomes.close()
assert not ray.is_initialized()
# The address of a cluster is not answered by the Ray that was started here.
assert next(executor.map(process_of, {"a": 1})).error is None
class Elsewhere(RayExecutor):
    def _start(self):
        assert not ray.is_initialized()
        raise PhysionError("it looks for the cluster")

try:
    list(Elsewhere(TaskSettings(address="127.0.0.1:1")).map(process_of, {"a": 1}))
except PhysionError as error:
    assert "looks for the cluster" in str(error)
else:
    raise AssertionError("tasks must not run on the Ray that was started here")
"""


def test_ray_started_here_stays_for_the_next_call_until_one_is_ended_early() -> None:
    # In a process of its own, since Ray of this one was started by the fixture.
    # A cluster that the environment names is not used without an address; nobody answers there.
    environment = os.environ | {"RAY_ADDRESS": "127.0.0.1:1"}
    command = [sys.executable, "-c", STAYS]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr


def numbers(*values: int) -> dict[str, int]:
    return {f"task {value}": value for value in values}


def test_every_task_has_one_outcome_and_a_log(tmp_path: Path) -> None:
    outcomes = list(RayExecutor(TaskSettings(logs=tmp_path)).map(square, numbers(*range(20))))
    assert {o.key: o.value for o in outcomes} == {f"task {n}": n * n for n in range(20)}
    assert len(outcomes) == 20
    assert log_path(tmp_path, "task 4").read_text().startswith("squaring 4\n")
    assert list(RayExecutor().map(square, {})) == []


def test_an_exception_fails_only_its_task_and_is_not_tried_again() -> None:
    outcomes = {o.key: o for o in RayExecutor().map(fail_on_three, numbers(1, 2, 3, 4))}
    bad = outcomes.pop("task 3")
    assert bad.error == "three is not liked" and bad.tries == 1 and "fail_on_three" in bad.traceback
    assert sorted(o.value for o in outcomes.values()) == [1, 2, 4]


def test_a_poison_task_is_put_aside_and_a_lost_one_runs_again(tmp_path: Path) -> None:
    outcomes = {
        o.key: o for o in RayExecutor(TaskSettings(tries=2)).map(die_on_two, numbers(*range(4)))
    }
    bad = outcomes.pop("task 2")
    assert bad.tries == 2 and "worker ended" in str(bad.error)
    assert sorted(o.value for o in outcomes.values()) == [0, 1, 3]
    (outcome,) = RayExecutor().map(die_once, {"a": str(tmp_path / "marker")})
    assert outcome.value == "second try" and outcome.tries == 2


def test_a_task_without_end_is_stopped() -> None:
    list(RayExecutor().map(square, numbers(1, 2)))  # starts the workers, which may take long
    outcomes = {
        o.key: o
        for o in RayExecutor(TaskSettings(tries=1, minutes=1)).map(
            time.sleep, {"long": 600, "short": 0}
        )
    }
    assert "still running after 60 s" in str(outcomes["long"].error)
    assert outcomes["short"].error is None
