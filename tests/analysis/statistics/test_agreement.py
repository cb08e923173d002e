"""Metrics: what they are on known answers, what no data may break, when they are undefined."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from physion.analysis.intervals import Bootstrap
from physion.analysis.metrics import metrics, score_metrics
from physion.analysis.sample import Sample, sample_of_rows
from physion.analysis.statistics import agreement
from physion.analysis.statistics.agreement import why_no_r

Array = npt.NDArray[np.float64]

# Multiples of 1/1000: neither equal up to rounding nor too alike to tell from a constant.
shares = st.integers(0, 1000).map(lambda k: k / 1000)
pairs = st.integers(3, 40).flatmap(
    lambda n: hnp.arrays(np.float64, (2, n), elements=shares, unique=False)
)


@given(pairs)
def test_r_matches_scipy_and_symmetric(pair: Array) -> None:
    x, y = pair
    r = agreement.pearson(x, y)
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        assert np.isnan(r)
        return
    assert r == pytest.approx(stats.pearsonr(x, y).statistic, abs=1e-9)
    assert r == pytest.approx(agreement.pearson(y, x), abs=1e-12)


@given(pairs, st.floats(0.1, 1), st.floats(0, 1))
def test_r_ignores_scale_and_shift_and_rmsd_does_not(pair: Array, scale: float, by: float) -> None:
    x, y = pair
    moved = scale * x + by
    assert agreement.pearson(moved, y) == pytest.approx(
        agreement.pearson(x, y), abs=1e-7, nan_ok=True
    )
    assert agreement.rmsd(x + by, x) == pytest.approx(by, abs=1e-9)


def test_r_of_what_is_undefined() -> None:
    assert np.isnan(agreement.pearson([0.1, 0.9], [0.2, 0.8]))
    assert np.isnan(agreement.pearson([0.3] * 5, [0.1, 0.2, 0.3, 0.4, 0.5]))
    assert why_no_r([0.3] * 5, [0.1, 0.2, 0.3, 0.4, 0.5]) == "r: the model's P(contact) is constant"
    assert why_no_r([0.1, 0.2, 0.4], [1.0] * 3) == "r: people's answers are constant"
    assert "fewer than 3" in why_no_r([0.1, 0.2], [0.2, 0.4])
    assert "no answers of people" in why_no_r([0.1], [np.nan])
    assert why_no_r([0.1, 0.2, 0.4], [0.2, 0.4, 0.1]) == ""


def test_rmsd() -> None:
    assert np.isnan(agreement.rmsd([], []))
    assert agreement.rmsd([0.0, 1.0], [0.3, 0.6]) == pytest.approx(np.sqrt((0.09 + 0.16) / 2))


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
    assert agreement.rmsd_floor(first, count) == pytest.approx(
        agreement.rmsd(true, first), abs=0.005
    )
    half = generator.binomial(6, true, size=(2, 4000)) / 6
    expected = agreement.pearson(*half)
    assert agreement.reliability(first, count, people=6) == pytest.approx(expected, abs=0.015)


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


@pytest.mark.slow
@given(pairs, st.integers(0, 99))
def test_metrics_from_sums_are_the_plain_ones(pair: Array, seed: int) -> None:
    rows = rows_of(pair, seed)
    found = {key: value.item() for key, value in scores(rows, np.ones((1, len(rows)))).items()}
    same = rows[rows["label"] == rows["simulated"]]
    expected = {
        "accuracy": (rows["predicted"] == rows["label"]).mean(),
        "accuracy_simulated": (rows["predicted"] == rows["simulated"]).mean(),
        "human_accuracy": rows["human_accuracy"].mean(),
        "r": agreement.pearson(rows["p_contact"], rows["p_yes"]),
        "r_same": agreement.pearson(same["p_contact"], same["p_yes"]),
        "rmsd": agreement.rmsd(rows["p_contact"], rows["p_yes"]),
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
    assert found == pytest.approx(expected, abs=1e-7, nan_ok=True)


@settings(max_examples=25)
@given(pairs, st.integers(0, 99))
def test_resamples_are_what_drawing_rows_gives(pair: Array, seed: int) -> None:
    rows = rows_of(pair, seed)
    weights = Bootstrap(resamples=3, seed=seed).weights("collide", len(rows))
    found = scores(rows, weights)
    for number, weight in enumerate(weights):
        drawn = rows.loc[np.repeat(rows.index, weight.astype(int))]
        plain = agreement.pearson(drawn["p_contact"], drawn["p_yes"])
        assert found["r"][number] == pytest.approx(plain, abs=1e-7, nan_ok=True)
        partial = plain_partial(drawn["p_contact"], drawn["p_yes"], drawn["label"])
        assert found["r_beyond_outcome"][number] == pytest.approx(partial, abs=1e-7, nan_ok=True)
        assert found["rmsd"][number] == pytest.approx(
            agreement.rmsd(drawn["p_contact"], drawn["p_yes"]), abs=1e-9
        )


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
