"""Power by simulation: more people and stimuli find more, and without an effect few do."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from scipy import special, stats

from physion.analysis.people.power import COLUMNS, PlannedEffect, power_table
from physion.cli.main import main
from physion.core.errors import BadInputError


@pytest.fixture
def fractions() -> pd.DataFrame:
    rng = np.random.default_rng(0)
    label = np.arange(80) % 2 == 0
    logit = np.where(label, 1, -1) * rng.normal(1.2, 1.2, 80)
    return pd.DataFrame({"p_yes": special.expit(logit), "count": 100.0, "label": label})


def test_power_grows_with_stimuli_and_effect(fractions: pd.DataFrame) -> None:
    planned = PlannedEffect(effect=0.25)
    table = power_table(fractions, planned, (30,), (20, 120), repeats=60)
    assert tuple(table.columns) == COLUMNS and list(table["stimuli"]) == [20, 120]
    assert table["power"].iloc[1] > table["power"].iloc[0] + 0.2
    assert table["power"].between(table["low"], table["high"]).all()
    none = power_table(fractions, PlannedEffect(effect=1e-9), (30,), (60,), repeats=150)
    assert none["power"].item() < 0.08  # 2.5 % by definition: one side of the interval


def test_groups_follow_the_formula_of_two_means(fractions: pd.DataFrame) -> None:
    planned = PlannedEffect("groups", effect=0.06, person_sd=0.0)
    (power,) = power_table(fractions, planned, (25,), (60,), repeats=300)["power"]
    right = np.where(fractions["label"], fractions["p_yes"], 1 - fractions["p_yes"])
    # Persons do not differ: the accuracy of one varies by the answers alone.
    sd = np.sqrt(np.mean(right * (1 - right)) / 60)
    noncentral = 0.06 / (sd * np.sqrt(2 / 25))
    expected = stats.nct.sf(stats.t.ppf(0.975, 48), 48, noncentral)
    assert power == pytest.approx(expected, abs=0.1)
    more = power_table(
        fractions, PlannedEffect("groups", 0.06, person_sd=1.0), (25,), (60,), repeats=150
    )
    assert more["power"].item() < power


@pytest.mark.parametrize(
    ("settings", "words"),
    [({"effect": 0.0}, "between 0 and 1"), ({"effect": 0.6, "base": 0.5}, "does not lie"),
     ({"question": "others"}, "none of"), ({"alike": 1.0}, "between -1 and 1")],
)  # fmt: skip
def test_effects_that_cannot_be_are_refused(settings: dict[str, float], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        PlannedEffect(**settings)  # type: ignore[arg-type]


def test_studies_that_cannot_be_are_refused(fractions: pd.DataFrame) -> None:
    with pytest.raises(BadInputError, match="3 people"):
        power_table(fractions, PlannedEffect(), (2,), (50,))
    with pytest.raises(BadInputError, match="cannot be worse"):
        power_table(fractions, PlannedEffect("groups", effect=0.95), (20,), (50,), repeats=2)


def test_the_verb_draws_the_stimuli_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["experiment", "power", "--people", "20", "--stimuli", "30", "60", "--repeats", "5"]
    assert main([*command, "--effect", "0.3", "--scenario", "drop", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["stimuli"] for row in rows] == [30, 60] and 0 <= rows[0]["power"] <= 1
    assert main(command) == 0
    assert "difference of 0.1 in r of two models" in capsys.readouterr().out
    assert main([*command, "--scenario", "nothing"]) == 2
