"""Cohen's kappa of many answer vectors at once: how much two agree beyond what chance gives.

Answers are arrays of shape (raters, stimuli) that hold 1 (yes), 0 (no) or NaN (not answered). A
pair is compared on the stimuli that both answered, and its chance agreement comes from their shares
of yes on these. Kappa is (observed - chance) / (1 - chance): 1 for equal answers, 0 for what two
independent raters would have, below 0 for less than that. It is NaN where chance agreement is 1
(both always give the same one answer) or where no stimulus is shared.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]


def as_answers(answers: npt.ArrayLike, what: str = "answers") -> Array:
    """Return ``answers`` as float64 (raters, stimuli) with 0, 1 or NaN, else raise
    `BadInputError`.
    """
    try:
        values = np.asarray(answers, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadInputError(f"{what} must be numbers: {error}") from error
    if values.ndim == 1:
        values = values[None, :]
    if values.ndim != 2:
        raise BadInputError(f"{what} must have the shape (raters, stimuli), not {values.shape}")
    strange = ~np.isnan(values) & (values != 0) & (values != 1)
    if strange.any():
        row, column = np.argwhere(strange)[0]
        raise BadInputError(
            f"{what}: rater {row}, stimulus {column} holds {values[row, column]}; "
            "expected 0, 1 or NaN"
        )
    return values


def cross_kappa(
    first: npt.ArrayLike, second: npt.ArrayLike, weights: npt.ArrayLike | None = None
) -> Array:
    """Return kappa of every rater of ``first`` (n, stimuli) with every one of ``second``: (n, m).

    ``weights`` (stimuli,) counts how often each stimulus is in the sample, as in a bootstrap draw.
    """
    a, b = as_answers(first, "first answers"), as_answers(second, "second answers")
    if a.shape[1] != b.shape[1]:
        raise BadInputError(f"answers to {a.shape[1]} and to {b.shape[1]} stimuli cannot be paired")
    counted = np.ones(a.shape[1]) if weights is None else np.asarray(weights, dtype=np.float64)
    return _kappa(_split(a), _split(b), counted)


def pairwise_kappa(answers: npt.ArrayLike) -> Array:
    """Return kappa of every two raters, shape (n, n), symmetric; 1 (or NaN) on the diagonal."""
    values = as_answers(answers)
    return cross_kappa(values, values)


def correctness(answers: npt.ArrayLike, labels: npt.ArrayLike) -> Array:
    """Return 1 for an answer that equals the label, 0 for another, NaN without an answer."""
    values, truth = as_answers(answers), as_answers(labels, "labels")
    right = np.where(values == truth, 1.0, 0.0)
    return np.where(np.isnan(values) | np.isnan(truth), np.nan, right)


def pairwise_correlation(answers: npt.ArrayLike) -> Array:
    """Return Pearson's r of the binary answers of every two raters, (n, n), where both answered.

    NaN if one of them always gives the same answer, or fewer than 3 stimuli are shared.
    """
    values = as_answers(answers)
    given = (~np.isnan(values)).astype(np.float64)
    zeros = np.where(given > 0, values, 0.0)
    n, both = given @ given.T, zeros @ zeros.T
    yes_first = zeros @ given.T
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance = both / n - (yes_first / n) * (yes_first.T / n)
        variance = (yes_first / n) * (1 - yes_first / n)
        r = covariance / np.sqrt(variance * variance.T)
    return np.where((n >= 3) & (variance > 0) & (variance.T > 0), r, np.nan)


def pair_values(matrix: Array) -> Array:
    """Return the values of an (n, n) matrix above its diagonal: each pair once, (n (n-1) / 2,)."""
    return np.asarray(matrix[np.triu_indices(len(matrix), 1)], dtype=np.float64)


def resampled_mean_of_pairs(matrix: Array, weights: npt.ArrayLike) -> Array:
    """Return the mean over pairs of raters in each resample of the raters, shape (resamples,).

    ``matrix`` (n, n) holds a pair's value, ``weights`` (resamples, n) how often each rater is
    drawn. A rater who is drawn twice makes no pair with themselves: the agreement of 1 would raise
    the mean. Pairs without a value are left out; NaN if no pair is left.
    """
    drawn = np.asarray(weights, dtype=np.float64)
    valid = np.isfinite(matrix) & ~np.eye(len(matrix), dtype=bool)
    total = np.sum((drawn @ np.where(valid, matrix, 0.0)) * drawn, axis=1)
    pairs = np.sum((drawn @ valid.astype(np.float64)) * drawn, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(pairs > 0, total / pairs, np.nan)


def resampled_kappa(answers: npt.ArrayLike, other: npt.ArrayLike, weights: npt.ArrayLike) -> Array:
    """Return kappa of each rater (n, stimuli) with one other (stimuli,) in each resample of the
    stimuli.

    ``weights`` (resamples, stimuli) is how often a stimulus is drawn. Shape (resamples, n).
    """
    (yes_a, given_a), (yes_b, given_b) = _split(as_answers(answers)), _split(as_answers(other))
    drawn = np.asarray(weights, dtype=np.float64)
    both = drawn @ (yes_a * yes_b).T
    if given_a is None and given_b is None:
        n = drawn.sum(axis=1)[:, None]
        yes_first, yes_second = drawn @ yes_a.T, drawn @ yes_b.T
    else:
        mask_a = np.ones_like(yes_a) if given_a is None else given_a
        mask_b = np.ones_like(yes_b) if given_b is None else given_b
        n, yes_first = drawn @ (mask_a * mask_b).T, drawn @ (yes_a * mask_b).T
        yes_second = drawn @ (mask_a * yes_b).T
    return _from_counts(n, yes_first, yes_second, both)


def resampled_mean_kappa(
    answers: npt.ArrayLike,
    stimuli: npt.ArrayLike | None,
    raters: npt.ArrayLike | None,
) -> Array:
    """Return the mean kappa of all pairs in each resample of stimuli, of raters, or of both.

    ``stimuli`` (resamples, stimuli) and ``raters`` (resamples, n) count the draws; None: not
    resampled. Shape (resamples,).
    """
    values = as_answers(answers)
    if stimuli is None:
        if raters is None:
            raise BadInputError("give the draws of stimuli, of raters, or of both")
        return resampled_mean_of_pairs(pairwise_kappa(values), raters)
    # Rows that draw the same stimuli share the kappas of pairs.
    draws, row = np.unique(np.asarray(stimuli, dtype=np.float64), axis=0, return_inverse=True)
    people = np.ones((len(row), len(values))) if raters is None else np.asarray(raters, np.float64)
    parts, means = _split(values), np.empty(len(row))
    for at, draw in enumerate(draws):
        rows = np.flatnonzero(row == at)
        means[rows] = resampled_mean_of_pairs(_kappa(parts, parts, draw), people[rows])
    return means


def _split(values: Array) -> tuple[Array, Array | None]:
    """Return answers with 0 for missing ones, and a mask of 0 and 1 (None: nothing is missing)."""
    given = ~np.isnan(values)
    if given.all():
        return values, None
    return np.where(given, values, 0.0), given.astype(np.float64)


def _kappa(a: tuple[Array, Array | None], b: tuple[Array, Array | None], weights: Array) -> Array:
    """Return kappa by matrix products: one if nothing is missing, else four; weights (stimuli,)."""
    yes_a, yes_b = a[0] * weights, b[0]
    both = yes_a @ yes_b.T
    if a[1] is None and b[1] is None:
        n = np.asarray(weights.sum())
        yes_first, yes_second = yes_a.sum(axis=1)[:, None], (yes_b @ weights)[None, :]
    else:
        given_a = (np.ones_like(yes_a) if a[1] is None else a[1]) * weights
        given_b = np.ones_like(yes_b) if b[1] is None else b[1]
        n, yes_first, yes_second = given_a @ given_b.T, yes_a @ given_b.T, given_a @ yes_b.T
    return _from_counts(n, yes_first, yes_second, both)


def _from_counts(n: Array, yes_first: Array, yes_second: Array, both: Array) -> Array:
    """Return kappa from counts: shared stimuli, yes of either rater, yes of both.

    Numerator and denominator are multiplied by n squared, so that they are whole numbers and 1 -
    chance is exactly 0 where it should be.
    """
    expected = yes_first * yes_second + (n - yes_first) * (n - yes_second)
    agree = n * (n - yes_first - yes_second + 2 * both)
    rest = n * n - expected
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rest > 0, (agree - expected) / rest, np.nan)
