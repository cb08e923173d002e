"""Item statistics: against numpy, and what they say about stimuli that people guess."""

from __future__ import annotations

import numpy as np
import pytest

from physion.analysis.people.measures import item_statistics
from support.simulated_people import study


def test_item_rest_is_the_correlation_with_the_other_answers() -> None:
    test = study(people=15, stimuli=12, scenarios=("drop",), seed=4).test
    test = test.drop(index=test.index[[3, 40]])
    table = item_statistics(test).set_index("stimulus")
    wide = test.pivot(index="session", columns="stimulus", values="correct").astype(float)
    for name in wide.columns:
        own = wide[name].dropna()
        rest = wide.drop(columns=name).mean(axis=1).loc[own.index]
        row = table.loc[name]
        assert row["difficulty"] == pytest.approx(own.mean()) and row["people"] == len(own)
        if own.nunique() > 1:
            assert row["item_rest"] == pytest.approx(np.corrcoef(own, rest)[0, 1])
        else:
            assert np.isnan(row["item_rest"]) and "all answers" in row["reason"]


def test_a_stimulus_that_goes_against_ability_is_below_zero() -> None:
    test = study(people=60, stimuli=25, scenarios=("drop",), seed=1, ability_sd=1.5).test.copy()
    ability = test.groupby("session")["correct"].transform("mean")
    odd = test["stimulus"] == test["stimulus"].iloc[0]
    right = ability[odd] < ability.median()
    test.loc[odd, "yes"] = test.loc[odd, "label"] == right
    table = item_statistics(test).set_index("stimulus")["item_rest"]
    assert table[test["stimulus"].iloc[0]] < -0.4
    assert table.drop(test["stimulus"].iloc[0]).mean() > 0.1
