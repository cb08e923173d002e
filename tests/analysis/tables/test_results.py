"""The table of results: published rows from the released files, order, and what is shown of it."""

from __future__ import annotations

import csv
from collections import defaultdict
from statistics import fmean

import numpy as np
import pandas as pd
import pytest

from physion.analysis.published.tables import MODELS, read_published
from physion.analysis.results import (
    MARK,
    fewest_rows,
    published_rows,
    results_table,
    zone_of_people,
)
from physion.analysis.tables import read_humans
from physion.core.names import OFFICIAL_SCENARIOS, SCENARIOS
from physion.data.official import official
from physion.report.compare import compare


def released(file: str, column: str, scenarios: tuple[str, ...]) -> dict[str, float]:
    """Means over scenarios of the means of the seeds, straight from a released file."""
    kinds: dict[tuple[str, str], list[float]] = defaultdict(list)
    with (official().results / file).open() as stream:
        for row in csv.DictReader(stream):
            scenario = OFFICIAL_SCENARIOS[row["scenario"].lower()]
            if row["Readout Type"] == "B" and row["Dynamics Training Dataset Type"] == "all":
                kinds[row["Model"], scenario].append(float(row[column]))
    models = {model for model, _ in kinds}
    return {m: fmean(fmean(kinds[m, s]) for s in scenarios) for m in models}


@pytest.mark.parametrize("scenarios", [SCENARIOS, SCENARIOS[:1], SCENARIOS[:-1]])
def test_published_rows_are_the_means_of_the_released_files(scenarios: tuple[str, ...]) -> None:
    rows = published_rows(read_published(official().results.parent), scenarios)
    shown = rows.set_index("row")
    for column, file, name in (
        ("accuracy", "model_human_accuracies.csv", "model_correct"),
        ("kappa", "model_human_CohensK.csv", "Cohens_k_med"),
    ):
        wanted = sorted(released(file, name, scenarios).values())
        own = rows[(rows["group"] == "published") & rows["kappa"].notna()]
        np.testing.assert_allclose(sorted(own[column]), wanted, rtol=1e-12)
        assert len(own) == len(MODELS)
    assert ("V-JEPA 2 ViT-L" + MARK in shown.index) == (len(scenarios) == 8)
    if len(scenarios) == 8:
        printed = {"DPI-Net": 0.748, "GNS-RANSAC": 0.701, "GNS": 0.677, "pDeIT-lstm": 0.605}
        for model, accuracy in {**printed, "people of the study": 0.747}.items():
            assert round(float(shown.loc[model + MARK, "accuracy"]), 3) == accuracy


def test_the_zone_of_people_is_the_mean_of_its_bounds() -> None:
    with (official().results / "human_accuracy_by_scenario.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    (low, high), kappa = zone_of_people(read_published(official().results.parent), SCENARIOS)
    assert low == pytest.approx(fmean(float(row["pct_2.5"]) for row in rows))
    assert high == pytest.approx(fmean(float(row["pct_97.5"]) for row in rows))
    assert 0 < kappa[0] < kappa[1] < 1


@pytest.mark.nightly
@pytest.mark.slow
def test_people_come_first_then_all_by_accuracy() -> None:
    labels = official().labels
    p = {name: 0.9 if contact else 0.2 for name, contact in labels.items()}
    wrong = {name: 1 - value for name, value in list(p.items())[::3]}
    table = compare({"good": p, "half": {**p, **wrong}}, humans="official").results
    people = table["group"] == "people"
    assert list(people) == sorted(people, reverse=True)
    accuracies = table.loc[~people, "accuracy"]
    assert accuracies.is_monotonic_decreasing and {"good", "half"} < set(table["row"])
    assert (table["source"] != "").sum() == 1 + len(MODELS) + 1
    assert table["stimuli"].isna().sum() == 1 + len(MODELS) + 1


@pytest.mark.slow
def test_the_table_has_r_beyond_the_outcome() -> None:
    """The mean over scenarios of the r of deviations from the mean of each outcome."""
    people = read_humans(official().humans)
    people = people[~people["stimulus"].str.contains("ledge")].set_index("stimulus")
    contact = pd.Series(official().labels).loc[people.index]
    yes = people["accuracy"].where(contact, 1 - people["accuracy"])
    p = pd.Series(np.random.default_rng(0).random(len(yes)), yes.index) / 2 + yes / 2
    left = pd.DataFrame({"p": p, "yes": yes}).groupby([people["scenario"], contact])
    left = left.transform(lambda values: values - values.mean())
    wanted = left.groupby(people["scenario"]).apply(lambda rows: rows["p"].corr(rows["yes"])).mean()
    table = compare({"m": p.to_dict()}, humans="official").results.set_index("row")
    assert table.loc["m", "beyond"] == pytest.approx(wanted, abs=1e-9)
    assert table.loc["m", "beyond_low"] < wanted < table.loc["m", "beyond_high"]


def test_no_published_rows_without_the_study(make_up: pd.DataFrame) -> None:
    table = compare(make_up).results
    assert list(table["row"]) == ["m"] and table["accuracy"].item() == 0.75


@pytest.fixture
def make_up() -> pd.DataFrame:
    return pd.DataFrame(
        {
            "stimulus": ["a", "b", "c", "d"],
            "scenario": "drop",
            "model": "m",
            "p_contact": [0.9, 0.8, 0.7, 0.1],
            "outcome": [True, True, False, False],
        }
    )


def test_what_does_not_fit_are_readouts_then_published_rows() -> None:
    rows = [
        ("one person with another", "people", "", 0.75),
        ("a · full", "model", "full", 0.9),
        ("a · observed+simulated", "model", "observed+simulated", 0.8),
        ("x *", "published", "", 0.7),
        ("a · observed", "model", "observed", 0.6),
        ("y *", "published", "", 0.6),
        ("b", "model", "observed", 0.5),
    ]
    table = pd.DataFrame(rows, columns=["row", "group", "readout", "accuracy"])
    kept = [list(fewest_rows(table, most)["row"]) for most in (3, 4, 6, 7)]
    people, own = "one person with another", "a · observed+simulated"
    assert kept[0] == [people, own, "b"]
    assert kept[1] == [people, own, "x *", "b"]
    assert kept[2] == [people, "a · full", own, "x *", "y *", "b"]
    assert kept[3] == list(table["row"])


def test_the_average_is_the_one_that_is_shown_elsewhere() -> None:
    labels = official().labels
    few = [name for name in labels if "drop" in name][:2] + list(labels)[:2]
    scores = compare({"m": {name: 0.3 + 0.1 * k for k, name in enumerate(few)}},
                     humans="official").scores  # fmt: skip
    table = results_table(scores)
    pooled = scores[(scores["scenario"] == "pooled") & (scores["model"] == "m")]
    assert table.set_index("row").loc["m", "accuracy"] == pooled["accuracy"].item()
