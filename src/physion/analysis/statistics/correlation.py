"""Pearson's r of many pairs at once, with gaps and with resampling weights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from physion.analysis.statistics.agreement import CONSTANT, FEWEST

Array = npt.NDArray[np.float64]


def correlate_rows(x: npt.ArrayLike, y: npt.ArrayLike) -> Array:
    """Return r of row k of ``x`` with row k of ``y``, both (k, stimuli), where both are known:
    (k,).

    NaN if fewer than 3 are shared or one is constant, as in `agreement.pearson`.
    """
    a, b = np.asarray(x, dtype=np.float64) - 0.5, np.asarray(y, dtype=np.float64) - 0.5
    shared = np.isfinite(a) & np.isfinite(b)
    a, b = np.where(shared, a, 0.0), np.where(shared, b, 0.0)
    return correlation_from_sums(
        shared.sum(axis=1).astype(np.float64),
        a.sum(axis=1), b.sum(axis=1),
        (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1),
    )  # fmt: skip


def correlate_resampled(x: npt.ArrayLike, y: npt.ArrayLike, weights: npt.ArrayLike) -> Array:
    """Return r of each row of ``x`` (m, stimuli) with each row of ``y`` (resamples, stimuli).

    ``weights`` (resamples, stimuli) is how often a stimulus is drawn. Shape (resamples, m). Gaps
    (NaN) are left out pair by pair.
    """
    a, b = np.asarray(x, dtype=np.float64) - 0.5, np.asarray(y, dtype=np.float64) - 0.5
    has_a, has_b = np.isfinite(a).astype(np.float64), np.isfinite(b)
    a, b = np.where(has_a > 0, a, 0.0), np.where(has_b, b, 0.0)
    w = np.where(has_b, np.asarray(weights, dtype=np.float64), 0.0)
    return correlation_from_sums(
        w @ has_a.T, w @ a.T, (w * b) @ has_a.T,
        w @ (a * a).T, (w * b * b) @ has_a.T, (w * b) @ a.T,
    )  # fmt: skip


def correlation_from_sums(n: Array, x: Array, y: Array, xx: Array, yy: Array, xy: Array) -> Array:
    """Return r from sums of values, their squares and products; centre the values near 0."""
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
        defined = (count - used >= FEWEST - 1) & (np.minimum(xx, yy) >= CONSTANT**2)
        return np.asarray(xy / np.sqrt(np.where(defined, xx * yy, np.nan)))
