"""The options of the command line give the executor that they name, with its limits."""

from __future__ import annotations

from pathlib import Path

import pytest

from physion.compute.local import LocalExecutor
from physion.compute.run_tasks import ExecutorSettings
from physion.compute.tasks import log_path
from physion.core.errors import BadInputError
from support import slurm
from support.tasks import fail_on_three, square


def test_local_has_its_limits_and_logs(tmp_path: Path) -> None:
    executor = ExecutorSettings(
        workers=1, task=("tries=2", "minutes=0.5", f"logs={tmp_path}")
    ).open()
    assert isinstance(executor, LocalExecutor)
    assert (executor.workers, executor.tries, executor.timeout) == (1, 2, 30.0)
    assert [o.value for o in executor.map(square, {"a b": 3})] == [9]
    assert log_path(tmp_path, "a b").read_text() == "squaring 3\na b: done\n"


def test_the_log_of_a_failed_task_has_its_traceback(tmp_path: Path) -> None:
    executor = LocalExecutor(1, logs=tmp_path)
    (outcome,) = executor.map(fail_on_three, {"bad": 3})
    assert outcome.error == "three is not liked"
    assert "fail_on_three" in log_path(tmp_path, "bad").read_text()


def test_slurm_gets_minutes_of_all_tasks_of_a_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("submitit", reason="the extra 'slurm' is not installed")
    slurm.install(tmp_path, monkeypatch)
    task = ("minutes=3", "per_job=5", "gpus=2", "memory_gb=1.5", "partition=fast")
    task += ("sbatch.account=physics", f"logs={tmp_path / 'logs'}")
    asked = ExecutorSettings("slurm", task=task).open().parameters()  # type: ignore[attr-defined]
    assert (asked["time"], asked["gpus_per_node"], asked["mem"]) == (15, 2, "1536MB")
    assert (asked["partition"], asked["additional_parameters"]) == ("fast", {"account": "physics"})


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        (ExecutorSettings("slurm", task=("gpus=0.5",)), "whole"),
        (ExecutorSettings("slurm", task=("account",)), "NAME=VALUE"),
        (ExecutorSettings("slurm", task=("sbatch.a=1", "sbatch.a=2")), "given twice"),
        (ExecutorSettings(task=("minutes=0",)), "minutes"),
        (ExecutorSettings(task=("tries=many",)), "whole number"),
        (ExecutorSettings(task=("minuts=3",)), "did you mean 'minutes'"),
    ],
)
def test_what_an_executor_cannot_take_is_refused(settings: ExecutorSettings, word: str) -> None:
    with pytest.raises(BadInputError, match=word):
        settings.open()
