"""The executor of Slurm, with commands that run the jobs on this machine."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from physion.compute.slurm import SlurmExecutor
from physion.compute.tasks import TaskSettings, log_path
from physion.core.errors import BadInputError, PhysionError
from support import slurm
from support.tasks import die_on_two, die_once, fail_on_three, square

submitit = pytest.importorskip("submitit", reason="the extra 'slurm' is not installed")


@pytest.fixture
def states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return slurm.install(tmp_path / "slurm", monkeypatch)


def make(folder: Path, **settings: int) -> SlurmExecutor:
    limits = TaskSettings(logs=folder / "jobs-of-slurm", **settings)  # type: ignore[arg-type]
    return SlurmExecutor(limits, check_seconds=0.2, grace_seconds=0.1)


def numbers(*values: int) -> dict[str, int]:
    return {f"task {value}": value for value in values}


@pytest.mark.slow
def test_every_task_has_one_outcome_and_a_log(tmp_path: Path, states: Path) -> None:
    executor = make(tmp_path, per_job=3, minutes=7, cpus=2, jobs=1)
    outcomes = list(executor.map(square, numbers(*range(5))))
    assert {o.key: o.value for o in outcomes} == {f"task {n}": n * n for n in range(5)}
    logs = executor.folder / "logs"
    assert log_path(logs, "task 4").read_text().startswith("squaring 4\n")
    # Five tasks, three to a job: one array of two jobs, with the limits that were asked for.
    (script,) = states.glob("*.script")
    for line in ("--array=0-1%1", "--time=21", "--cpus-per-task=2"):
        assert f"#SBATCH {line}\n" in script.read_text()


@pytest.mark.slow
def test_an_exception_fails_only_its_task(tmp_path: Path, states: Path) -> None:
    executor = make(tmp_path, per_job=2)
    outcomes = {o.key: o for o in executor.map(fail_on_three, numbers(1, 2, 3, 4))}
    bad = outcomes.pop("task 3")
    assert bad.error == "three is not liked" and bad.tries == 1
    assert "fail_on_three" in bad.traceback
    assert "not liked" in log_path(executor.folder / "logs", "task 3").read_text()
    # Jobs end in any order.
    assert {key: o.value for key, o in outcomes.items()} == numbers(1, 2, 4)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_poison_task_is_put_aside_and_the_others_of_its_job_are_done(
    tmp_path: Path, states: Path
) -> None:
    executor = make(tmp_path, tries=2, per_job=2)
    outcomes = {o.key: o for o in executor.map(die_on_two, numbers(1, 2))}
    assert outcomes["task 1"].value == 1
    assert outcomes["task 2"].tries == 2 and "FAILED" in str(outcomes["task 2"].error)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_job_that_was_ended_runs_again(tmp_path: Path, states: Path) -> None:
    (outcome,) = make(tmp_path).map(die_once, {"a": str(tmp_path / "marker")})
    assert outcome.value == "second try" and outcome.tries == 2


@pytest.mark.slow
def test_closing_the_iterator_cancels_the_jobs(tmp_path: Path, states: Path) -> None:
    outcomes = make(tmp_path).map(time.sleep, {"short": 0, "long": 600})
    assert next(outcomes).key == "short"
    outcomes.close()  # type: ignore[attr-defined]
    (cancelled,) = (path for path in states.glob("*.state") if "CANCELLED" in path.read_text())
    process = Path("/proc", cancelled.with_suffix(".group").read_text(), "stat")
    # A process that was ended stays in the table, as a zombie, until its parent asks for it.
    end = time.monotonic() + 300
    while process.exists() and not process.read_text().rpartition(") ")[2].startswith("Z"):
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_refused_submission_is_one_line(tmp_path: Path, states: Path) -> None:
    (tmp_path / "slurm" / "bin" / "sbatch").write_text(
        "#!/bin/sh\necho no such account >&2; exit 1\n"
    )
    with pytest.raises(PhysionError, match="could not be submitted") as refused:
        list(make(tmp_path).map(square, numbers(1)))
    assert "\n" not in str(refused.value)


def test_without_slurm_the_message_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BadInputError, match="sbatch was not found"):
        SlurmExecutor()


@pytest.mark.parametrize("name", ["minutes", "cpus", "jobs", "per_job", "tries"])
def test_numbers_below_one_are_refused(name: str) -> None:
    with pytest.raises(BadInputError, match=name):
        TaskSettings(**{name: 0})  # type: ignore[arg-type]


def test_logs_of_similar_names_are_apart(tmp_path: Path) -> None:
    paths = {log_path(tmp_path, key) for key in ("a b", "a-b", "a/b", "../a", "", "a" * 300)}
    assert len(paths) == 6 and all(path.parent == tmp_path for path in paths)
    assert all(len(os.fsencode(path.name)) < 255 for path in paths)
