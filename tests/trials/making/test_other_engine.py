"""Trials made with an engine that is not the default one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError, UnknownNameError
from physion.physics.engine import make_engine
from physion.trials.dataset import Dataset
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_dataset
from physion.trials.making.verify import verify_dataset

MUJOCO = GenerateSettings(
    width=32, height=32, jitters=1, min_visible=0.0, movies=False, engine="mujoco"
)


def test_trials_of_another_engine_are_verified_with_it(tmp_path: Path) -> None:
    tasks = plan_dataset("tests", ["collide"], {"testing": 1})
    report = make_trials(tmp_path, tasks, MUJOCO, executor=SerialExecutor())
    assert not report.failed
    (name,) = Dataset(tmp_path).index["engine"]
    assert name == make_engine("mujoco").name
    result = verify_dataset(tmp_path, again=-1)
    assert result.faults == [] and result.other_versions == []


def test_the_engine_is_stored_by_its_whole_name_alone(tmp_path: Path) -> None:
    assert GenerateSettings(engine="mujoco").stored() == GenerateSettings().stored()
    tasks = plan_dataset("tests", ["collide"], {"testing": 1})
    make_trials(tmp_path, tasks, MUJOCO, executor=SerialExecutor(), make=lambda job: "")
    stored = json.loads((tmp_path / "dataset.json").read_text())
    assert stored["made_by"]["engine"] == make_engine("mujoco").name
    with pytest.raises(BadInputError, match="made_by"):
        make_trials(
            tmp_path,
            tasks,
            GenerateSettings(width=32, height=32, jitters=1, min_visible=0.0, movies=False),
            executor=SerialExecutor(),
        )


def test_unknown_engines_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="mujoco"):
        GenerateSettings(engine="mujocco")
