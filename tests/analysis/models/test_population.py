"""Populations against probabilities worked out by hand, all ways to halve them, released people."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import cohen_kappa_score

from physion.analysis.comparison import compare_scores
from physion.analysis.population import MODELS, PEOPLE, PopulationResults, compare_populations
from physion.analysis.tables import MEAN, check_predictions, name_models
from physion.core.errors import BadInputError
from physion.data.official import official
from physion.report.compare import read_averages

SCENARIO = "pilot_it2_drop_simple_box"


def names(count: int) -> list[str]:
    return [f"{SCENARIO}_{k:04d}" for k in range(count)]


def predicted(
    yes: np.ndarray, model: str = "m", seeds: list[str] | None = None, **more: object
) -> list[pd.DataFrame]:
    """Return one table per member (row) of ``yes`` (members, stimuli)."""
    columns = seeds or [str(k) for k in range(len(yes))]
    return [
        pd.DataFrame({"model": model, "seed": seed, "stimulus": names(len(row)),
                      "p_contact": np.where(row, 0.8, 0.1), **more})
        for seed, row in zip(columns, yes, strict=True)
    ]  # fmt: skip


def populations(
    tables: list[pd.DataFrame], labels: np.ndarray, p_yes: np.ndarray | None = None, n: int = 100
) -> PopulationResults:
    rows = name_models(check_predictions(pd.concat(tables, ignore_index=True)))
    outcomes = dict(zip(names(len(labels)), labels.astype(bool), strict=True))
    people = None
    if p_yes is not None:
        people = pd.DataFrame(
            {"stimulus": names(len(labels)), "scenario": "drop", "count": float(n),
             "accuracy": np.where(labels, p_yes, 1 - p_yes)}
        )  # fmt: skip
    return compare_populations(compare_scores(rows, people, outcomes), rows)


def row(table: pd.DataFrame, **values: str) -> pd.Series:
    found = table[(table[list(values)] == pd.Series(values)).all(axis=1)]
    assert len(found) == 1
    return found.iloc[0]


def independent_members() -> tuple[np.ndarray, np.ndarray]:
    """Return answers of five members who are right with probability 2/3, all patterns as often as
    expected, and outcomes, half of which are contacts."""
    patterns = [p for p in product((True, False), repeat=5) for _ in range(2 ** sum(p))]
    right = np.array(patterns).T
    assert right.shape == (5, 3**5)
    labels = np.repeat([True, False], right.shape[1])
    return np.tile(right, 2) == labels, labels


def test_independent_members_have_the_values_of_probability_theory() -> None:
    answers, labels = independent_members()
    found = populations(predicted(answers), labels, np.where(labels, 0.75, 0.25), n=100)
    consensus = row(found.consensus, population="m", scenario="drop")
    # At least three of five: 10 (2/3)^3 (1/3)^2 + 5 (2/3)^4 (1/3) + (2/3)^5.
    majority = (80 + 80 + 32) / 243
    assert consensus["members"] == 5 and consensus["ties"] == 0
    assert consensus["consensus"] == pytest.approx(majority)
    assert consensus["member"] == pytest.approx(2 / 3)
    assert consensus["member_sd"] == pytest.approx(0)
    own = row(found.agreement, first="m", second="m", scenario="drop")
    assert own["disagreement_members"] == pytest.approx(4 / 9)
    assert own["kappa_members"] == pytest.approx(1 - 2 * 4 / 9)
    # A majority of two, with a coin for ties, is right like one member; one of three in 20/27.
    apart = 2 / 3 * 7 / 27 + 1 / 3 * 20 / 27
    assert own["disagreement_majorities"] == pytest.approx(apart)
    assert own["kappa_majorities"] == pytest.approx(1 - 2 * apart)
    between = row(found.agreement, first=PEOPLE, second="m", scenario="drop")
    assert between["disagreement_members"] == pytest.approx(2 / 3 / 4 + 1 / 3 * 3 / 4)
    assert between["kappa_members"] == pytest.approx(1 / 6)
    assert between["disagreement_majorities"] == pytest.approx(1 - majority)
    assert between["kappa_majorities"] == pytest.approx(2 * majority - 1)
    people = row(found.agreement, first=PEOPLE, second=PEOPLE, scenario="drop")
    # 75 of 100 say yes, or no: 2 x 75 x 25 / (100 x 99).
    assert people["disagreement_members"] == pytest.approx(3750 / 9900)
    less = row(found.differences, population="m", scenario="drop")
    assert less["consensus"] == pytest.approx(majority - 1)
    assert less["member"] == pytest.approx(2 / 3 - 3 / 4)
    assert less["consensus_low"] < less["consensus"] < less["consensus_high"]


def test_halves_of_a_population_against_all_ways_to_halve_it() -> None:
    answers = np.random.default_rng(1).random((5, 40)) < np.linspace(0.1, 0.9, 40)
    labels = np.arange(40) % 3 == 0
    sums = np.zeros(3)

    def majority(votes: np.ndarray) -> np.ndarray:
        more = 2 * votes.sum(axis=0) - len(votes)
        return np.asarray((1 + np.sign(more)) / 2)

    ways = list(combinations(range(5), 2))
    for half in ways:
        rest = [k for k in range(5) if k not in half]
        one, other = majority(answers[list(half)]), majority(answers[rest])
        sums += np.array([one.mean(), other.mean(), (one * other).mean()]) / len(ways)
    a, b, both = sums.tolist()
    found = row(populations(predicted(answers), labels).agreement, first="m", scenario="drop")
    assert found["disagreement_majorities"] == pytest.approx(a + b - 2 * both)
    expected = 1 - (a + b - 2 * both) / (a * (1 - b) + b * (1 - a))
    assert found["kappa_majorities"] == pytest.approx(expected)


def test_kappa_of_members_is_the_mean_of_cohens_kappa_over_pairs() -> None:
    rng = np.random.default_rng(2)
    labels = np.arange(30) % 2 == 0
    first, second = rng.random((3, 30)) < 0.7, rng.random((2, 30)) < 0.4
    first[0] = True  # who always say yes, and no, have a kappa of 0 with each other
    second[0] = False
    found = populations([*predicted(first, "a"), *predicted(second, "b")], labels).agreement
    pairs = {
        ("a", "a"): combinations(first, 2),
        ("b", "b"): combinations(second, 2),
        ("a", "b"): product(first, second),
    }
    for (one, other), raters in pairs.items():
        expected = np.mean([cohen_kappa_score(x, y) for x, y in raters])
        chosen = found["first"].isin([one, other]) & found["second"].isin([one, other])
        chosen &= (found["first"] == found["second"]) == (one == other)
        chosen &= found["scenario"] == "drop"
        assert found.loc[chosen, "kappa_members"].tolist() == [pytest.approx(expected, abs=1e-12)]
    extremes = np.stack([np.ones(30, bool), np.zeros(30, bool)])
    own = row(populations(predicted(extremes), labels).agreement, first="m", scenario=MEAN)
    assert own["kappa_members"] == 0 and own["disagreement_members"] == 1


def test_two_members_whose_ties_are_half_right() -> None:
    answers = np.array([[True, True, False, False], [True, False, True, False]])
    labels = np.array([True, True, False, True])
    found = populations(predicted(answers), labels)
    one = row(found.consensus, population="m", scenario=MEAN)
    assert one["ties"] == 2 and one["consensus"] == pytest.approx((1 + 0.5 + 0.5 + 0) / 4)
    assert found.differences.empty and PEOPLE not in set(found.consensus["population"])


def test_who_is_one_population() -> None:
    answers, labels = np.random.default_rng(0).random((3, 12)) < 0.5, np.arange(12) % 2 == 0
    # Checkpoints of one model; another training of the same name is another population.
    local = [predicted(answers[[k]], "m", [""], init=f"local:{k}")[0] for k in range(2)]
    other = predicted(answers[[2]], "m", [""], init="random")
    found = populations([*local, *other], labels).consensus
    sizes = found[found["scenario"] == MEAN].set_index("population")["members"].to_dict()
    assert sizes == {"m · init local": 2, "m · init random": 1}
    # Models of one member each are one population together, without the readout that detects.
    single = [predicted(answers[[k]], name)[0] for k, name in enumerate("abc")]
    single[2]["readout"] = "full"
    found = populations(single, labels).consensus
    assert set(found["population"]) == {MODELS} and set(found["members"]) == {2}
    # Only what all members predict counts, and what does not is said.
    cut = populations([single[0], single[1].iloc[:9]], labels)
    assert set(cut.consensus["stimuli"]) == {9} and found["stimuli"].max() == 12
    assert "3 of 12 stimuli are left out" in cut.warnings[0]
    with pytest.raises(BadInputError, match="several seeds"):
        populations(single[:1], labels)


def test_people_of_the_study() -> None:
    humans, labels, _, _ = read_averages("official")
    chosen = ["collide", "link", "roll"]
    humans = humans[humans["scenario"].isin(chosen)]
    rows = pd.DataFrame({"stimulus": humans["stimulus"], "p_contact": 0.0})
    rows = name_models(pd.concat([rows.assign(model="m", seed=k) for k in "01"]))
    comparison = compare_scores(rows, humans, labels)
    found = compare_populations(comparison, rows)
    baselines = comparison.baselines.set_index(["model", "scenario"])
    folder = official().results
    accuracy = pd.read_csv(folder / "human_accuracy_by_scenario.csv").set_index("scenario")
    pairs = pd.read_csv(folder / "human_pairwiseCohensKs_by_scenario.csv").set_index("scenario")
    for name in chosen:
        consensus = row(found.consensus, population=PEOPLE, scenario=name)
        released = {"collide": "collision", "link": "linking", "roll": "rollingsliding"}[name]
        assert consensus["member"] == pytest.approx(accuracy.loc[released, "obs_mean"], abs=0.005)
        majority = baselines.loc[("majority of people", name), "accuracy"]
        assert consensus["ties"] == 0 and consensus["consensus"] == pytest.approx(majority)
        people = row(found.agreement, first=PEOPLE, second=PEOPLE, scenario=name)
        # The study's number is the median over pairs of participants.
        assert people["kappa_members"] == pytest.approx(pairs.loc[released, "corr_med"], abs=0.04)
        two = baselines.loc[("one person with another", name), "kappa_from_averages"]
        assert people["kappa_members"] == pytest.approx(two)
        assert people["kappa_majorities"] > people["kappa_members"] + 0.3
    # A population that always gives one answer has no kappa, and says so.
    constant = row(found.agreement, first="m", second="m", scenario=MEAN)
    assert np.isnan(constant["kappa_members"]) and "alike" in constant["reason"]
