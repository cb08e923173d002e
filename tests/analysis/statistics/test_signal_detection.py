"""d' and criterion of models: against the textbook, and by weights."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from physion.analysis.metrics import metrics
from physion.analysis.sample import Sample


def sample(predicted: np.ndarray, label: np.ndarray, weights: np.ndarray | None = None) -> Sample:
    n = len(label)
    nobody = np.full((1, n), np.nan)
    return Sample(
        p_contact=np.atleast_2d(predicted),
        predicted=np.atleast_2d(predicted),
        label=label,
        shown=label,
        p_yes=nobody,
        human_accuracy=nobody,
        differ=nobody,
        stimuli=np.ones((1, n)) if weights is None else weights,
    )


def test_rates_have_half_an_answer_added_to_each_side() -> None:
    label = np.array([1.0] * 10 + [0.0] * 10)
    said = np.array([1.0] * 8 + [0.0] * 2 + [1.0] * 3 + [0.0] * 7)
    hit, alarm = stats.norm.ppf(8.5 / 11), stats.norm.ppf(3.5 / 11)
    given = sample(said, label)
    assert metrics.get("d_prime")(given)[0, 0] == pytest.approx(hit - alarm)
    assert metrics.get("criterion")(given)[0, 0] == pytest.approx(-(hit + alarm) / 2)


def test_leaning_to_yes_lowers_the_criterion_and_perfect_answers_are_finite() -> None:
    label = np.array([1.0, 0.0] * 20)
    answers = np.stack([label, np.ones(40), np.zeros(40), 1 - label])
    d, c = (metrics.get(name)(sample(answers, label))[0] for name in ("d_prime", "criterion"))
    assert np.isfinite(d).all() and d[0] > 3 and d[0] == pytest.approx(-d[3])
    assert d[1] == pytest.approx(0) and c[1] < -1 and c[2] == pytest.approx(-c[1])


def test_gaps_and_left_out_stimuli_do_not_count() -> None:
    label = np.array([1.0] * 6 + [0.0] * 6)
    said = np.array([1.0, 1, 1, 0, np.nan, 0, 1, 0, 0, 0, 0, 0])
    weights = np.ones((2, 12))
    weights[1, [3, 11]] = 0
    found = metrics.get("d_prime")(sample(said, label, weights))[:, 0]
    keep = np.setdiff1d(np.arange(12), [3, 4, 11])
    assert found[1] == pytest.approx(metrics.get("d_prime")(sample(said[keep], label[keep]))[0, 0])
    one_class = sample(said[:6], label[:6])
    assert np.isnan(metrics.get("criterion")(one_class)).all()
