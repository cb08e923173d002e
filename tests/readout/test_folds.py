"""Folds: trials that train, fit and test are disjoint."""

from __future__ import annotations

import pandas as pd
import pytest

from physion.core.errors import BadInputError, UnknownNameError
from physion.readout.folds import (
    Protocol,
    assign_folds,
    plan_folds,
    select_scenario,
    training_folds,
)


def index(counts: dict[str, int], scenarios: tuple[str, ...] = ("drop", "roll")) -> pd.DataFrame:
    """Return an index in which no physics occurs twice."""
    rows = [
        {
            "trial": f"{scenario}_{split}_{i}",
            "scenario": scenario,
            "split": split,
            "contact": i % 3 == 0,
            "digest": f"{scenario}{split}{i}",
        }
        for scenario in scenarios
        for split, count in counts.items()
        for i in range(count)
    ]
    return pd.DataFrame(rows)


@pytest.mark.parametrize("protocol", list(Protocol))
@pytest.mark.parametrize(
    "counts",
    [
        {"training": 6, "readout": 5, "testing": 7},
        {"readout": 5, "testing": 7},
        {"training": 6, "testing": 11},
        {"testing": 11},
        {"testing": 11, "familiarization": 4},
    ],
)
def test_every_tested_trial_is_predicted_once_by_what_never_saw_it(
    protocol: Protocol, counts: dict[str, int]
) -> None:
    table = index(counts)
    folds = plan_folds(table, protocol, 4, 0)
    tested = [trial for fold in folds for split in fold.scenarios for trial in split.test]
    assert sorted(tested) == sorted(table["trial"][table["split"] == "testing"])
    for fold in folds:
        now = {trial for split in fold.scenarios for trial in split.test}
        assert fold.train and now.isdisjoint(fold.train)
        for split in fold.scenarios:
            assert split.fit and now.isdisjoint(split.fit)
            assert all(trial.startswith(split.scenario) for trial in (*split.fit, *split.test))
            assert "familiarization" not in " ".join((*split.fit, *fold.train))
        scenarios = {trial.split("_")[0] for trial in fold.train}
        assert scenarios == set(fold.training.trained)


def test_splits_are_used_as_they_are_meant() -> None:
    (only,) = plan_folds(index({"training": 3, "readout": 2, "testing": 2}), Protocol.ALL, 5, 0)
    assert only.number == -1
    assert all("_training_" in trial for trial in only.train)
    assert all("_readout_" in trial for split in only.scenarios for trial in split.fit)


def test_a_readout_trial_with_the_physics_of_a_tested_one_is_not_used() -> None:
    table = index({"training": 3, "readout": 3, "testing": 2})
    table.loc[table["trial"] == "drop_readout_1", "digest"] = "droptesting0"
    table.loc[table["trial"] == "roll_training_2", "digest"] = "rolltesting1"
    (only,) = plan_folds(table, Protocol.ALL, 5, 0)
    assert only.scenarios[0].fit == ("drop_readout_0", "drop_readout_2")
    assert "roll_training_2" not in only.train


def test_twins_stay_in_one_part_and_labels_are_balanced() -> None:
    table = index({"testing": 60}, ("drop",))
    table.loc[59, "digest"] = table.loc[0, "digest"]
    part = assign_folds(table, 5, 0)
    assert part["drop_testing_0"] == part["drop_testing_59"]
    shares = table.assign(part=table["trial"].map(part)).groupby("part")["contact"].mean()
    assert len(shares) == 5 and shares.max() - shares.min() < 0.15
    shuffled = assign_folds(table.sample(frac=1, random_state=1), 5, 0)
    assert shuffled == part != assign_folds(table, 5, 1)


def test_fewer_trials_than_parts_still_work() -> None:
    folds = plan_folds(index({"testing": 2}, ("drop",)), Protocol.ALL, 5, 0)
    assert [len(fold.scenarios[0].test) for fold in folds] == [1, 1]


def test_nothing_to_test_and_impossible_plans_are_refused() -> None:
    with pytest.raises(BadInputError, match="testing"):
        plan_folds(index({"training": 3, "readout": 3}), Protocol.ALL, 5, 0)
    with pytest.raises(BadInputError, match="folds"):
        plan_folds(index({"testing": 9}), Protocol.ALL, 1, 0)
    with pytest.raises(BadInputError, match="two scenarios"):
        plan_folds(index({"testing": 9}, ("drop",)), Protocol.ALL_BUT, 5, 0)


@pytest.mark.parametrize("protocol", list(Protocol))
@pytest.mark.parametrize("counts", [{"training": 3, "readout": 4, "testing": 5}, {"testing": 10}])
def test_trainings_match_an_evaluation(protocol: Protocol, counts: dict[str, int]) -> None:
    table = index(counts)
    assert training_folds(table, protocol, 5, 3) == plan_folds(table, protocol, 5, 3)


@pytest.mark.parametrize(("counts", "split"), [({"training": 3, "readout": 2}, "training"),
                                               ({"readout": 2}, "readout")])  # fmt: skip
def test_without_testing_trials_all_of_a_split_are_trained_on(
    counts: dict[str, int], split: str
) -> None:
    table = index(counts)
    (every,) = training_folds(table, Protocol.ALL, 5, 0)
    assert every.training.name == "all"
    assert set(every.train) == set(table["trial"][table["split"] == split])
    but = {f.training.name: f.train for f in training_folds(table, Protocol.ALL_BUT, 5, 0)}
    assert set(but) == {"no_drop", "no_roll"}
    assert not any(trial.startswith("roll") for trial in but["no_roll"])
    with pytest.raises(BadInputError, match="no trial in the splits"):
        training_folds(index({"familiarization": 3}), Protocol.ALL, 5, 0)


def test_one_scenario_can_be_chosen() -> None:
    table = index({"training": 3, "readout": 2, "testing": 2})
    only, but, every = (plan_folds(table, p, 5, 0) for p in
                        (Protocol.ONLY, Protocol.ALL_BUT, Protocol.ALL))  # fmt: skip
    (fold,) = select_scenario(only, Protocol.ONLY, "roll")
    assert {trial.partition("_")[0] for trial in fold.train} == {"roll"}
    (fold,) = select_scenario(but, Protocol.ALL_BUT, "roll")
    assert {trial.partition("_")[0] for trial in fold.train} == {"drop"}
    with pytest.raises(UnknownNameError, match="roll"):
        select_scenario(only, Protocol.ONLY, "rlol")
    with pytest.raises(BadInputError, match="protocol all-but or only"):
        select_scenario(every, Protocol.ALL, "roll")
