"""Jackknife: variances of statistics over drawn stimuli or people, and intervals from them.

A statistic is computed again without each of the units (stimuli or people). Unlike a bootstrap,
which draws the observed people again and so adds their sampling noise to that which the observed
averages have already, this leaves the expected value of the statistic nearly where it is. The
variance of what is nonlinear in the units is estimated too large, which `second_order` corrects.
A few units that weigh much make the estimated variance uncertain, and mostly too small; intervals
are then wider by the degrees of freedom of `degrees_of_freedom`.

References
----------
B. Efron and C. Stein, *The jackknife estimate of variance*, Annals of Statistics 9, 1981, 586-596.
F. E. Satterthwaite, *An approximate distribution of estimates of variance components*, Biometrics
Bulletin 2, 1946, 110-114.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import special

from physion.core.errors import BadInputError
from physion.core.seeds import generator

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int_]

LEVEL = 0.95
"""Fraction of the intervals that contain the expected value of the statistic."""

Scale = Literal["identity", "fraction", "correlation", "positive"]
"""Scale on which a statistic is nearly normal: as it is, or by the logit (0 to 1), the inverse
hyperbolic tangent (-1 to 1) or the logarithm (above 0)."""


class Variance(NamedTuple):
    """Sampling variance of statistics, and its degrees of freedom; NaN where undefined.

    Both have the shape of the statistics.
    """

    value: Array
    df: Array

    def of(self, k: int) -> Variance:
        """Return the variance of statistic ``k`` of several."""
        return Variance(self.value[k], self.df[k])

    def interval(
        self, value: float, level: float = LEVEL, scale: Scale = "identity"
    ) -> tuple[float, float]:
        """Return the interval of a single statistic.

        Parameters
        ----------
        value
            The statistic.
        level
            Probability with which such intervals contain the expected value of the statistic.
        scale
            Where the interval is symmetric. A statistic at the border of the scale's range is taken
            as it is.

        Returns
        -------
        low, high
            NaN if the statistic or its variance is undefined.

        Notes
        -----
        With a scale f, Student's quantile t and the variance V, by the delta method::

            f(low), f(high) = f(value) -+ t f'(value) sqrt(V)

        so that the bounds do not leave the range of the statistic.
        """
        variance = float(self.value)
        if not (np.isfinite(value) and np.isfinite(variance)):
            return float("nan"), float("nan")
        if variance <= 0:
            return value, value
        reach = float(special.stdtrit(float(self.df), 0.5 + level / 2)) * np.sqrt(variance)
        on_scale, back, slope = _SCALES[scale](value)
        return float(back(on_scale - slope * reach)), float(back(on_scale + slope * reach))


def delete_one(sizes: Sequence[int]) -> tuple[list[Array], Integers]:
    """Return weights that leave out each unit of each stratum once.

    Returns
    -------
    weights
        For each stratum an array (1 + n, size), where n is the sum of ``sizes``: ones in row 0; in
        row 1 + k unit k, counted over all strata, has weight 0.
    strata
        (n,): the stratum of each unit.
    """
    strata = np.repeat(np.arange(len(sizes)), sizes)
    weights = []
    for stratum, size in enumerate(sizes):
        rows = np.ones((1 + len(strata), size))
        rows[1 + np.flatnonzero(strata == stratum), np.arange(size)] = 0
        weights.append(rows)
    return weights, strata


def jackknife(
    values: Array,
    strata: Integers | None = None,
    used: npt.NDArray[np.bool_] | None = None,
    *,
    counts: bool = False,
) -> Variance:
    """Return the jackknife estimate of the variance of statistics.

    Parameters
    ----------
    values
        (n, ...): the statistics without each of n units.
    strata
        (n,): stratum of each unit, drawn independently of the others; None: one stratum.
    used
        Of the shape of ``values``: whether the unit enters the statistic at all; None: all do.
    counts
        Whether the statistic is a function of counts, such as an accuracy. Its variance then
        follows from its value, and the degrees of freedom are n - 1.

    Returns
    -------
    variance
        NaN if the statistic is undefined without one of the units, or rests on a single one.

    Notes
    -----
    With n units in a stratum and the statistic v_i without unit i::

        V = (n - 1) / n * sum (v_i - mean(v))^2

    Strata add up, with the degrees of freedom of Welch and Satterthwaite,
    (sum V)^2 / sum (V^2 / df) with the df of `degrees_of_freedom`.
    """
    groups = np.zeros(len(values), dtype=np.int_) if strata is None else strata
    counted = np.ones(values.shape, dtype=bool) if used is None else used
    parts, dfs = [], []
    for stratum in np.unique(groups):
        rows, own = values[groups == stratum], counted[groups == stratum]
        n = own.sum(axis=0).astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.sum(np.where(own, rows, 0.0), axis=0) / n
            apart = np.where(own, rows - mean, 0.0)
            squares = np.sum(apart**2, axis=0)
            parts.append(np.where(n > 1, (n - 1) / n * squares, np.where(n > 0, np.nan, 0.0)))
        dfs.append(np.maximum(n - 1, 1) if counts else degrees_of_freedom(apart, n))
    if not parts:
        return Variance(np.full(values.shape[1:], np.nan), np.full(values.shape[1:], np.nan))
    return add([Variance(part, df) for part, df in zip(parts, dfs, strict=True)])


def variance_of_mean(values: Array, *, counts: bool = False) -> Variance:
    """Return the variance of the mean of values (n, ...), by the jackknife.

    NaN are left out; the result is NaN for fewer than two values. ``counts``: the values are 0 or
    1, as in `jackknife`.
    """
    known = np.isfinite(values)
    filled, n = np.where(known, values, 0.0), known.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        without = (filled.sum(axis=0) - filled) / (n - 1)
    found = jackknife(without, used=known, counts=counts)
    return Variance(np.where(n > 0, found.value, np.nan), found.df)


def wilson(fraction: npt.ArrayLike, n: npt.ArrayLike) -> tuple[Array, Array]:
    """Return Wilson's interval of fractions of ``n`` independent trials; NaN if undefined."""
    p, size = np.asarray(fraction, np.float64), np.asarray(n, np.float64)
    z = float(special.ndtri(0.5 + LEVEL / 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = (p + z * z / (2 * size)) / (1 + z * z / size)
        half = z / (1 + z * z / size) * np.sqrt(p * (1 - p) / size + (z / (2 * size)) ** 2)
    return centre - half, centre + half


def distribution(values: npt.ArrayLike) -> dict[str, float]:
    """Return number, mean, median and middle 95 % of the values that are defined.

    Keys: ``values`` (all of them), ``undefined`` (NaN), ``mean``, ``low``, ``median``, ``high``
    (2.5th, 50th, 97.5th percentile; NaN if nothing is defined).
    """
    array = np.asarray(values, dtype=np.float64)
    known = array[np.isfinite(array)]
    low, median, high = np.percentile(known, [2.5, 50, 97.5]) if len(known) else [np.nan] * 3
    return {"values": len(array), "undefined": len(array) - len(known),
            "mean": float(np.mean(known)) if len(known) else np.nan,
            "low": float(low), "median": float(median), "high": float(high)}  # fmt: skip


def degrees_of_freedom(apart: Array, n: Array) -> Array:
    """Return the degrees of freedom of the variance of n values, from their kurtosis.

    Parameters
    ----------
    apart
        (units, ...): the values less their mean, 0 for units that do not count.
    n
        (...): how many count.

    Returns
    -------
    df
        At least 1 and at most n - 1, which it is for fewer than four values.

    Notes
    -----
    With the excess kurtosis k, the variance of an estimated variance s^2 is::

        s^4 (k / n + 2 / (n - 1))

    (A. M. Mood, F. A. Graybill and D. C. Boes, *Introduction to the Theory of Statistics*, 1974,
    page 229). A multiple of chi-square with the same mean and variance has::

        df = 2 / (k / n + 2 / (n - 1))

    degrees of freedom (Satterthwaite), which is n - 1 for normal values. k is the usual unbiased
    estimate for normal values. Means of few log-normal values still have intervals that are
    somewhat too short, since most samples lack the largest values
    (``benchmarks/analysis/interval_coverage.py``).
    """
    most = np.maximum(n - 1, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        second, fourth = np.sum(apart**2, axis=0) / n, np.sum(apart**4, axis=0) / n
        excess = (n - 1) / ((n - 2) * (n - 3)) * ((n + 1) * (fourth / second**2 - 3) + 6)
        df = 2 / (excess / n + 2 / (n - 1))
    return np.where((n > 3) & (df > 0), np.clip(df, 1.0, most), most)


def add(variances: Sequence[Variance]) -> Variance:
    """Return the variance of a sum of independent parts, by Welch and Satterthwaite."""
    parts = np.stack([variance.value for variance in variances])
    total = parts.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        df = total**2 / np.sum(parts**2 / np.stack([v.df for v in variances]), axis=0)
    # Nothing varies: any number of degrees of freedom gives the same interval.
    return Variance(total, np.where(total > 0, df, np.where(np.isnan(total), np.nan, 1.0)))


def mean_of(variances: Sequence[Variance]) -> Variance:
    """Return the variance of the mean of independent statistics."""
    total = add(variances)
    return Variance(total.value / len(variances) ** 2, total.df)


def second_order(whole: Array, one: Array, two: Array, pairs: Integers) -> Array:
    """Return by how much `jackknife` overestimates the variance of a quadratic statistic.

    Parameters
    ----------
    whole
        (m,): the statistics.
    one
        (n, m): without each of n units.
    two
        (k, m): without both units of each pair; n is 3 or more.
    pairs
        (k, 2): all pairs of units, or a random choice of them.

    Returns
    -------
    excess
        (m,), NaN where a value is.

    Notes
    -----
    The part of a statistic that is bilinear in two units, such as the squared sampling noise of an
    average, counts twice in the jackknife. With ::

        Q_ij = n S - (n - 1) (S_i + S_j) + (n - 2) S_ij

    Efron and Stein subtract sum (Q_ij - mean(Q))^2 / (n (n - 1)) over all pairs, that is, half of
    the variance of Q, which a random choice of pairs estimates.
    """
    n = len(one)
    bilinear = n * whole - (n - 1) * (one[pairs[:, 0]] + one[pairs[:, 1]]) + (n - 2) * two
    return np.asarray(np.var(bilinear, axis=0) / 2)


Scaled = tuple[float, Callable[[float], float], float]


def _identity(value: float) -> Scaled:
    return value, lambda x: x, 1.0


def _fraction(value: float) -> Scaled:
    if not 0 < value < 1:
        return _identity(value)
    return float(special.logit(value)), special.expit, 1 / (value * (1 - value))


def _correlation(value: float) -> Scaled:
    if not -1 < value < 1:
        return _identity(value)
    return float(np.arctanh(value)), np.tanh, 1 / (1 - value**2)


def _positive(value: float) -> Scaled:
    if value <= 0:
        return _identity(value)
    return float(np.log(value)), np.exp, 1 / value


_SCALES: dict[Scale, Callable[[float], Scaled]] = {
    "identity": _identity,
    "fraction": _fraction,
    "correlation": _correlation,
    "positive": _positive,
}
"""For each scale: the value on it, the way back, and the slope of the scale at the value."""


# Bootstrap intervals by drawing people, or whatever else is independent, with replacement.
#
# For means and agreement of people, as preregistered. What depends on the noise of people's
# averages, such as a model's r or RMSD, has the intervals of `jackknife` in the first place, since
# drawing people again adds their noise a second time; the preregistered one stands next to them.


@dataclass(frozen=True)
class Bootstrap:
    """Settings of the bootstrap: number of draws, and their seed."""

    resamples: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        if self.resamples < 1:
            raise BadInputError("a bootstrap needs resamples >= 1")

    def weights(self, stratum: str, n: int) -> Array:
        """Return how often each of ``n`` stimuli or people is drawn: (resamples, n), rows sum to n.

        It depends on the seed, the name of the stratum and n only.
        """
        return _weights(self.resamples, self.seed, stratum, n)

    def interval(self, draws: Array) -> tuple[float, float]:
        """Return the percentile interval of a statistic's ``draws`` (resamples,).

        Draws in which the statistic is undefined are left out; NaN, NaN if less than half remain.
        """
        defined = draws[np.isfinite(draws)]
        if not len(defined) or 2 * len(defined) < len(draws):
            return float("nan"), float("nan")
        tail = 50 * (1 - LEVEL)
        low, high = np.percentile(defined, [tail, 100 - tail])
        return float(low), float(high)


@lru_cache(maxsize=64)
def _weights(resamples: int, seed: int, stratum: str, n: int) -> Array:
    rng = generator("bootstrap", seed, stratum, n)
    drawn = rng.integers(0, n, size=(resamples, n)) if n else np.zeros((resamples, 0), int)
    rows = np.arange(resamples)[:, None] * n
    counts = np.bincount((drawn + rows).ravel(), minlength=resamples * n)
    weights = counts.reshape(resamples, n).astype(np.float64)
    weights.flags.writeable = False
    return weights
