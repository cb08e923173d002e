"""Which trials `physion train` trains on: those that an evaluation of the dataset would use."""

from __future__ import annotations

import dataclasses
import typing

import pandas as pd
import pytest

from physion.core.errors import BadInputError, UnknownNameError
from physion.models.interface import TrainingSettings
from physion.readout.folds import plan_folds
from physion.readout.trainings import TrainConfig, plan_trainings
from physion.training.loop import TrainingOverrides
from physion.training.protocols import Training


def make_index(**counts: int) -> pd.DataFrame:
    """Return an index with ``counts[split]`` trials of each of three scenarios."""
    rows = [
        {
            "trial": f"{scenario}_{split}_{i}", "scenario": scenario, "split": split,
            "digest": f"{scenario}{split}{i}", "contact": i % 2 == 0,
        }
        for scenario in ("drop", "link", "roll")
        for split, count in counts.items()
        for i in range(count)
    ]  # fmt: skip
    return pd.DataFrame(rows)


@pytest.mark.parametrize("protocol", [training.value for training in Training])
@pytest.mark.parametrize(
    "counts", [{"training": 3, "readout": 4, "testing": 5}, {"readout": 4, "testing": 5},
               {"testing": 10}],
)  # fmt: skip
def test_trainings_are_those_of_the_folds_of_an_evaluation(
    protocol: typing.Any, counts: dict[str, int]
) -> None:
    index = make_index(**counts)
    folds = plan_folds(index, Training.named(protocol), 5, seed=3)
    planned = plan_trainings(index, TrainConfig(protocol, seed=3))
    assert [(p.name, p.trials) for p in planned] == [(f.training.name, f.train) for f in folds]


@pytest.mark.parametrize(("counts", "split"), [({"training": 3, "readout": 2}, "training"),
                                               ({"readout": 2}, "readout")])  # fmt: skip
def test_without_testing_trials_all_of_a_split_are_used(counts: dict[str, int], split: str) -> None:
    index = make_index(**counts)
    (plan,) = plan_trainings(index, TrainConfig())
    assert plan.name == "all"
    assert set(plan.trials) == set(index["trial"][index["split"] == split])
    but = {p.name: p.trials for p in plan_trainings(index, TrainConfig("all-but"))}
    assert set(but) == {"no_drop", "no_link", "no_roll"}
    assert not any(trial.startswith("link") for trial in but["no_link"])


def test_one_scenario_can_be_chosen() -> None:
    index = make_index(training=3, readout=2, testing=2)
    (plan,) = plan_trainings(index, TrainConfig("only", scenario="link"))
    assert plan.name == "link" and {t.partition("_")[0] for t in plan.trials} == {"link"}
    (plan,) = plan_trainings(index, TrainConfig("all-but", scenario="link"))
    assert plan.name == "no_link" and {t.partition("_")[0] for t in plan.trials} == {"drop", "roll"}
    with pytest.raises(UnknownNameError, match="link"):
        plan_trainings(index, TrainConfig("only", scenario="lnik"))
    with pytest.raises(BadInputError, match="protocol all-but or only"):
        plan_trainings(index, TrainConfig(scenario="link"))
    with pytest.raises(BadInputError, match="no trial in the splits"):
        plan_trainings(make_index(familiarization=3), TrainConfig())


def test_every_setting_of_a_training_can_be_overridden() -> None:
    """Names and types are those of the settings; None leaves the model's value."""
    settings = typing.get_type_hints(TrainingSettings)
    overrides = typing.get_type_hints(TrainingOverrides)
    assert list(overrides) == list(settings)
    for name, kind in settings.items():
        if name != "precision":  # whose names the settings leave to the devices
            assert overrides[name] == kind | None
    assert TrainingOverrides().apply(TrainingSettings(steps=7)) == TrainingSettings(steps=7)
    changed = TrainingOverrides(steps=9, clip=0.0).apply(TrainingSettings(steps=7, clip=1.0))
    assert changed == dataclasses.replace(TrainingSettings(), steps=9, clip=0.0)
