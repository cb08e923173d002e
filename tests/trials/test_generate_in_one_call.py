"""`physion.generate`: plans, makes and opens a dataset, and says when trials are missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import physion
from physion.compute.run_tasks import RunReport
from physion.core.errors import BadInputError, PhysionError, UnknownNameError
from physion.trials.making import generate as module
from physion.trials.making.plan import GenerateSettings, plan_dataset


def plan_of(monkeypatch: pytest.MonkeyPatch, folder: Path, *arguments: Any, **more: Any) -> Any:
    """Return the tasks that a call would make, without making them."""
    seen: list[Any] = []

    def note(folder: Path, tasks: Any, settings: Any, **rest: Any) -> RunReport:
        seen.append(tasks)
        return RunReport([], [], {}, folder / "index")

    monkeypatch.setattr(module, "make_trials", note)
    monkeypatch.setattr(module, "GeneratedDataset", lambda folder, report: folder)
    assert physion.generate(folder, *arguments, **more) == folder
    return seen[0]


def test_the_plan_is_that_of_the_command_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert plan_of(monkeypatch, tmp_path, "drop", 3) == plan_dataset(
        "physion", ["drop"], {"testing": 3}
    )
    assert len(plan_of(monkeypatch, tmp_path, counts=2)) == 2 * 8, "all scenarios"
    counts = {"training": 2, "readout": 1}
    tasks = plan_of(monkeypatch, tmp_path, ("drop", "roll"), counts, name="mine")
    assert tasks == plan_dataset("mine", ["drop", "roll"], counts)
    assert plan_of(monkeypatch, tmp_path, "drop,roll", counts, name="mine") == tasks
    tasks = plan_of(monkeypatch, tmp_path, "collide", 2, presets=["debug"])
    assert {task.presets for task in tasks} == {("debug",)}


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (("dominos", 1), {}, "unknown scenario 'dominos'; closest: dominoes"),
        (("drop", {"tests": 1}), {}, "unknown split 'tests'"),
        (("drop", 0), {}, "1 or more"),
        (("drop", {}), {}, "1 or more"),
        (("all", 1), {"presets": ["debug"]}, "presets need one scenario"),
        (("drop", 1), {"presets": ["no such"]}, "unknown preset of drop"),
    ],
)
def test_wrong_arguments_are_told_before_a_folder_is_made(
    arguments: tuple[Any, ...], options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises((BadInputError, UnknownNameError), match=message):
        physion.generate(tmp_path / "new", *arguments, **options)
    assert not (tmp_path / "new").exists()


def test_trials_that_fail_are_an_error_that_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(folder: Path, tasks: Any, settings: GenerateSettings, **rest: Any) -> RunReport:
        return RunReport(["a"], [], {"drop_testing_0001": "no scene fits"}, folder / "index")

    monkeypatch.setattr(module, "make_trials", fail)
    with pytest.raises(PhysionError, match=r"1 of 2 trials .*'drop_testing_0001': no scene fits"):
        physion.generate(tmp_path, "drop", 2)
