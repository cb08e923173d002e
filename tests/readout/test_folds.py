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
        {"trial": f"{scenario}_{split}_{i}", "scenario": scenario, "split": split,
         "contact": i % 3 == 0, "digest": f"{scenario}{split}{i}"}
        for scenario in scenarios
        for split, count in counts.items()
        for i in range(count)
    ]  # fmt: skip
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
    times = 2 if protocol is Protocol.ONE else 1
    assert sorted(tested) == sorted([*table["trial"][table["split"] == "testing"]] * times)
    for fold in folds:
        now = {trial for split in fold.scenarios for trial in split.test}
        assert fold.train and now.isdisjoint(fold.train)
        for split in fold.scenarios:
            assert split.fit and now.isdisjoint(split.fit)
            assert all(trial.startswith(split.scenario) for trial in (*split.fit, *split.test))
            assert "familiarization" not in " ".join((*split.fit, *fold.train))
        scenarios = {trial.split("_")[0] for trial in fold.train}
        assert scenarios == set(fold.training.trained)


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


def test_nothing_to_test_and_impossible_plans_are_refused() -> None:
    with pytest.raises(BadInputError, match="testing"):
        plan_folds(index({"training": 3, "readout": 3}), Protocol.ALL, 5, 0)
    with pytest.raises(BadInputError, match="folds"):
        plan_folds(index({"testing": 9}), Protocol.ALL, 1, 0)
    with pytest.raises(BadInputError, match="two scenarios"):
        plan_folds(index({"testing": 9}, ("drop",)), Protocol.ALL_BUT, 5, 0)


HAND: dict[str, dict[str, list[str]]] = {
    "all": {"all": ["drop", "link", "roll"]},
    "all-but": {
        "no_drop": ["link", "roll"], "no_link": ["drop", "roll"], "no_roll": ["drop", "link"],
    },
    "only": {"drop": ["drop"], "link": ["link"], "roll": ["roll"]},
    "one": {"drop": ["drop"], "link": ["link"], "roll": ["roll"]},
}  # fmt: skip
"""Scenarios that train each set of dynamics, by protocol, from the paper."""
TESTED = {
    "all": ["drop", "link", "roll"], "no_drop": ["drop"], "no_link": ["link"], "no_roll": ["roll"],
    "drop": ["drop"], "link": ["link"], "roll": ["roll"],
}  # fmt: skip


@pytest.mark.parametrize("protocol", ["all", "all-but", "only", "one"])
@pytest.mark.parametrize("split", ["training", "readout"])
def test_each_protocol_trains_and_tests_what_the_paper_says(protocol: str, split: str) -> None:
    """Dynamics are trained on the split training, or readout where there is none."""
    counts = {"training": 2, "readout": 2, "testing": 2} if split == "training" else {
        "readout": 2, "testing": 2,
    }  # fmt: skip
    table = index(counts, ("roll", "drop", "link"))
    for plan in (plan_folds, training_folds):
        folds = {f.training.name: f for f in plan(table, Protocol(protocol), 5, 0)}
        assert list(folds) == list(HAND[protocol])
        for name, fold in folds.items():
            trained = [f"{s}_{split}_{i}" for s in HAND[protocol][name] for i in range(2)]
            assert list(fold.train) == trained and fold.number == -1
            parts = [(part.scenario, part.fit, part.test) for part in fold.scenarios]
            assert parts == [
                (s, (f"{s}_readout_0", f"{s}_readout_1"), (f"{s}_testing_0", f"{s}_testing_1"))
                for s in (TESTED["all"] if protocol == "one" else TESTED[name])
            ]
            if protocol == "one":
                chosen = select_scenario(list(folds.values()), "drop")
                assert [f.training.name for f in chosen] == list(folds)
                assert all([p.scenario for p in f.scenarios] == ["drop"] for f in chosen)
            elif protocol != "all":
                (tested,) = TESTED[name]
                assert select_scenario(list(folds.values()), tested) == [fold]


@pytest.mark.parametrize("split", ["training", "readout"])
def test_scenarios_that_are_not_tested_train_too(split: str) -> None:
    table = index({"training": 2, "readout": 2, "testing": 2}, ("drop", "link", "roll"))
    table = table[(table["split"] != "testing") | (table["scenario"] == "drop")]
    table = table[table["split"].isin((split, "readout", "testing"))]
    expected = {
        "all": {"all": ["drop", "link", "roll"]},
        "all-but": {"no_drop": ["link", "roll"]},
        "only": {"drop": ["drop"]},
        "one": {"drop": ["drop"], "link": ["link"], "roll": ["roll"]},
    }
    for protocol, sets in expected.items():
        for plan in (plan_folds, training_folds):
            folds = plan(table, Protocol(protocol), 5, 0)
            assert {f.training.name: list(f.training.trained) for f in folds} == sets
            for fold in folds:
                trained = [f"{s}_{split}_{i}" for s in sets[fold.training.name] for i in range(2)]
                assert list(fold.train) == trained
                assert [part.scenario for part in fold.scenarios] == ["drop"]
    # Cross-validated, with a training split of other scenarios.
    table = table[table["split"] != "readout"]
    if split == "training":
        trained = {tuple(f.train) for f in plan_folds(table, Protocol.ALL_BUT, 2, 0)}
        assert trained == {tuple(f"{s}_training_{i}" for s in ("link", "roll") for i in range(2))}


@pytest.mark.parametrize("protocol", ["all", "all-but", "only"])
def test_a_cross_validation_trains_and_fits_on_all_other_groups(protocol: str) -> None:
    table = index({"testing": 6}, ("drop", "roll"))
    group = assign_folds(table, 3, 0)
    folds = plan_folds(table, Protocol(protocol), 3, 0)
    assert len(folds) == 3 * (1 if protocol == "all" else 2)
    assert sorted(group.values()) == [0] * 4 + [1] * 4 + [2] * 4
    other = {"drop": "roll", "roll": "drop"}
    for fold in folds:
        for part in fold.scenarios:
            trains = {"all": ["drop", "roll"], "all-but": [other[part.scenario]],
                      "only": [part.scenario]}[protocol]  # fmt: skip
            trials = {s: [f"{s}_testing_{i}" for i in range(6)] for s in other}
            assert list(part.test) == [t for t in trials[part.scenario] if group[t] == fold.number]
            assert list(part.fit) == [t for t in trials[part.scenario] if group[t] != fold.number]
            known = [t for s in trains for t in trials[s] if group[t] != fold.number]
            assert list(fold.train) == known


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


def test_a_scenario_that_is_not_there_is_refused() -> None:
    table = index({"training": 3, "readout": 2, "testing": 2})
    for protocol in Protocol:
        with pytest.raises(UnknownNameError, match="roll"):
            select_scenario(plan_folds(table, protocol, 5, 0), "rlol")
    (fold,) = select_scenario(plan_folds(table, Protocol.ALL, 5, 0), "roll")
    assert [part.scenario for part in fold.scenarios] == ["roll"]
    assert fold.training.trained == ("drop", "roll")


def test_variants_share_the_fold_of_their_trial() -> None:
    table = index({"testing": 6}, ("drop",))
    changed = [
        {**row, "trial": f"{row['trial']}+mass.{change}", "digest": row["digest"] + change}
        for row in table.to_dict("records")
        for change in ("quarter", "fourfold")
    ]
    numbers = assign_folds(pd.concat([table, pd.DataFrame(changed)]), 3, 0)
    assert len(numbers) == 18
    for trial, number in numbers.items():
        assert number == numbers[trial.partition("+")[0]]
    plain = assign_folds(table, 3, 0)
    assert len(set(plain.values())) == 3
    without = assign_folds(pd.DataFrame(changed), 3, 0)
    assert all(without[f"{t}+mass.quarter"] == without[f"{t}+mass.fourfold"] for t in plain)
