"""L2 logistic regression on few trials with very many features, solved exactly.

The objective is that of scikit-learn:

    C * sum(log(1 + exp(-y f))) + |w|^2 / 2,    f = w . x + b,  y in {-1, 1},  b not penalised.

With d features and n trials, d >> n, the solution w lies in the span of the n trials, so that
the n x n Gram matrix of inner products is all that is needed of the features. Its
eigenvectors reduce the problem, without approximation, to at most n dimensions, where Newton's
method solves it to rounding error.

The released code stopped lbfgs after 200 iterations, before the optimum
(docs/official-system.md, section 5.4); ``released=True`` does the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import StratifiedKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from physion.errors import BadInputError
from physion.seeds import generator

Array = NDArray[np.float64]
Booleans = NDArray[np.bool_]

C_GRID: tuple[float, ...] = tuple(float(c) for c in np.logspace(-8, 8, 17))
"""Inverse penalties among which cross-validation chooses."""
FOLDS = 5
_CHUNK = 4096
"""Feature columns that are standardised at a time, which limits the memory."""
_ITERATIONS = 200
_TOLERANCE = 1e-9
"""Tolerance of the gradient, relative to its two terms, which cancel at the optimum."""


@dataclass(frozen=True)
class ReadoutConfig:
    """Settings of a readout."""

    grid: tuple[float, ...] = C_GRID
    """Inverse penalties C among which cross-validation chooses, ascending."""
    folds: int = FOLDS
    """Folds of this cross-validation."""
    seed: int = 0
    """Seed of the folds and of undersampling."""
    balance: bool = False
    """Undersample the more frequent label of the fit trials, as the released code did; tested
    trials are never undersampled."""
    released: bool = False
    """Use scikit-learn's lbfgs with 200 iterations, as released, instead of the exact optimum."""

    def __post_init__(self) -> None:
        if not self.grid or min(self.grid) <= 0 or list(self.grid) != sorted(set(self.grid)):
            raise BadInputError(f"grid of C must be ascending and positive, not {self.grid}")
        if self.folds < 2:
            raise BadInputError(f"cross-validation needs at least 2 folds, not {self.folds}")


@dataclass(frozen=True)
class FittedReadout:
    """Predictions and fit statistics of a readout.

    - ``probability`` (m,): P(contact) of the test trials, 0..1.
    - ``train_accuracy``: accuracy on the fit trials, 0..1; ``cv_accuracy``: mean over folds at
      the chosen C, NaN without cross-validation.
    - ``c``: the chosen inverse penalty, NaN where nothing was fitted.
    - ``note``: what was unusual about the fit, or empty.
    """

    probability: Array
    train_accuracy: float
    cv_accuracy: float
    c: float
    note: str = ""


def fit_readout(
    train: NDArray[Any], labels: Booleans, test: NDArray[Any], config: ReadoutConfig | None = None
) -> FittedReadout:
    """Fit a readout on ``train`` and predict ``test``.

    Parameters
    ----------
    train
        Features (n, d) of the fit trials. They set the mean and standard deviation by which all
        features are standardised; a constant feature is ignored.
    labels
        Contact or not (n,). If all are equal, nothing is fitted and the probability is that of
        Laplace's rule of succession. If a label occurs fewer than twice there is no
        cross-validation, and C is the middle of the grid.
    test
        Features (m, d) of the trials to predict.
    config
        Settings of the readout.

    Raises
    ------
    BadInputError
        If shapes do not match, or a feature is not finite.
    """
    config = config if config is not None else ReadoutConfig()
    labels = np.asarray(labels, bool)
    _check(train, labels, test)
    if config.balance:
        kept = undersample(labels, config.seed)
        train, labels = train[kept], labels[kept]
    hits, count = int(labels.sum()), len(labels)
    if hits in (0, count):
        p = (hits + 1) / (count + 2)
        note = "no trial to fit" if count == 0 else "one answer only"
        accuracy = float("nan") if count == 0 else float(np.mean(labels == (p > 0.5)))
        return FittedReadout(np.full(len(test), p), accuracy, float("nan"), float("nan"), note)
    c, cv_accuracy, note = _choose(train, labels, config)
    everything = np.concatenate([train, test])
    grid = tuple(value for value in config.grid if value <= c)
    scores = _decision_values(everything, np.arange(count), labels, grid, config)[:, -1]
    probability = 1 / (1 + np.exp(-np.clip(scores, -700, 700)))
    accuracy = float(np.mean((scores[:count] > 0) == labels))
    return FittedReadout(probability[count:], accuracy, cv_accuracy, c, note)


def undersample(labels: Booleans, seed: int) -> NDArray[np.int64]:
    """Return sorted rows with all trials of the rarer label and as many, random, of the other.

    Returns all rows if a label does not occur.
    """
    yes, no = np.flatnonzero(labels), np.flatnonzero(~labels)
    count = min(len(yes), len(no))
    if count == 0:
        return np.arange(len(labels))
    rng = generator("undersample", seed)
    picked = [rng.choice(rows, count, replace=False) for rows in (yes, no)]
    return np.sort(np.concatenate(picked))


def gram(features: NDArray[Any], fitted: NDArray[np.int64]) -> Array:
    """Return inner products (n, k) of all rows with the ``fitted`` rows, which also standardise.

    Works on chunks of columns, so that no standardised copy of all features is needed.
    """
    out = np.zeros((len(features), len(fitted)))
    for start in range(0, features.shape[1], _CHUNK):
        block = np.asarray(features[:, start : start + _CHUNK], np.float64)
        mean, deviation = block[fitted].mean(0), block[fitted].std(0)
        # Rounding leaves a constant column a deviation near, but not at, zero.
        varies = deviation > 1e-9 * np.maximum(np.abs(mean), 1e-30)
        block = (block[:, varies] - mean[varies]) / deviation[varies]
        out += block @ block[fitted].T
    return out


def solve_path(kernel: Array, labels: Booleans, grid: tuple[float, ...]) -> tuple[Array, Array]:
    """Return dual weights (k, len(grid)) and intercepts (len(grid),) for each C of ``grid``.

    ``kernel`` (k, k) is the Gram matrix of the fit trials. The decision value of a trial with
    inner products ``g`` (k,) is ``g @ weights + intercept``.
    """
    values, vectors = linalg.eigh(kernel)
    kept = values > max(values[-1], 0.0) * 1e-12
    roots = np.sqrt(values[kept])
    rotated = vectors[:, kept] * roots
    back = vectors[:, kept] / roots
    design = np.column_stack([rotated, np.ones(len(labels))])
    signs = np.where(labels, 1.0, -1.0)
    base_rate = labels.mean()
    solution = np.zeros(design.shape[1])
    solution[-1] = np.log(base_rate / (1 - base_rate))
    weights, intercepts = [], []
    for c in grid:
        solution = _newton(design, signs, c, solution)
        weights.append(back @ solution[:-1])
        intercepts.append(solution[-1])
    return np.column_stack(weights), np.array(intercepts)


def _newton(design: Array, signs: Array, c: float, start: Array) -> Array:
    """Return the optimum for one C, starting from the solution for the next smaller one."""
    penalty = np.full(design.shape[1], 1.0 / (c * len(signs)))
    penalty[-1] = 0.0
    x = start
    value, margins = _objective(design, signs, penalty, x)
    for _ in range(_ITERATIONS):
        error = 1 / (1 + np.exp(np.clip(margins, -700, 700)))
        gradient = penalty * x - design.T @ (signs * error) / len(signs)
        if 0 < np.abs(gradient).max() <= _TOLERANCE * np.abs(penalty * x).max():
            break
        curvature = error * (1 - error) / len(signs)
        hessian = (design * curvature[:, None]).T @ design
        # 1e-15 keeps the Hessian regular when every trial is far from the decision boundary.
        hessian[np.diag_indices_from(hessian)] += penalty + 1e-15
        step = -linalg.solve(hessian, gradient, assume_a="pos")
        slope, length = float(gradient @ step), 1.0
        while length > 1e-10:
            trial, trial_margins = _objective(design, signs, penalty, x + length * step)
            if trial <= value + 1e-4 * length * slope:
                break
            length /= 2
        else:
            break  # no more descent within the rounding error
        gained, x, value, margins = value - trial, x + length * step, trial, trial_margins
        if gained <= 1e-16 * abs(value):
            break
    return x


def _objective(design: Array, signs: Array, penalty: Array, x: Array) -> tuple[float, Array]:
    margins = signs * (design @ x)
    loss = np.logaddexp(0, -margins).mean() + 0.5 * float(penalty @ (x * x))
    return float(loss), margins


def _choose(
    train: NDArray[Any], labels: Booleans, config: ReadoutConfig
) -> tuple[float, float, str]:
    """Return the C with the highest mean accuracy over folds, that accuracy, and a note.

    Among equal accuracies the smallest C is taken.
    """
    folds = min(config.folds, int(labels.sum()), int((~labels).sum()))
    if len(config.grid) == 1 or folds < 2:
        note = "" if len(config.grid) == 1 else "too few trials to choose C"
        return config.grid[len(config.grid) // 2], float("nan"), note
    splitter = StratifiedKFold(folds, shuffle=True, random_state=config.seed)
    accuracies = []
    for fitted, held in splitter.split(np.zeros(len(labels)), labels):
        scores = _decision_values(train, fitted, labels[fitted], config.grid, config)
        accuracies.append(np.mean((scores[held] > 0) == labels[held][:, None], axis=0))
    mean = np.mean(accuracies, axis=0)
    best = int(np.argmax(mean))
    note = f"only {folds} folds" if folds < config.folds else ""
    return config.grid[best], float(mean[best]), note


def _decision_values(
    features: NDArray[Any],
    fitted: NDArray[np.int64],
    labels: Booleans,
    grid: tuple[float, ...],
    config: ReadoutConfig,
) -> Array:
    """Return decision values (n, len(grid)) of all rows; readouts are fitted on ``fitted`` rows."""
    if not config.released:
        kernel = gram(features, fitted)
        weights, intercepts = solve_path(kernel[fitted], labels, grid)
        values: Array = kernel @ weights + intercepts
        return values
    columns = []
    for c in grid:
        model = make_pipeline(StandardScaler(), LogisticRegression(C=c, max_iter=200))
        model.fit(features[fitted], labels)
        columns.append(model.decision_function(features))
    return np.column_stack(columns)


def _check(train: NDArray[Any], labels: Booleans, test: NDArray[Any]) -> None:
    if train.ndim != 2 or test.ndim != 2 or train.shape[1] != test.shape[1]:
        raise BadInputError(
            f"readout needs (n, d) features of one width, not {train.shape} and {test.shape}"
        )
    if labels.shape != (len(train),):
        raise BadInputError(f"readout: {len(train)} trials but {labels.shape} labels")
    for name, values in (("training", train), ("test", test)):
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise BadInputError(f"readout: {name} trial {bad[0]} has a feature that is not finite")
