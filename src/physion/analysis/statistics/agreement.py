"""Agreement of two sets of answers: functions of arrays over stimuli.

Throughout, ``x`` is a model's P(contact) and ``y`` the fraction of people who say yes. What is
undefined is NaN; nothing is clipped, rounded or corrected unless stated.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

CONSTANT = 1e-6
"""Standard deviation of probabilities below which they count as constant: r is undefined then."""

FEWEST = 3
"""Stimuli below which r is undefined: any two points lie on a line."""


def pearson(x: npt.ArrayLike, y: npt.ArrayLike) -> float:
    """Return Pearson's r of two arrays of shape (n,); NaN if either is constant or n < 3."""
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if len(a) < FEWEST:
        return float("nan")
    a, b = a - a.mean(), b - b.mean()
    sd = np.sqrt(np.mean(a**2)), np.sqrt(np.mean(b**2))
    if min(sd) < CONSTANT:
        return float("nan")
    return float(np.mean(a * b) / (sd[0] * sd[1]))


def rmsd(x: npt.ArrayLike, y: npt.ArrayLike) -> float:
    """Return the root of the mean squared difference; NaN for empty arrays.

    The "RMSE" of the released notebooks is this divided by sqrt(n).
    """
    difference = np.asarray(x, dtype=np.float64) - np.asarray(y, dtype=np.float64)
    return float(np.sqrt(np.mean(difference**2))) if len(difference) else float("nan")


def sampling_variance(y: npt.ArrayLike, count: npt.ArrayLike) -> Array:
    """Return the variance of a fraction of yes due to only ``count`` people having answered, (n,).

    It is y(1 - y) / (count - 1), the unbiased estimate for independent answers, NaN for one person.
    A fraction of 0 or 1 gives 0, so it can be too small for single stimuli, but not in the mean
    over stimuli, for which alone it is used.
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


def reliability(y: npt.ArrayLike, count: npt.ArrayLike, people: float | None = None) -> float:
    """Return the expected r of the average of these people with that of as many others.

    Per-stimulus tables contain no single answers and thus no split halves; instead the variance
    over stimuli is split into the binomial one (`sampling_variance`) and the rest: reliability =
    rest / (rest + binomial). ``people`` gives another size of the groups (half of the count
    corresponds to the official split halves). Answers of one person are assumed to be independent,
    given the stimulus. NaN if people's answers are constant, only one person answered, or the
    binomial variance exceeds the total.
    """
    fraction = np.asarray(y, dtype=np.float64)
    if len(fraction) < FEWEST:
        return float("nan")
    noise = float(np.mean(sampling_variance(fraction, count)))
    total = float(np.var(fraction, ddof=1))
    true = total - noise
    if not true > CONSTANT**2:
        return float("nan")
    if people is not None:
        noise *= float(np.mean(np.asarray(count, dtype=np.float64))) / people
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

    The root of the mean `sampling_variance`; NaN without stimuli or with one person alone.
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
