"""Agreement of two sets of answers: Pearson's r, Cohen's kappa, noise ceilings.

Functions of arrays over stimuli: ``x`` is a model's P(contact), ``y`` the fraction of people who
say yes. What is undefined is NaN; nothing is clipped, rounded or corrected unless stated. Every
correlation of the package is computed by `correlation_from_sums`, which the others call with the
sums of one pair, of many pairs with gaps, or of resamples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]

CONSTANT = 1e-6
"""Standard deviation of probabilities below which they count as constant: r is undefined then."""

FEWEST = 3
"""Stimuli below which r is undefined: any two points lie on a line."""


def pearson(x: npt.ArrayLike, y: npt.ArrayLike) -> float:
    """Return Pearson's r of two arrays of shape (n,); NaN if either is constant or n < 3."""
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if not len(a):
        return float("nan")
    a, b = a - a.mean(), b - b.mean()  # sums of squares of what is not near 0 would be inexact
    sums = (a.sum(), b.sum(), (a * a).sum(), (b * b).sum(), (a * b).sum())
    return float(correlation_from_sums(np.float64(len(a)), *map(np.float64, sums)))


def sampling_variance(y: npt.ArrayLike, count: npt.ArrayLike) -> Array:
    """Return the variance of a fraction of yes due to only ``count`` people having answered, (n,).

    It is y(1 - y) / (count - 1), the unbiased estimate for independent answers, NaN for one person.
    A fraction of 0 or 1 gives 0, so it can be too small for single stimuli, but not in the mean
    over stimuli, for which only it is used.
    """
    fraction, people = np.asarray(y, dtype=np.float64), np.asarray(count, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(people > 1, fraction * (1 - fraction) / (people - 1), np.nan)


def pair_difference(y: npt.ArrayLike, count: npt.ArrayLike) -> Array:
    """Return the fraction of pairs of different people who answer a stimulus differently, (n,).

    It is 2 y (1 - y) count / (count - 1), the unbiased estimate of the probability that two people
    answer differently; NaN for one person.
    """
    return 2 * np.asarray(count, dtype=np.float64) * sampling_variance(y, count)


def reliability(y: npt.ArrayLike, count: npt.ArrayLike) -> float:
    """Return the expected r of the average of these people with the average of as many others.

    Per-stimulus tables contain no single answers and thus no split halves; instead the variance
    over stimuli is split into the binomial one (`sampling_variance`) and the rest: reliability =
    rest / (rest + binomial). Answers of one person are assumed to be independent, given the
    stimulus. NaN if people's answers are constant, only one person answered, or the binomial
    variance exceeds the total.
    """
    fraction = np.asarray(y, dtype=np.float64)
    if len(fraction) < FEWEST:
        return float("nan")
    noise = float(np.mean(sampling_variance(fraction, count)))
    total = float(np.var(fraction, ddof=1))
    true = total - noise
    if not true > CONSTANT**2:
        return float("nan")
    return true / (true + noise)


def ceiling(y: npt.ArrayLike, count: npt.ArrayLike) -> float:
    """Return the noise ceiling of r: the expected r of a model that knows the true fractions of
    yes.

    The square root of `reliability`: less than 1, since the average of finitely many people is
    noisy. A model can exceed it by chance. NaN as for `reliability`.
    """
    return float(np.sqrt(reliability(y, count)))


def rmsd_floor(y: npt.ArrayLike, count: npt.ArrayLike) -> float:
    """Return the expected RMSD of a model that knows the true fractions of yes.

    The root of the mean `sampling_variance`; NaN without stimuli or with one person only.
    """
    noise = sampling_variance(y, count)
    return float(np.sqrt(np.mean(noise))) if len(noise) else float("nan")


def why_no_r(x: npt.ArrayLike, y: npt.ArrayLike) -> str:
    """Return why Pearson's r of these is undefined; empty if it is defined."""
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if not np.isfinite(b).all():
        return "r: no answers of people"
    if len(a) < FEWEST:
        return f"r: fewer than {FEWEST} stimuli"
    if np.std(a) < CONSTANT:
        return "r: the model's P(contact) is constant"
    return "r: people's answers are constant" if np.std(b) < CONSTANT else ""


def why_no_r_within(x: npt.ArrayLike, y: npt.ArrayLike, outcome: npt.ArrayLike) -> str:
    """Return why r given the outcome is undefined although r is not; empty if it is defined."""
    a, b, z = (np.asarray(values, dtype=np.float64) for values in (x, y, outcome))
    kinds = np.unique(z)
    if len(a) - len(kinds) < FEWEST - 1:
        return "r beyond the outcome: too few stimuli of each outcome"
    for values, whose in ((a, "the model's P(contact)"), (b, "people's P(yes)")):
        if max(np.std(values[z == kind]) for kind in kinds) < CONSTANT:
            return f"r beyond the outcome: {whose} is constant given the outcome"
    return ""


def correlate_rows(x: npt.ArrayLike, y: npt.ArrayLike) -> Array:
    """Return r of row k of ``x`` with row k of ``y``, both (k, stimuli), where both are known:
    (k,).

    NaN if fewer than 3 are shared or one is constant, as in `pearson`.
    """
    a, b = np.asarray(x, dtype=np.float64) - 0.5, np.asarray(y, dtype=np.float64) - 0.5
    shared = np.isfinite(a) & np.isfinite(b)
    a, b = np.where(shared, a, 0.0), np.where(shared, b, 0.0)
    return correlation_from_sums(
        shared.sum(axis=1).astype(np.float64),
        a.sum(axis=1), b.sum(axis=1),
        (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1),
    )  # fmt: skip


def correlation_from_sums(
    n: npt.ArrayLike,
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    xx: npt.ArrayLike,
    yy: npt.ArrayLike,
    xy: npt.ArrayLike,
) -> Array:
    """Return r from sums of values, their squares and products; centre the values near 0."""
    n, x, y, xx, yy, xy = (np.asarray(sums, np.float64) for sums in (n, x, y, xx, yy, xy))
    with np.errstate(divide="ignore", invalid="ignore"):
        variance_x, variance_y = xx / n - (x / n) ** 2, yy / n - (y / n) ** 2
        defined = (n >= FEWEST) & (np.minimum(variance_x, variance_y) >= CONSTANT**2)
        product = np.where(defined, variance_x * variance_y, np.nan)
        return np.asarray((xy / n - (x / n) * (y / n)) / np.sqrt(product))


def correlation_within_groups(
    groups: Sequence[tuple[Array, Array, Array, Array, Array, Array]],
) -> Array:
    """Return r of the deviations from the means of each group, from the groups' sums.

    Parameters
    ----------
    groups
        For each group of stimuli the sums (n, x, y, xx, yy, xy) as in `correlation_from_sums`.

    Notes
    -----
    With the squares and products S of deviations from the means within the groups,
    r = S_xy / sqrt(S_xx S_yy): the partial correlation given the group. NaN if either is constant
    within all groups, or for fewer than two stimuli more than there are groups with stimuli, when
    the deviations always lie on a line.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        count = np.sum([n for n, *_ in groups], axis=0)
        used = np.sum([n > 0 for n, *_ in groups], axis=0)
        xx, yy, xy = (
            np.sum([np.where(sums[0] > 0, sums[k] - sums[i] * sums[j] / sums[0], 0.0)
                    for sums in groups], axis=0) / count
            for k, i, j in ((3, 1, 1), (4, 2, 2), (5, 1, 2))
        )  # fmt: skip
    # Deviations from the means of k groups are as many as n - k + 1 values with a mean of 0.
    free = count - used + 1
    zero = np.zeros_like(xx)
    return correlation_from_sums(free, zero, zero, free * xx, free * yy, free * xy)


# Cohen's kappa of many answer vectors at once: how much two agree beyond what chance gives.
#
# Answers are arrays of shape (raters, stimuli) that hold 1 (yes), 0 (no) or NaN (not answered). A
# pair is compared on the stimuli that both answered, and its chance agreement comes from their
# fractions of yes on these. Kappa is (observed - chance) / (1 - chance): 1 for equal answers, 0 for
# what two independent raters would have, below 0 for less than that. It is NaN where chance
# agreement is 1 (both always give the same one answer) or where no stimulus is shared.


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


def cross_kappa(first: npt.ArrayLike, second: npt.ArrayLike) -> Array:
    """Return kappa of every rater of ``first`` (n, stimuli) with each of ``second``: (n, m)."""
    a, b = as_answers(first, "first answers"), as_answers(second, "second answers")
    if a.shape[1] != b.shape[1]:
        raise BadInputError(f"answers to {a.shape[1]} and to {b.shape[1]} stimuli cannot be paired")
    return _kappa(_split(a), _split(b), np.ones(a.shape[1]))


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
    # An answer of 0 or 1 is its own square.
    return correlation_from_sums(n, yes_first, yes_first.T, yes_first, yes_first.T, both)


def pair_values(matrix: Array) -> Array:
    """Return the values of an (n, n) matrix above its diagonal: each pair once, (n (n-1) / 2,)."""
    return np.asarray(matrix[np.triu_indices(len(matrix), 1)], dtype=np.float64)


ROUNDING = 1e-12
"""Distance from 1 below which agreement by chance counts as 1."""


def kappa_from_fractions(first: npt.ArrayLike, second: npt.ArrayLike, both: npt.ArrayLike) -> Array:
    """Return kappa of two raters from their fractions of yes, and the fraction of yes by both.

    Agreement exceeds the one by chance by 2 (both - first second); NaN where chance gives 1.
    """
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    return in_units_of_kappa(2 * (np.asarray(both, np.float64) - a * b), a, b)


def in_units_of_kappa(excess: Array, first: Array, second: Array) -> Array:
    """Return an excess of agreement divided by 1 less the agreement by chance.

    ``first``, ``second``: fractions of yes. NaN where chance gives 1.
    """
    rest = first * (1 - second) + second * (1 - first)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rest > ROUNDING, excess / rest, np.nan)


def z_rates(yes: Array, contact: Array, weights: Array) -> tuple[Array, Array]:
    """Return z of the rates of hits and of false alarms, each (b, m).

    Parameters
    ----------
    yes
        (m, s): answers 1, 0 or NaN.
    contact
        (s,): outcomes, 1 or 0.
    weights
        (b, s): how often each stimulus counts.

    Notes
    -----
    With h answers yes at n contacts, z is the normal quantile of (h + 1/2) / (n + 1): the
    log-linear correction, by which d' without an error is finite. d' is the first less the second,
    the criterion minus their mean. NaN if there is no stimulus of the outcome.
    """
    known = np.isfinite(yes)
    said = np.where(known, yes, 0.0)
    rates = []
    for outcome in (1.0, 0.0):
        own = weights * (contact == outcome)
        total = own @ known.T.astype(np.float64)
        rates.append(np.where(total > 0, ndtri((own @ said.T + 0.5) / (total + 1)), np.nan))
    return rates[0], rates[1]


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
