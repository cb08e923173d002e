"""Intervals of ranks: single ranks where models are far apart, and coverage of the true ones."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from physion.analysis.leaderboard.ranks import rank_intervals
from physion.analysis.metrics import Metric, leaderboard_metrics
from physion.analysis.statistics.bootstrap import Bootstrap

QUICK = Bootstrap(resamples=300)
METRICS = {metric.name: metric for metric in leaderboard_metrics()}
STIMULI = 100


def stimuli_of(right: NDArray[np.bool_]) -> pd.DataFrame:
    """Return the rows of models that are right (m, s) at stimuli to which 20 people agree."""
    model, stimulus = (index.ravel() for index in np.indices(right.shape))
    label = stimulus % 2 == 0
    yes = np.where(right.ravel(), label, ~label)
    return pd.DataFrame(
        {
            "file": [f"{one}.csv" for one in model],
            "agent": "agent",
            "scenario": "drop",
            "stimulus": [f"s{one:04d}" for one in stimulus],
            "p_contact": np.where(yes, 0.9, 0.1),
            "predicted": yes.astype(float),
            "label": label,
            "p_yes": np.where(label, 0.8, 0.2),
            "human_accuracy": 0.8,
            "count": 20.0,
        }
    )


def intervals(
    right: NDArray[np.bool_], metric: Metric, draws: Bootstrap = QUICK
) -> list[tuple[int, int]]:
    """Return the interval of the rank of each model."""
    found = rank_intervals(stimuli_of(right), {}, metric, "drop", draws)
    assert list(found["file"]) == [f"{model}.csv" for model in range(len(right))]
    return list(zip(found["rank_low"], found["rank_high"], strict=True))


def wrong_at(*stretches: tuple[int, int]) -> NDArray[np.bool_]:
    """Return models that are wrong from one stimulus to before another."""
    place = np.arange(STIMULI)
    return np.array([(place < start) | (place >= stop) for start, stop in stretches])


@pytest.mark.parametrize("name", ["accuracy", "rmsd", "r"])
def test_models_that_are_far_apart_have_one_rank(name: str) -> None:
    right = wrong_at((0, 90), (0, 1), (0, 60), (0, 30))
    assert intervals(right, METRICS[name]) == [(4, 4), (1, 1), (3, 3), (2, 2)]


@pytest.mark.parametrize("name", ["accuracy", "rmsd", "r"])
def test_equally_good_models_have_both_ranks(name: str) -> None:
    """They are wrong at other stimuli, so that either is better in some draws."""
    right = wrong_at((0, 1), (10, 40), (40, 70), (5, 95))
    assert intervals(right, METRICS[name]) == [(1, 1), (2, 3), (2, 3), (4, 4)]


def test_models_with_the_same_answers_share_one_rank() -> None:
    right = wrong_at((0, 1), (10, 40), (10, 40), (5, 95))
    assert intervals(right, METRICS["accuracy"]) == [(1, 1), (2, 2), (2, 2), (4, 4)]


def test_undefined_scores_are_last_for_certain() -> None:
    """The r of a model that always gives the same probability is undefined in all draws."""
    rows = stimuli_of(wrong_at((0, 1), (10, 40), (40, 70)))
    rows.loc[rows["file"].isin({"1.csv", "2.csv"}), "p_contact"] = 0.5
    found = rank_intervals(rows, {}, METRICS["r"], "drop", QUICK)
    assert found[["rank_low", "rank_high"]].to_numpy().tolist() == [[1, 1], [2, 2], [2, 2]]


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.001, 0.01, 0.05])
def test_intervals_contain_the_true_rank_at_least_as_often_as_they_say(step: float) -> None:
    """Eight models that differ little, or more than the noise of 100 stimuli, in 150 studies."""
    skills = 0.7 + step * (3.5 - np.arange(8))
    rng = np.random.default_rng(0)
    covered, width = np.zeros(8), 0
    for study in range(150):
        right = rng.random((8, STIMULI)) < skills[:, None]
        found = intervals(right, METRICS["accuracy"], Bootstrap(resamples=300, seed=study))
        low, high = np.transpose(found)
        true = 1 + np.arange(8)
        covered += (low <= true) & (true <= high)
        width += np.sum(1 + high - low)
    # The standard error of 95 % is 1.8 %.
    assert (covered / 150 >= 0.93).all()
    if step == 0.05:
        assert width / 150 / 8 < 5.5, "models that are far apart are told apart"
