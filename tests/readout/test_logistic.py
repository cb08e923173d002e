"""Exact readout: scikit-learn's solution, from files and arrays, in little memory."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GridSearchCV, StratifiedKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from physion.core.errors import BadInputError
from physion.readout.decisions import released_decision
from physion.readout.features import StoredFeatures, write_features
from physion.readout.logistic import (
    C_GRID,
    Fit,
    JoinedFeatures,
    LogisticSettings,
    fit_readout,
    grams,
    solve_path,
    undersample,
)


def gram(features: Any, fitted: np.ndarray) -> np.ndarray:
    """Return inner products (n, k) of all trials with the fitted ones."""
    table = JoinedFeatures(features)
    others = np.setdiff1d(np.arange(table.shape[0]), fitted)
    ((within, across),) = grams([table], [Fit(fitted, others)])
    out = np.empty((table.shape[0], len(fitted)))
    out[fitted], out[others] = within, across
    return out


def problem(n: int, d: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return features of many scales and offsets, two of which determine noisy labels."""
    rng = np.random.default_rng(seed)
    plain = rng.normal(size=(n, d))
    answers = plain[:, 0] + plain[:, 1] + rng.normal(size=n) > 0
    return plain * rng.uniform(0.1, 10, d) + rng.normal(size=d) * 5, answers


@pytest.mark.parametrize(("n", "d"), [(60, 20), (80, 2000)])
def test_the_solution_matches_converged_scikit_learn(n: int, d: int) -> None:
    features, labels = problem(n, d)
    kernel = gram(features, np.arange(n))
    weights, intercepts = solve_path(kernel, labels, C_GRID)
    answers = kernel @ weights + intercepts
    scaled = StandardScaler().fit_transform(features)
    for i, c in enumerate(C_GRID):
        oracle = LogisticRegression(C=c, tol=1e-12, max_iter=100_000).fit(scaled, labels)
        expected = oracle.decision_function(scaled)
        worst = np.abs(expected - answers[:, i]).max() / max(1, np.abs(expected).max())
        if c <= 1e5:
            assert worst < 1e-4, f"C = {c}"
        # Beyond that lbfgs itself stops early: ours must be at least as good as the oracle.
        signs = np.where(labels, 1.0, -1.0)

        def objective(f: np.ndarray, square: float, c: float = c, s: Any = signs) -> float:
            return float(c * np.logaddexp(0, -s * f).sum() + square / 2)

        ours = objective(answers[:, i], float(weights[:, i] @ kernel @ weights[:, i]))
        theirs = objective(expected, float((oracle.coef_**2).sum()))
        assert ours <= theirs * (1 + 1e-7) + 1e-9


def test_weak_penalties_are_solved_exactly() -> None:
    """Compared with Newton's method on the features themselves, gradients in extended precision."""
    features, labels = problem(60, 400, seed=7)
    fitted = np.arange(40)
    kernel = gram(features, fitted)
    weights, intercepts = solve_path(kernel[fitted], labels[fitted], C_GRID)
    scaled = StandardScaler().fit(features[fitted]).transform(features)
    axes, triangle = np.linalg.qr(scaled[fitted].T)
    design = np.column_stack([triangle.T, np.ones(40)]).astype(np.longdouble)
    others = np.column_stack([scaled[40:] @ axes, np.ones(20)])
    signs = np.where(labels[fitted], 1, -1).astype(np.longdouble)
    x = np.zeros(41, np.longdouble)
    for k, c in enumerate(C_GRID):
        penalty = np.full(41, 1 / np.longdouble(c))
        penalty[-1] = 0
        for _ in range(60):
            error = 1 / (1 + np.exp(signs * (design @ x)))
            gradient = penalty * x - design.T @ (signs * error)
            hessian = ((design * (error * (1 - error))[:, None]).T @ design).astype(float)
            hessian += np.diag(penalty.astype(float))
            # Equal scales of all directions keep the linear equations well conditioned.
            scale = 1 / np.sqrt(np.diag(hessian))
            right = (scale * gradient).astype(float)
            x = x - scale * np.linalg.solve(hessian * scale[:, None] * scale, right)
        expected = 1 / (1 + np.exp(-(others @ x).astype(float)))
        answers = 1 / (1 + np.exp(-(kernel[40:] @ weights[:, k] + intercepts[k])))
        assert answers == pytest.approx(expected, abs=1e-8), f"C = {c}"


def test_the_whole_readout_matches_a_converged_grid_search() -> None:
    features, labels = problem(70, 300, seed=2)
    train, test, answers = features[:50], features[50:], labels[:50]
    grid = tuple(float(c) for c in np.logspace(-6, 2, 9))
    fitted = fit_readout(train, answers, test, LogisticSettings(grid=grid, seed=4))
    search = GridSearchCV(
        make_pipeline(StandardScaler(), LogisticRegression(tol=1e-10, max_iter=100_000)),
        {"logisticregression__C": grid},
        cv=StratifiedKFold(5, shuffle=True, random_state=4),
    ).fit(train, answers)
    assert fitted.c == search.best_params_["logisticregression__C"]
    assert fitted.cv_accuracy == pytest.approx(search.best_score_)
    assert fitted.probability == pytest.approx(search.predict_proba(test)[:, 1], abs=1e-5)
    assert fitted.train_accuracy == search.score(train, answers)


def test_the_released_setting_stops_after_200_iterations() -> None:
    """Correlated features and a weak penalty, where lbfgs needs more steps than it was given."""
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(150, 6))
    features = factors @ rng.normal(size=(6, 60)) + 0.01 * rng.normal(size=(150, 60))
    labels = factors[:, 0] + 0.8 * rng.normal(size=150) > 0

    def scikit_learn(iterations: int) -> Any:
        model = LogisticRegression(C=1e8, max_iter=iterations)
        return make_pipeline(StandardScaler(), model).fit(features[:120], labels[:120])

    config = LogisticSettings(grid=(1e8,), released=True)
    released = fit_readout(features[:120], labels[:120], features[120:], config)
    with pytest.warns(ConvergenceWarning):
        stopped = scikit_learn(200)
    assert stopped[-1].n_iter_ == [200]
    assert released.probability == pytest.approx(stopped.predict_proba(features[120:])[:, 1])
    longer = scikit_learn(100_000).predict_proba(features[120:])[:, 1]
    assert np.abs(longer - released.probability).max() > 1e-3


@pytest.mark.slow
def test_the_released_decision_is_the_published_grid_search() -> None:
    """17 values of C, 5 folds, lbfgs with 200 iterations, on equally many trials of each label."""
    features, labels = problem(90, 30, seed=5)
    labels[:60] |= np.arange(60) % 3 == 0
    config = LogisticSettings(seed=3)
    reading = released_decision(config).decide([features[:60]], labels[:60], [features[60:]])
    kept = undersample(labels[:60], 3)
    assert labels[kept].sum() * 2 == len(kept) < 60
    search = GridSearchCV(
        make_pipeline(StandardScaler(), LogisticRegression(max_iter=200)),
        {"logisticregression__C": C_GRID},
        cv=StratifiedKFold(5, shuffle=True, random_state=3),
    ).fit(features[kept], labels[kept])
    assert reading.c == search.best_params_["logisticregression__C"]
    assert reading.cv_accuracy == pytest.approx(search.best_score_)
    assert reading.probability == pytest.approx(search.predict_proba(features[60:])[:, 1])


@pytest.mark.parametrize("value", [True, False])
def test_one_answer_only_is_the_rule_of_succession(value: bool) -> None:
    features, _ = problem(8, 5)
    fitted = fit_readout(features, np.full(8, value), features[:3])
    assert fitted.probability == pytest.approx([0.9 if value else 0.1] * 3)
    assert fitted.train_accuracy == 1.0 and np.isnan(fitted.c) and fitted.note == "one answer only"


def test_no_trial_to_fit_is_a_coin() -> None:
    fitted = fit_readout(np.zeros((0, 4)), np.zeros(0, bool), np.ones((2, 4)))
    assert list(fitted.probability) == [0.5, 0.5] and np.isnan(fitted.train_accuracy)


@pytest.mark.parametrize("released", [False, True])
def test_constant_features_say_the_fraction_of_contacts(released: bool) -> None:
    labels = np.array([True] * 6 + [False] * 4)
    config = LogisticSettings(released=released)
    fitted = fit_readout(np.full((10, 3), 7.7), labels, np.full((2, 3), 7.7), config)
    assert fitted.probability == pytest.approx([0.6, 0.6], abs=1e-3)


def test_too_few_trials_of_an_answer_are_said() -> None:
    features, _ = problem(12, 5)
    rare = np.zeros(12, bool)
    rare[0] = True
    alone = fit_readout(features, rare, features)
    assert alone.note == "too few trials to choose C" and alone.c == C_GRID[8]
    rare[1:3] = True
    assert fit_readout(features, rare, features).note == "only 3 folds"


def test_separable_answers_stay_finite_at_every_c() -> None:
    features = np.array([[-2.0], [-1.0], [1.0], [2.0]])
    labels = np.array([False, False, True, True])
    kernel = gram(features, np.arange(4))
    weights, intercepts = solve_path(kernel, labels, C_GRID)
    assert np.isfinite(weights).all() and np.isfinite(intercepts).all()
    margins = kernel @ weights + intercepts
    assert (np.diff(margins[3]) > 0).all(), "a weaker penalty gives a larger margin"
    assert margins[:, -1] == pytest.approx(-margins[::-1, -1], rel=1e-6)


def test_undersampling_keeps_the_rarer_answer_whole() -> None:
    labels = np.array([True] * 3 + [False] * 20)
    kept = undersample(labels, 0)
    assert labels[kept].sum() == 3 and len(kept) == 6 and set(kept) >= {0, 1, 2}
    assert list(undersample(labels, 0)) == list(kept) != list(undersample(labels, 1))
    features, _ = problem(23, 4)
    config = LogisticSettings(balance=True)
    balanced = fit_readout(np.zeros((23, 4)), labels, features, config)
    assert balanced.probability == pytest.approx([0.5] * 23)


def test_bad_features_labels_and_settings_are_refused() -> None:
    features, labels = problem(20, 5)
    broken = features.copy()
    broken[7, 2] = np.nan
    with pytest.raises(BadInputError, match="training trial 7"):
        fit_readout(broken, labels, features)
    with pytest.raises(BadInputError, match="test trial 7"):
        fit_readout(features, labels, broken)
    with pytest.raises(BadInputError, match="one width"):
        fit_readout(features, labels, features[:, :4])
    with pytest.raises(BadInputError, match="labels"):
        fit_readout(features, labels[:4], features)
    for wrong in ({"grid": ()}, {"grid": (1.0, 0.1)}, {"grid": (-1.0, 1.0)}, {"folds": 1}):
        with pytest.raises(BadInputError):
            LogisticSettings(**wrong)  # type: ignore[arg-type]


def features_of(n: int, steps: int, size: int, seed: int = 0) -> np.ndarray:
    """Return float32 features with offsets and scales that differ by column."""
    rng = np.random.default_rng(seed)
    shape = (n, steps, size)
    values = rng.normal(size=shape) * rng.uniform(0.1, 10, shape[1:]) + rng.normal(size=shape[1:])
    return values.astype(np.float32)


def stored(folder: Path, values: np.ndarray) -> StoredFeatures:
    """Return features that are written to files."""
    rows = [
        write_features(folder / f"{values.shape[1]}-{number}.safetensors", {"features": row})
        for number, row in enumerate(values)
    ]
    return StoredFeatures([f"trial {number}" for number in range(len(values))], rows)


def expected_gram(flat: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Return the Gram matrix of all columns at once."""
    exact = flat.astype(np.float64)
    scaled = (exact - exact[fitted].mean(0)) / exact[fitted].std(0)
    product: np.ndarray = scaled @ scaled[fitted].T
    return product


def test_stored_features_are_read_in_any_piece(tmp_path: Path) -> None:
    values = features_of(6, 4, 10)
    features = stored(tmp_path, values)
    assert features.shape == (6, 4, 10) and len(features) == 6
    assert (features.array() == values).all() and features.array().dtype == np.float32
    assert all((features.frame(step) == values[:, step]).all() for step in range(4))
    assert (features.columns(7, 23) == values.reshape(6, -1)[:, 7:23]).all()
    assert features.columns(35, 99).shape == (6, 5)
    chosen = features.select([4, 0, 4])
    assert (chosen.array() == values[[4, 0, 4]]).all()
    assert chosen.trials == ("trial 4", "trial 0", "trial 4")
    assert features.select([]).shape == (0, 4, 10)


@pytest.mark.parametrize("block", [1, 7, 1024])
def test_a_gram_matrix_matches_standardised_features(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    monkeypatch.setattr("physion.readout.logistic._COLUMNS", block)
    monkeypatch.setattr("physion.readout.logistic._READ_BYTES", 1000)
    first, second = features_of(12, 3, 9), features_of(12, 2, 9, seed=1)
    flat = np.concatenate([first, second], axis=1).reshape(12, -1)
    fitted = np.array([7, 0, 3, 4, 9, 11, 2])
    expected = expected_gram(flat, fitted)
    parts: list[Any] = [stored(tmp_path, first), stored(tmp_path, second)]
    for inputs in (flat, [first, second], parts, [first, parts[1]]):
        assert gram(inputs, fitted) == pytest.approx(expected, rel=1e-10, abs=1e-9)


def test_fits_are_standardised_apart_and_rows_count_through_tables(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    values = features_of(15, 2, 30).reshape(15, -1)
    tables = [JoinedFeatures(values[:10]), JoinedFeatures(values[10:], "test")]
    fits = [
        Fit(np.arange(0, 10, 2), np.arange(1, 10, 2)),
        Fit(np.arange(1, 10, 2), np.arange(0, 10, 2)),
        Fit(np.arange(10), np.arange(10, 15)),
    ]
    together = grams(tables, fits)
    for fit, (within, across) in zip(fits, together, strict=True):
        expected = expected_gram(values, fit.fitted)
        assert within == pytest.approx(expected[fit.fitted], rel=1e-10, abs=1e-9)
        assert across == pytest.approx(expected[fit.others], rel=1e-10, abs=1e-9)
    # With little memory the features are read once for every fit.
    monkeypatch.setattr("physion.readout.logistic._GRAM_BYTES", 1)
    for one, other in zip(together, grams(tables, fits), strict=True):
        assert (one[0] == other[0]).all() and (one[1] == other[1]).all()


@pytest.mark.parametrize("released", [False, True])
def test_a_readout_of_files_matches_arrays(tmp_path: Path, released: bool) -> None:
    context, imagined = features_of(50, 3, 40), features_of(50, 2, 40, seed=1)
    labels = context[:, 0, 0] + imagined[:, 1, 3] > np.median(context[:, 0, 0])
    flat = np.concatenate([context, imagined], axis=1).reshape(50, -1)
    config = LogisticSettings(grid=(1e-4, 1e-2, 1.0), balance=True, released=released)
    arrays = fit_readout(flat[:40], labels[:40], flat[40:], config)
    parts = [stored(tmp_path, context), stored(tmp_path, imagined)]
    train, test = ([part.select(rows) for part in parts] for rows in (range(40), range(40, 50)))
    files = fit_readout(train, labels[:40], test, config)
    assert (files.probability == arrays.probability).all()
    assert (files.c, files.cv_accuracy) == (arrays.c, arrays.cv_accuracy)
    nothing = fit_readout(train, labels[:40], [part.select([]) for part in parts], config)
    assert nothing.probability.shape == (0,) and nothing.train_accuracy == arrays.train_accuracy


def test_wrong_features_are_refused(tmp_path: Path) -> None:
    values = features_of(6, 2, 3)
    with pytest.raises(BadInputError, match=r"\(6, 2, 3\), \(5, 2, 3\)"):
        JoinedFeatures([values, values[:5]])
    with pytest.raises(BadInputError, match="not none"):
        JoinedFeatures([])
    with pytest.raises(BadInputError, match=r"not \(6,\)"):
        JoinedFeatures(values[:, 0, 0])
    values[4, 1, 1] = np.inf
    bad = stored(tmp_path, values)
    with pytest.raises(BadInputError, match="training trial 4 has a feature that is not finite"):
        gram(bad, np.arange(6))
    labels = np.array([True, False] * 3)
    with pytest.raises(BadInputError, match="test trial 1 has a feature that is not finite"):
        fit_readout(values[:4], labels[:4], bad.select([0, 4]))


PEAK = """
import json, resource, sys
from pathlib import Path
import numpy as np
from physion.readout.features import StoredFeatures, write_features
from physion.readout.logistic import fit_readout

folder, trials, steps, size = Path(sys.argv[1]), 300, 25, 8000
rng = np.random.default_rng(0)
rows = []
for number in range(trials):
    path = folder / str(number)
    features = rng.standard_normal((steps, size), np.float32) + number % 2 / 10
    rows.append(write_features(path, {"features": features}))
features = StoredFeatures([str(number) for number in range(trials)], rows)
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
before = peak()
fitted = fit_readout(
    features.select(range(200)), np.arange(200) % 2 == 0, features.select(range(200, 300))
)
print(json.dumps({
    "ratio": (peak() - before) / (trials * steps * size * 4),
    "probability": fitted.probability.tolist(),
}))
"""


@pytest.mark.nightly
@pytest.mark.slow
def test_a_readout_needs_less_memory_than_its_features(tmp_path: Path) -> None:
    """The features take 240 MB, their standardised float64 copy would take twice as much."""
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(tmp_path)], capture_output=True, text=True, check=True
    )
    result = json.loads(done.stdout)
    assert result["ratio"] < 0.6
    answers = np.array(result["probability"]) > 0.5
    assert (answers == (np.arange(200, 300) % 2 == 0)).all(), "and it is the right readout"
