"""L2 logistic regression on few trials with very many features, solved exactly.

The objective is scikit-learn's:

    C * sum(log(1 + exp(-y f))) + |w|^2 / 2,    f = w . x + b,  y in {-1, 1},  b not penalised.

With d features and n trials, d >> n, the solution w lies in the span of the n trials, so that
the n x n Gram matrix of inner products is all that is needed of the features. Its
eigenvectors reduce the problem, without approximation, to at most n dimensions, where Newton's
method solves it to rounding error.

The released code stopped lbfgs after 200 iterations, before the optimum
(docs/official-system.md, section 5.4); ``released=True`` does the same.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.core.seeds import generator
from physion.readout.features import StoredFeatures

# Gram matrices of standardised features, which are read in blocks of columns.
#
# All that an L2 readout needs of n trials with d >> n features are the inner products of the
# trials. Features may lie in files; a block of columns of all trials is in memory at a time.

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Part = StoredFeatures | NDArray[Any]
Parts = Part | Sequence[Part]
"""Features (n, d) or (n, T, D) of n trials, or several that are joined in time."""

_READ_BYTES = 2**25
"""Bytes of features that are read at a time."""
_COLUMNS = 1024
"""Columns that are standardised at a time; they should fit into the cache of the processor."""
_GRAM_BYTES = 2**29
"""Bytes of Gram matrices that are summed up at a time; for more, features are read again."""


class JoinedFeatures:
    """Features (n, d) of n trials: parts flattened in time, one after the other.

    Parameters
    ----------
    parts
        Arrays or stored features with the same trials.
    name
        What the trials are, for messages.

    Raises
    ------
    BadInputError
        If the parts have other dimensions, or different numbers of trials.
    """

    def __init__(self, parts: Parts, name: str = "training") -> None:
        joined = [parts] if isinstance(parts, StoredFeatures | np.ndarray) else list(parts)
        shapes = [part.shape for part in joined]
        if not joined or any(len(s) not in (2, 3) or s[0] != shapes[0][0] for s in shapes):
            raise BadInputError(
                f"readout needs features (trials, features) or (trials, time, features) of equal "
                f"trials, not {', '.join(map(str, shapes)) or 'none'}"
            )
        self._parts = [
            part
            if isinstance(part, StoredFeatures)
            else part.reshape(len(part), math.prod(part.shape[1:]))
            for part in joined
        ]
        self._name = name

    @property
    def shape(self) -> tuple[int, int]:
        """Number of trials and of features."""
        return len(self._parts[0]), sum(_width(part) for part in self._parts)

    def columns(self, start: int, stop: int) -> NDArray[Any]:
        """Return columns ``start`` to ``stop``; raise `BadInputError` if one is not finite."""
        if 0 in self.shape:
            return np.zeros((self.shape[0], stop - start), np.float32)
        pieces = []
        for part in self._parts:
            width = _width(part)
            first, last = max(start, 0), min(stop, width)
            if first < last:
                pieces.append(
                    part.columns(first, last)
                    if isinstance(part, StoredFeatures)
                    else part[:, first:last]
                )
            start, stop = start - width, stop - width
        values = pieces[0] if len(pieces) == 1 else np.concatenate(pieces, axis=1)
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise BadInputError(
                f"readout: {self._name} trial {bad[0]} has a feature that is not finite"
            )
        return values

    def select(self, rows: Rows) -> JoinedFeatures:
        """Return the trials with the given row numbers."""
        chosen = [
            part.select(rows) if isinstance(part, StoredFeatures) else part[rows]
            for part in self._parts
        ]
        return JoinedFeatures(chosen, self._name)

    def array(self) -> NDArray[Any]:
        """Return all features, in memory."""
        return self.columns(0, self.shape[1])


@dataclass(frozen=True)
class Fit:
    """Rows of the trials on which a readout is ``fitted``, and of ``others`` it is applied to."""

    fitted: Rows
    others: Rows


def grams(tables: Sequence[JoinedFeatures], fits: Sequence[Fit]) -> list[tuple[Array, Array]]:
    """Return the Gram matrices of several fits.

    Parameters
    ----------
    tables
        Features with the same columns. The rows of `Fit` count through all of them.
    fits
        Fits, each with its own standardisation by its fitted rows (k).

    Returns
    -------
    list
        For every fit the inner products (k, k) of the fitted rows, and (r, k) of the others with
        them.

    Notes
    -----
    Products are in float64. In float32 the errors, about 3e-9 of the largest eigenvalue, change
    probabilities by 1e-6 where features are noisy, but by 6e-4 at C = 1 where they are strongly
    correlated: then many eigenvalues are as small as the errors, and weak penalties depend on them.
    """
    count = sum(table.shape[0] for table in tables)
    at_once = max(1, _GRAM_BYTES // max(1, 8 * count * count))
    results = []
    for first in range(0, len(fits), at_once):
        results += _grams(tables, fits[first : first + at_once])
    return results


def _grams(tables: Sequence[JoinedFeatures], fits: Sequence[Fit]) -> list[tuple[Array, Array]]:
    sums = [
        (np.zeros((len(f.fitted), len(f.fitted))), np.zeros((len(f.others), len(f.fitted))))
        for f in fits
    ]
    for block in _blocks(tables):
        for fit, (within, across) in zip(fits, sums, strict=True):
            fitted, others = _standardise(block, fit)
            within += fitted @ fitted.T
            if len(others):
                across += others @ fitted.T
    return sums


def _standardise(block: Array, fit: Fit) -> tuple[Array, Array]:
    """Return the fitted and the other rows, standardised; constant columns become zero."""
    fitted, others = block[fit.fitted], block[fit.others]
    mean, scale = _center(fitted)
    fitted *= scale
    others -= mean
    others *= scale
    return fitted, others


def _center(fitted: Array) -> tuple[Array, Array]:
    """Take the means off the columns of ``fitted``; return them and 1 / standard deviation."""
    mean: Array = fitted.mean(axis=0)
    fitted -= mean
    deviation = np.sqrt(np.einsum("ij,ij->j", fitted, fitted) / len(fitted))
    # Rounding leaves a constant column a deviation near, but not at, zero.
    varies = deviation > 1e-9 * np.maximum(np.abs(mean), 1e-30)
    return mean, np.divide(1.0, deviation, out=np.zeros_like(deviation), where=varies)


def _blocks(tables: Sequence[JoinedFeatures]) -> Iterator[Array]:
    """Yield the columns of all rows, some at a time, in float64."""
    count, width = sum(table.shape[0] for table in tables), tables[0].shape[1]
    step = max(1, _READ_BYTES // max(1, 4 * count) // _COLUMNS) * _COLUMNS
    for start in range(0, width, step):
        read = [table.columns(start, min(start + step, width)) for table in tables]
        for first in range(0, read[0].shape[1], _COLUMNS):
            yield np.concatenate(
                [values[:, first : first + _COLUMNS] for values in read], dtype=np.float64
            )


def _width(part: Part) -> int:
    return part.width if isinstance(part, StoredFeatures) else int(part.shape[1])


Booleans = NDArray[np.bool_]

C_GRID: tuple[float, ...] = tuple(float(c) for c in np.logspace(-8, 8, 17))
"""Inverse penalties among which cross-validation chooses."""
FOLDS = 5
_RELEASED = 200
"""Iterations after which the released code stopped."""
_ITERATIONS = 200
_TOLERANCE = 1e-9
"""Tolerance of the gradient, relative to its two terms, which cancel at the optimum."""


@dataclass(frozen=True)
class LogisticSettings:
    """Settings of the logistic regression that reads features."""

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
    train: Parts, labels: Booleans, test: Parts, settings: LogisticSettings | None = None
) -> FittedReadout:
    """Fit a readout on ``train`` and predict ``test``.

    Parameters
    ----------
    train
        Features of the fit trials: (n, d), (n, T, D), stored features, or several of these, which
        are joined in time. They set the mean and standard deviation by which all features are
        standardised; a constant feature is ignored.
    labels
        Contact or not (n,). If all are equal, nothing is fitted and the probability follows
        Laplace's rule of succession. If a label occurs fewer than twice there is no
        cross-validation, and C is the middle of the grid.
    test
        Features of the m trials to predict, as ``train``.
    settings
        Settings of the readout.

    Raises
    ------
    BadInputError
        If shapes do not match, or a feature is not finite.
    """
    settings = settings if settings is not None else LogisticSettings()
    labels = np.asarray(labels, bool)
    fit, tested = JoinedFeatures(train), JoinedFeatures(test, "test")
    _check(fit, labels, tested)
    if settings.balance:
        kept = undersample(labels, settings.seed)
        fit, labels = fit.select(kept), labels[kept]
    if constant := one_answer(labels):
        p, accuracy, note = constant
        return FittedReadout(
            np.full(tested.shape[0], p), accuracy, float("nan"), float("nan"), note
        )
    count = len(labels)
    solve = _solve_released if settings.released else _solve_exactly
    c, cv_accuracy, note, scores = solve(fit, labels, tested, settings)
    probability = 1 / (1 + np.exp(-np.clip(scores[count:], -700, 700)))
    accuracy = float(np.mean((scores[:count] > 0) == labels))
    return FittedReadout(probability, accuracy, cv_accuracy, c, note)


def one_answer(labels: Booleans) -> tuple[float, float, str] | None:
    """Return P(contact), accuracy on the fit trials and a note if all have one outcome, else None.

    P is (contacts + 1) / (trials + 2); without any trial it is 1/2, and the accuracy NaN.
    """
    hits, count = int(labels.sum()), len(labels)
    if hits not in (0, count):
        return None
    p = (hits + 1) / (count + 2)
    if count == 0:
        return p, float("nan"), "no trial to fit"
    return p, float(np.mean(labels == (p > 0.5))), "one answer only"


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


def solve_path(kernel: Array, labels: Booleans, grid: tuple[float, ...]) -> tuple[Array, Array]:
    """Return dual weights (k, len(grid)) and intercepts (len(grid),) for each C of ``grid``.

    ``kernel`` (k, k) is the Gram matrix of the fit trials. The decision value of a trial with
    inner products ``g`` (k,) is ``g @ weights + intercept``.
    """
    from scipy.linalg import eigh  # imported late: settings are read without it

    values, vectors = eigh(kernel)
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
    from scipy.linalg import solve

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
        step = -solve(hessian, gradient, assume_a="pos")
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


def _solve_exactly(
    train: JoinedFeatures, labels: Booleans, test: JoinedFeatures, settings: LogisticSettings
) -> tuple[float, float, str, Array]:
    """Return the chosen C, its accuracy, a note, and the decision values (n + m,) of all trials."""
    dual = _solve_dual(train, labels, test, settings)
    return dual.c, dual.cv_accuracy, dual.note, dual.values


@dataclass(frozen=True)
class _Dual:
    """Weights (n,) of the fit trials, intercept, and decision values (n + m,) of all trials."""

    weights: Array
    intercept: float
    values: Array
    c: float
    cv_accuracy: float
    note: str


def _solve_dual(
    train: JoinedFeatures, labels: Booleans, test: JoinedFeatures, settings: LogisticSettings
) -> _Dual:
    """Return the solution at the chosen C.

    The Gram matrices of all folds and of the final fit are made in one pass over the features.
    """
    splits, note = stratified_splits(labels, settings)
    count, everything = len(labels), np.arange(len(labels) + test.shape[0])
    final = Fit(everything[:count], everything[count:])
    *of_folds, (within, across) = grams(
        [train, test], [*(Fit(fitted, held) for fitted, held in splits), final]
    )
    scores = []
    for (fitted, _), (inner, outer) in zip(splits, of_folds, strict=True):
        weights, intercepts = solve_path(inner, labels[fitted], settings.grid)
        scores.append(outer @ weights + intercepts)
    c, cv_accuracy = choose_c(scores, splits, labels, settings)
    # The solution for one C starts from that for the next smaller one.
    weights, intercepts = solve_path(within, labels, tuple(v for v in settings.grid if v <= c))
    chosen, intercept = weights[:, -1], float(intercepts[-1])
    values: Array = np.concatenate([within, across]) @ chosen + intercept
    return _Dual(chosen, intercept, values, c, cv_accuracy, note)


@dataclass(frozen=True)
class LinearReadout:
    """Readout as weights of features as they come, which needs no trial of its fit any more.

    P(contact) is 1 / (1 + exp(-((x - mean) . weights + intercept))) for features x (d,), flattened
    in time. ``train_accuracy``, ``cv_accuracy``, ``c``: as of `FittedReadout`.
    """

    weights: Array
    mean: Array
    intercept: float
    train_accuracy: float
    cv_accuracy: float
    c: float

    def probability(self, features: NDArray[Any]) -> Array:
        """Return P(contact) (m,) from features (m, d)."""
        values = (features.astype(np.float64) - self.mean) @ self.weights + self.intercept
        probability: Array = 1 / (1 + np.exp(-np.clip(values, -700, 700)))
        return probability


def fit_weights(
    train: Parts, labels: Booleans, settings: LogisticSettings | None = None
) -> LinearReadout:
    """Return the readout that `fit_readout` applies to tested trials.

    Notes
    -----
    With standardised features z_i = (x_i - m) / s of the fit trials and dual weights a, decision
    values are sum_i a_i z_i . (x - m) / s + b, so that the weights of x - m are (sum_i a_i z_i) /
    s.

    Raises
    ------
    BadInputError
        As `fit_readout`, and if there are not both outcomes.
    """
    settings = settings if settings is not None else LogisticSettings()
    labels = np.asarray(labels, bool)
    fit = JoinedFeatures(train)
    _check(fit, labels, fit)
    if len(set(labels.tolist())) < 2:
        raise BadInputError(f"readout: {len(labels)} trials without both outcomes give no weights")
    dual = _solve_dual(fit, labels, fit.select(np.arange(0)), settings)
    weights, means = [], []
    for block in _blocks([fit]):
        mean, scale = _center(block)
        weights.append((dual.weights @ block) * scale**2)
        means.append(mean)
    accuracy = float(np.mean((dual.values > 0) == labels))
    return LinearReadout(
        weights=np.concatenate(weights),
        mean=np.concatenate(means),
        intercept=dual.intercept,
        train_accuracy=accuracy,
        cv_accuracy=dual.cv_accuracy,
        c=dual.c,
    )


def _solve_released(
    train: JoinedFeatures, labels: Booleans, test: JoinedFeatures, settings: LogisticSettings
) -> tuple[float, float, str, Array]:
    """Return what `_solve_exactly` does, from scikit-learn's lbfgs with 200 iterations.

    Unlike the exact solution it needs all features in memory, some times over.
    """
    # Here, since importing scikit-learn takes longer than finding a finished evaluation.
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    splits, note = stratified_splits(labels, settings)
    features = train.array()

    def fit(rows: Rows, c: float) -> Any:
        model = make_pipeline(StandardScaler(), LogisticRegression(C=c, max_iter=_RELEASED))
        with warnings.catch_warnings():
            # To stop before the optimum is what was released.
            warnings.simplefilter("ignore", ConvergenceWarning)
            return model.fit(features[rows], labels[rows])

    scores = [
        np.column_stack([fit(f, c).decision_function(features[held]) for c in settings.grid])
        for f, held in splits
    ]
    c, cv_accuracy = choose_c(scores, splits, labels, settings)
    chosen = fit(np.arange(len(labels)), c)
    parts = [features, test.array()]
    values: Array = np.concatenate([chosen.decision_function(part) for part in parts if len(part)])
    return c, cv_accuracy, note, values


def stratified_splits(
    labels: Booleans, settings: LogisticSettings
) -> tuple[list[tuple[Rows, Rows]], str]:
    """Return fitted and held-out rows of every fold of the cross-validation, and a note."""
    folds = min(settings.folds, int(labels.sum()), int((~labels).sum()))
    if len(settings.grid) == 1 or folds < 2:
        return [], "" if len(settings.grid) == 1 else "too few trials to choose C"
    from sklearn.model_selection import StratifiedKFold

    splitter = StratifiedKFold(folds, shuffle=True, random_state=settings.seed)
    splits = list(splitter.split(np.zeros(len(labels)), labels))
    return splits, f"only {folds} folds" if folds < settings.folds else ""


def choose_c(
    scores: list[Array],
    splits: list[tuple[Rows, Rows]],
    labels: Booleans,
    settings: LogisticSettings,
) -> tuple[float, float]:
    """Return the C with the highest mean accuracy over folds, and that accuracy.

    ``scores`` are the decision values (held out, C) of every fold. Among equal accuracies the
    smallest C is taken; without folds, the middle of the grid.
    """
    if not splits:
        return settings.grid[len(settings.grid) // 2], float("nan")
    accuracies = [
        np.mean((values > 0) == labels[held][:, None], axis=0)
        for values, (_, held) in zip(scores, splits, strict=True)
    ]
    mean = np.mean(accuracies, axis=0)
    best = int(np.argmax(mean))
    return settings.grid[best], float(mean[best])


def _check(train: JoinedFeatures, labels: Booleans, test: JoinedFeatures) -> None:
    if train.shape[0] and test.shape[0] and train.shape[1] != test.shape[1]:
        raise BadInputError(
            f"readout needs (n, d) features of one width, not {train.shape} and {test.shape}"
        )
    if labels.shape != (train.shape[0],):
        raise BadInputError(f"readout: {train.shape[0]} trials but {labels.shape} labels")
