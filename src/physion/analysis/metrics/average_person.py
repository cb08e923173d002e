"""Metrics of a model with the average person: they need P(yes) by stimulus alone."""

from __future__ import annotations

import numpy as np

from physion.analysis.metrics.registry import register_metric
from physion.analysis.sample import Array, Sample, Sums
from physion.analysis.statistics.correlation import correlation_from_sums

ROUNDING = 1e-12
"""Distance from 1 below which agreement by chance counts as 1."""


def r_of_two_people(sample: Sample) -> Array:
    """Return the expected r of one person's answers with the average of all others, (b, 1).

    Notes
    -----
    A person is drawn anew for each stimulus and left out of the average. With the fraction p who
    say yes, the fraction d of pairs of different people who answer differently, and means over
    stimuli::

        c = mean(p - d / 2) - mean(p)^2               covariance of two different people
        V = mean(p^2) - mean(p)^2 = c + D / n         variance of the average of all n people
        r = c / sqrt(mean(p) (1 - mean(p)) (c + D / (n - 1))),  D = mean(d) / 2

    V gives n, so that the numbers of people by stimulus need not be known. NaN if all answers are
    alike, if fewer than two people answered, or if V is less than c.
    """
    sums = sample.of_people.sums
    centred = sums.y / sums.n_people
    yes, noise = centred + 0.5, sums.differ / sums.n_people / 2
    covariance = yes - noise - yes**2
    of_all = sums.yy / sums.n_people - centred**2 - covariance
    # D / (n - 1) from D and D / n; nobody differs: the others agree exactly too.
    of_others = np.where(noise > 0, of_all * noise / (noise - of_all), 0.0)
    variance = np.where(of_others >= 0, covariance + of_others, np.nan)
    spread = yes * (1 - yes) * variance
    return np.where(spread > ROUNDING, covariance / np.sqrt(spread), np.nan)


@register_metric(
    "r",
    label="r",
    heading="Pearson r",
    definition="correlation over stimuli of P(contact) with the fraction of people who say yes, "
    "that is, with the average person; of one person: with the average of the others",
    better="higher",
    scale="correlation",
    needs="people",
    in_scores=True,
    in_measures=True,
    two_people=r_of_two_people,
)
def pearson_r(sample: Sample) -> Array:
    """Return Pearson's r of P(contact) with P(yes); NaN if either is constant or for less than 3
    stimuli.
    """
    return _correlation(sample.sums)


@register_metric(
    "r_same",
    label="r, same outcome",
    definition="Pearson r without the stimuli whose simulated outcome is not the official one, "
    "since people and model saw different events there; people all saw the official one",
    better="higher",
    scale="correlation",
    needs="people",
    in_scores=True,
    two_people=r_of_two_people,
)
def r_same_outcome(sample: Sample) -> Array:
    """Return Pearson's r over the stimuli whose shown outcome is the official one."""
    return _correlation(sample.sums_same_outcome)


def _kappa_of_two_people(sample: Sample) -> Array:
    """Return kappa of one person with another: agreement 1 - mean of P(they differ)."""
    sums = sample.of_people.sums
    yes = sums.y / sums.n_people + 0.5
    agreement = 1 - sums.differ / sums.n_people
    return _kappa(agreement, yes**2 + (1 - yes) ** 2)


@register_metric(
    "kappa_from_averages",
    label="kappa, from averages",
    heading="kappa",
    definition="Cohen's kappa with a person drawn anew for each stimulus, from P(yes) alone",
    better="higher",
    scale="correlation",
    needs="people",
    in_scores=True,
    in_measures=True,
    two_people=_kappa_of_two_people,
)
def kappa_from_averages(sample: Sample) -> Array:
    """Return Cohen's kappa with a person drawn anew for each stimulus, (b, m).

    Notes
    -----
    With the model's answer m (1 or 0) and the fraction of people p who say yes, by stimulus::

        kappa = (A - C) / (1 - C)
        A = mean(m p + (1 - m) (1 - p))                            agreement
        C = mean(m) mean(p) + (1 - mean(m)) (1 - mean(p))          agreement by chance

    One person with another: A = mean(1 - 2 p (1 - p) n / (n - 1)) with n people, which is the
    fraction of agreeing pairs of different people, and C = mean(p)^2 + (1 - mean(p))^2. NaN where C
    is 1. The mean over participants of their kappa (metric ``kappa``) differs a little, because
    there each participant's own fraction of yes gives C.
    """
    sums = sample.sums
    model, people = sums.yes / sums.n_people, sums.y / sums.n_people + 0.5
    agreement = 1 - model - people + 2 * sums.both_yes / sums.n_people
    return _kappa(agreement, model * people + (1 - model) * (1 - people))


def _kappa(agreement: Array, expected: Array) -> Array:
    return np.where(1 - expected > ROUNDING, (agreement - expected) / (1 - expected), np.nan)


@register_metric(
    "rmsd",
    label="RMSD",
    definition="square root of the mean squared difference between P(contact) and the fraction of "
    "people who say yes",
    better="lower",
    scale="positive",
    needs="people",
    in_scores=True,
    in_measures=True,
)
def rmsd(sample: Sample) -> Array:
    """Return the root of the mean squared difference of P(contact) and P(yes)."""
    return np.sqrt(sample.sums.square / sample.sums.n_people)


@register_metric(
    "euclid_over_n",
    label="",
    definition="RMSD divided by the square root of the number of stimuli: the “RMSE” of the "
    "released notebooks",
    better="lower",
    scale="positive",
    needs="people",
    in_measures=True,
)
def euclid_over_n(sample: Sample) -> Array:
    """Return the RMSD divided by the root of the number of stimuli, as the released notebooks
    do.
    """
    return rmsd(sample) / np.sqrt(sample.sums.n_people)


def _correlation(sums: Sums) -> Array:
    return correlation_from_sums(sums.n_people, sums.x, sums.y, sums.xx, sums.yy, sums.xy)
