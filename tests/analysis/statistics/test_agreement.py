"""Metrics and kappa against scipy, scikit-learn and plain loops; when they are undefined."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats
from sklearn.metrics import cohen_kappa_score

from physion.analysis.intervals import Bootstrap
from physion.analysis.metrics import metrics, score_metrics
from physion.analysis.sample import Sample, sample_of_rows
from physion.analysis.statistics import agreement
from physion.analysis.statistics.agreement import why_no_r
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]

# Multiples of 1/1000: neither equal up to rounding nor too alike to tell from a constant.
shares = st.integers(0, 1000).map(lambda k: k / 1000)
pairs = st.integers(3, 40).flatmap(
    lambda n: hnp.arrays(np.float64, (2, n), elements=shares, unique=False)
)


@given(pairs)
def test_r_matches_scipy(pair: Array) -> None:
    x, y = pair
    r = agreement.pearson(x, y)
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        assert np.isnan(r)
        return
    assert r == pytest.approx(stats.pearsonr(x, y).statistic, abs=1e-9)


def test_r_of_what_is_undefined() -> None:
    assert np.isnan(agreement.pearson([0.1, 0.9], [0.2, 0.8]))
    assert np.isnan(agreement.pearson([0.3] * 5, [0.1, 0.2, 0.3, 0.4, 0.5]))
    assert why_no_r([0.3] * 5, [0.1, 0.2, 0.3, 0.4, 0.5]) == "r: the model's P(contact) is constant"
    assert why_no_r([0.1, 0.2, 0.4], [1.0] * 3) == "r: people's answers are constant"
    assert "fewer than 3" in why_no_r([0.1, 0.2], [0.2, 0.4])
    assert "no answers of people" in why_no_r([0.1], [np.nan])
    assert why_no_r([0.1, 0.2, 0.4], [0.2, 0.4, 0.1]) == ""


def test_ceiling_is_what_a_model_of_the_truth_reaches() -> None:
    """Draw people from known shares: the predicted r, reliability and RMSD must come true."""
    generator = np.random.default_rng(5)
    true, people = generator.beta(1, 1, 4000), 12
    first, second = (generator.binomial(people, true) / people for _ in range(2))
    count = np.full(4000, people)
    assert agreement.ceiling(first, count) == pytest.approx(
        agreement.pearson(true, first), abs=0.01
    )
    reliability = agreement.reliability(first, count)
    assert reliability == pytest.approx(agreement.pearson(first, second), abs=0.01)
    rmsd = np.sqrt(np.mean((true - first) ** 2))
    assert agreement.rmsd_floor(first, count) == pytest.approx(rmsd, abs=0.005)


def test_ceiling_without_a_signal_is_undefined() -> None:
    assert np.isnan(agreement.ceiling([0.5, 0.5, 0.5, 0.5], [10] * 4))
    assert np.isnan(agreement.ceiling([0.1, 0.5, 0.9, 0.5], [1] * 4))
    assert np.isnan(agreement.ceiling([0.1, 0.9], [10] * 2))


# --- scores from sums ------------------------------------------------------------------------


def scores(rows: pd.DataFrame, weights: Array) -> dict[str, Array]:
    sample = sample_of_rows(rows, weights)
    return {metric.name: metric(sample)[:, 0] for metric in score_metrics()}


def rows_of(pair: Array, seed: int) -> pd.DataFrame:
    generator = np.random.default_rng(seed)
    n = pair.shape[1]
    return pd.DataFrame(
        {
            "p_contact": pair[0],
            "p_yes": pair[1],
            "human_accuracy": generator.random(n),
            "count": generator.integers(2, 9, n),
            "predicted": generator.random(n) > 0.5,
            "label": generator.random(n) > 0.5,
            "simulated": generator.random(n) > 0.5,
        }
    )


def plain_kappa(said: npt.ArrayLike, p_yes: npt.ArrayLike) -> float:
    """Kappa with someone drawn for each stimulus, from the four cells of the table of answers."""
    m, p = np.asarray(said, dtype=np.float64), np.asarray(p_yes, dtype=np.float64)
    cells = np.array([[(1 - m) @ (1 - p), (1 - m) @ p], [m @ (1 - p), m @ p]]) / len(m)
    chance = cells.sum(axis=0) @ cells.sum(axis=1)
    return float((np.trace(cells) - chance) / (1 - chance)) if chance < 1 - 1e-12 else np.nan


def plain_within(said: pd.Series, p_yes: pd.Series, outcome: pd.Series) -> float:
    """Twice the covariance within outcomes, over 1 less the agreement by chance."""
    m, p = said.astype(float), p_yes.astype(float)
    apart = [v - v.groupby(outcome).transform("mean") for v in (m, p)]
    rest = m.mean() * (1 - p.mean()) + p.mean() * (1 - m.mean())
    return float(2 * (apart[0] * apart[1]).mean() / rest) if rest > 1e-12 else np.nan


def plain_partial(x: pd.Series, y: pd.Series, outcome: pd.Series) -> float:
    """Pearson's r of the deviations from the mean of the same outcome."""
    groups = outcome.nunique()
    if len(x) - groups < 2:
        return float("nan")
    return agreement.pearson(x - x.groupby(outcome).transform("mean"),
                             y - y.groupby(outcome).transform("mean"))  # fmt: skip


def plain_detection(said: pd.Series, outcome: pd.Series) -> tuple[float, float]:
    """d' and criterion, with half an answer added to each cell."""
    if outcome.all() or not outcome.any():
        return float("nan"), float("nan")
    z = [
        stats.norm.ppf((said[part].sum() + 0.5) / (part.sum() + 1)) for part in (outcome, ~outcome)
    ]
    return z[0] - z[1], -(z[0] + z[1]) / 2


@settings(max_examples=30)
@given(pairs, st.integers(0, 99))
def test_metrics_from_sums_are_the_plain_ones_of_the_drawn_rows(pair: Array, seed: int) -> None:
    rows = rows_of(pair, seed)
    draws = Bootstrap(resamples=2, seed=seed).weights("collide", len(rows))
    weights = np.vstack([np.ones(len(rows)), draws])
    found = scores(rows, weights)
    for number, weight in enumerate(weights):
        drawn = rows.loc[np.repeat(rows.index, weight.astype(int))]
        own = {name: values[number] for name, values in found.items()}
        assert own == pytest.approx(plain_metrics(drawn), abs=1e-7, nan_ok=True)


def plain_metrics(rows: pd.DataFrame) -> dict[str, float]:
    same = rows[rows["label"] == rows["simulated"]]
    expected = {
        "accuracy": (rows["predicted"] == rows["label"]).mean(),
        "accuracy_simulated": (rows["predicted"] == rows["simulated"]).mean(),
        "human_accuracy": rows["human_accuracy"].mean(),
        "r": agreement.pearson(rows["p_contact"], rows["p_yes"]),
        "r_same": agreement.pearson(same["p_contact"], same["p_yes"]),
        "rmsd": np.sqrt(np.mean((rows["p_contact"] - rows["p_yes"]) ** 2)),
        "kappa_from_averages": plain_kappa(rows["predicted"], rows["p_yes"]),
        "r_beyond_outcome": plain_partial(rows["p_contact"], rows["p_yes"], rows["label"]),
    }
    expected["kappa_within_outcomes"] = plain_within(
        rows["predicted"], rows["p_yes"], rows["label"]
    )
    expected["d_prime"], expected["criterion"] = plain_detection(rows["predicted"], rows["label"])
    model, human = expected["accuracy"], expected["human_accuracy"]
    expected["difference"] = model - human
    expected["kappa_beyond_outcome"] = expected["kappa_from_averages"] - (
        (2 * model - 1) * (2 * human - 1)
    )
    return expected


# --- detection --------------------------------------------------------------------------------


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


# --- kappa -------------------------------------------------------------------------------------

answers = st.tuples(st.integers(2, 6), st.integers(1, 25)).flatmap(
    lambda shape: hnp.arrays(np.float64, shape, elements=st.sampled_from([0.0, 1.0]))
)
with_gaps = st.tuples(st.integers(2, 6), st.integers(1, 25)).flatmap(
    lambda shape: hnp.arrays(np.float64, shape, elements=st.sampled_from([0.0, 1.0, np.nan]))
)


def by_scikit_learn(a: Array, b: Array) -> float:
    shared = ~np.isnan(a) & ~np.isnan(b)
    if not shared.any():
        return float("nan")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return float(cohen_kappa_score(a[shared], b[shared]))


@settings(max_examples=40, deadline=None)
@given(with_gaps)
def test_every_pair_is_as_scikit_learn_has_it(values: Array) -> None:
    found = agreement.pairwise_kappa(values)
    for i in range(len(values)):
        for j in range(len(values)):
            expected = by_scikit_learn(values[i], values[j])
            assert found[i, j] == pytest.approx(expected, abs=1e-12, nan_ok=True)


def test_kappa_without_variation() -> None:
    assert np.isnan(agreement.cross_kappa([1, 1, 1], [1, 1, 1])).all()
    # A constant answer and one that varies: no agreement beyond chance, and defined.
    assert agreement.cross_kappa([1, 1, 1, 1], [1, 0, 1, 0]).item() == 0.0
    assert agreement.cross_kappa([1, 0], [0, 1]).item() == -1.0


@settings(deadline=None)
@given(with_gaps)
def test_correlation_matches_scipy(values: Array) -> None:
    found = agreement.pairwise_correlation(values)
    a, b = values[0], values[1]
    shared = ~np.isnan(a) & ~np.isnan(b)
    a, b = a[shared], b[shared]
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        assert np.isnan(found[0, 1])
    else:
        assert found[0, 1] == pytest.approx(stats.pearsonr(a, b).statistic, abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(answers, st.integers(0, 9))
def test_error_consistency_is_the_kappa_of_being_right(values: Array, seed: int) -> None:
    labels = np.random.default_rng(seed).integers(0, 2, values.shape[1]).astype(float)
    found = agreement.pairwise_kappa(agreement.correctness(values, labels))
    right = (values == labels).astype(float)
    expected = by_scikit_learn(right[0], right[1])
    assert found[0, 1] == pytest.approx(expected, abs=1e-12, nan_ok=True)


# --- kappa of draws ------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(with_gaps, st.integers(0, 99))
def test_draws_of_stimuli_are_what_repeating_them_gives(values: Array, seed: int) -> None:
    weights = Bootstrap(resamples=3, seed=seed).weights("x", values.shape[1])
    found = agreement.resampled_kappa(values, values[0], weights)
    for row, weight in zip(found, weights, strict=True):
        drawn = np.repeat(values, weight.astype(int), axis=1)
        expected = agreement.cross_kappa(drawn, drawn[0])[:, 0]
        np.testing.assert_allclose(row, expected, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(with_gaps, st.integers(0, 99))
def test_draws_of_raters_leave_out_pairs_of_one_rater_with_himself(
    values: Array, seed: int
) -> None:
    matrix = agreement.pairwise_kappa(values)
    weights = Bootstrap(resamples=4, seed=seed).weights("people", len(values))
    found = agreement.resampled_mean_of_pairs(matrix, weights)
    for mean, weight in zip(found, weights, strict=True):
        drawn = np.repeat(np.arange(len(values)), weight.astype(int))
        pairs = [
            matrix[i, j]
            for place, i in enumerate(drawn)
            for j in drawn[place + 1 :]
            if i != j and np.isfinite(matrix[i, j])
        ]
        expected = np.mean(pairs) if pairs else np.nan
        assert mean == pytest.approx(expected, abs=1e-12, nan_ok=True)


def test_both_at_once_is_a_draw_of_stimuli_and_then_of_raters() -> None:
    generator = np.random.default_rng(0)
    values = (generator.random((8, 30)) < generator.random(30)).astype(float)
    draws = Bootstrap(resamples=5)
    stimuli, raters = draws.weights("s", 30), draws.weights("r", 8)
    both = agreement.resampled_mean_kappa(values, stimuli, raters)
    for k in range(5):
        drawn = np.repeat(values, stimuli[k].astype(int), axis=1)
        expected = agreement.resampled_mean_of_pairs(
            agreement.pairwise_kappa(drawn), raters[k : k + 1]
        )
        assert both[k] == pytest.approx(expected[0], abs=1e-12)
    alone = agreement.resampled_mean_kappa(values, None, raters)
    np.testing.assert_array_equal(
        alone, agreement.resampled_mean_of_pairs(agreement.pairwise_kappa(values), raters)
    )
    with pytest.raises(BadInputError, match="draws"):
        agreement.resampled_mean_kappa(values, None, None)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([[0, 1, 0.5]], "holds 0.5"),
        ([["yes", "no"]], "must be numbers"),
        (np.zeros((2, 2, 2)), "shape"),
    ],
)
def test_answers_that_are_none_are_refused(values: npt.ArrayLike, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        agreement.pairwise_kappa(values)
    with pytest.raises(BadInputError, match="paired"):
        agreement.cross_kappa([0, 1], [0, 1, 1])
