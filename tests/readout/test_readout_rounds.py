"""Who is trained on, who is fitted on, who is tested: never the same trial."""

from __future__ import annotations

import pandas as pd
import pytest

from physion.errors import BadInputError
from physion.readout.folds import deal, plan_rounds
from physion.training.protocols import Training


def index(counts: dict[str, int], scenarios: tuple[str, ...] = ("drop", "roll")) -> pd.DataFrame:
    """An index with every physics once."""
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


@pytest.mark.parametrize("protocol", list(Training))
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
    protocol: Training, counts: dict[str, int]
) -> None:
    table = index(counts)
    rounds = plan_rounds(table, protocol, 4, 0)
    tested = [trial for r in rounds for asked in r.asked for trial in asked.test]
    assert sorted(tested) == sorted(table["trial"][table["split"] == "testing"])
    for r in rounds:
        now = {trial for asked in r.asked for trial in asked.test}
        assert r.train and now.isdisjoint(r.train)
        for asked in r.asked:
            assert asked.fit and now.isdisjoint(asked.fit)
            assert all(trial.startswith(asked.scenario) for trial in (*asked.fit, *asked.test))
            assert "familiarization" not in " ".join((*asked.fit, *r.train))
        scenarios = {trial.split("_")[0] for trial in r.train}
        assert scenarios == set(r.training.trained)


def test_splits_are_used_as_they_are_meant() -> None:
    (only,) = plan_rounds(index({"training": 3, "readout": 2, "testing": 2}), Training.ALL, 5, 0)
    assert only.fold == -1
    assert all("_training_" in trial for trial in only.train)
    assert all("_readout_" in trial for asked in only.asked for trial in asked.fit)


def test_a_readout_trial_with_the_physics_of_a_tested_one_is_not_used() -> None:
    table = index({"training": 3, "readout": 3, "testing": 2})
    table.loc[table["trial"] == "drop_readout_1", "digest"] = "droptesting0"
    table.loc[table["trial"] == "roll_training_2", "digest"] = "rolltesting1"
    (only,) = plan_rounds(table, Training.ALL, 5, 0)
    assert only.asked[0].fit == ("drop_readout_0", "drop_readout_2")
    assert "roll_training_2" not in only.train


def test_twins_stay_in_one_part_and_labels_are_balanced() -> None:
    table = index({"testing": 60}, ("drop",))
    table.loc[59, "digest"] = table.loc[0, "digest"]
    part = deal(table, 5, 0)
    assert part["drop_testing_0"] == part["drop_testing_59"]
    shares = table.assign(part=table["trial"].map(part)).groupby("part")["contact"].mean()
    assert len(shares) == 5 and shares.max() - shares.min() < 0.15
    shuffled = deal(table.sample(frac=1, random_state=1), 5, 0)
    assert shuffled == part != deal(table, 5, 1)


def test_fewer_trials_than_parts_still_work() -> None:
    rounds = plan_rounds(index({"testing": 2}, ("drop",)), Training.ALL, 5, 0)
    assert [len(r.asked[0].test) for r in rounds] == [1, 1]


def test_nothing_to_test_and_impossible_plans_are_refused() -> None:
    with pytest.raises(BadInputError, match="testing"):
        plan_rounds(index({"training": 3, "readout": 3}), Training.ALL, 5, 0)
    with pytest.raises(BadInputError, match="folds"):
        plan_rounds(index({"testing": 9}), Training.ALL, 1, 0)
    with pytest.raises(BadInputError, match="two scenarios"):
        plan_rounds(index({"testing": 9}, ("drop",)), Training.ALL_BUT, 5, 0)
