"""Paired tests of RMSD, kappa and r: against plain numpy, and of the right level."""

from __future__ import annotations

import numpy as np
import pytest

from physion.analysis import Bootstrap
from physion.analysis.model_tests import COLUMNS, PooledStimuli, paired_measures
from physion.analysis.statistics import agreement


def pooled(p: np.ndarray, seed: int = 0, scenarios: int = 2) -> PooledStimuli:
    rng = np.random.default_rng(seed)
    n = p.shape[1]
    label = (rng.random(n) < 0.5).astype(float)
    correct = np.where(np.isnan(p), np.nan, (p > 0.5) == label)
    names = tuple("abcd"[: len(p)])
    scenario = tuple(("collide", "drop")[k % scenarios] for k in range(n))
    return PooledStimuli(names, p, correct, label, rng.random(n), scenario)


def test_differences_match_the_measures() -> None:
    p = np.random.default_rng(1).random((3, 60))
    p[2, :5] = np.nan
    given = pooled(p)
    table = paired_measures(given, permutations=50)
    assert tuple(table.columns) == COLUMNS and len(table) == 3 * 3 * 3
    rows = table.set_index(["scenario", "measure", "first", "second"])
    drop = np.array(given.scenario) == "drop"
    for where, members in (("pooled", np.ones(60, bool)), ("drop", drop)):
        known = members & np.isfinite(p[2])
        y = given.p_yes[known]
        expected = {
            "rmsd": agreement.rmsd(p[0, known], y) - agreement.rmsd(p[2, known], y),
            "r": agreement.pearson(p[0, known], y) - agreement.pearson(p[2, known], y),
        }
        kappas = []
        for k in (0, 2):
            said = p[k, known] > 0.5
            agree = np.mean(np.where(said, y, 1 - y))
            by_guess = said.mean() * y.mean() + (1 - said.mean()) * (1 - y.mean())
            kappas.append((agree - by_guess) / (1 - by_guess))
        expected["kappa_from_averages"] = kappas[0] - kappas[1]
        for measure, value in expected.items():
            row = rows.loc[(where, measure, "a", "c")]
            assert row["difference"] == pytest.approx(value), (where, measure)
            assert row["low"] < value < row["high"] and row["stimuli"] == known.sum()


def test_equal_models_rarely_differ_and_a_better_one_does() -> None:
    rng = np.random.default_rng(2)
    small = 0
    for seed in range(40):
        noise = rng.random((2, 40))
        table = paired_measures(pooled(noise, seed, 1), permutations=199)
        assert set(table["scenario"]) == {"collide"}
        small += int((table["p"] < 0.05).sum())
    assert small <= 18  # of 120 tests; 6 are expected
    given = pooled(rng.random((2, 80)), 5, 1)
    close = np.clip(given.p_yes + rng.normal(0, 0.05, 80), 0, 1)
    better = PooledStimuli(given.names, np.stack([close, given.p_contact[1]]), given.correct,
                           given.label, given.p_yes, given.scenario)  # fmt: skip
    table = paired_measures(better, permutations=199).set_index("measure")
    assert table.loc["rmsd", "difference"] < 0 and table.loc["rmsd", "p"] == pytest.approx(1 / 200)
    assert table.loc["r", "difference"] > 0 and (table["p_holm"] >= table["p"]).all()


def test_without_people_there_is_nothing_to_compare() -> None:
    given = pooled(np.random.default_rng(3).random((2, 30)))
    nobody = PooledStimuli(given.names, given.p_contact, given.correct, given.label,
                           np.full(30, np.nan), given.scenario)  # fmt: skip
    assert paired_measures(nobody, Bootstrap().level, permutations=5).empty
