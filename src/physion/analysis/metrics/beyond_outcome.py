"""Metrics of likeness to people beyond what both owe to the outcome.

Whoever predicts outcomes well resembles people, since people predict them well too: the recorded
outcome itself, a perfect simulator, correlates with P(yes). These metrics take out that part.
"""

from __future__ import annotations

import numpy as np

from physion.analysis.metrics.accuracy import human_accuracy
from physion.analysis.metrics.average_person import ROUNDING, kappa_from_averages
from physion.analysis.metrics.registry import metrics, register_metric
from physion.analysis.sample import Array, Sample, Sums
from physion.analysis.statistics.correlation import correlation_within_groups

BEYOND_OUTCOME = ("r_beyond_outcome", "kappa_beyond_outcome", "kappa_within_outcomes")
"""Names of the metrics of this module."""


@register_metric(
    "r_beyond_outcome",
    label="r beyond the outcome",
    definition="partial correlation of P(contact) with the fraction of people who say yes, given "
    "the official outcome: 0 for a model that knows nothing of people but the outcome",
    better="higher",
    scale="correlation",
    needs="people",
    in_scores=True,
    in_measures=True,
)
def r_beyond_outcome(sample: Sample) -> Array:
    """Return the partial r of P(contact) with P(yes) given the outcome, (b, m).

    Notes
    -----
    With x = P(contact), y = P(yes) and the outcome z (1 or 0)::

        r_xy.z = (r_xy - r_xz r_yz) / sqrt((1 - r_xz^2) (1 - r_yz^2))

    which is, for a z of two values, the correlation of the deviations of x and y from their means
    over the stimuli of the same outcome. It is computed in that form, so that it is also defined
    (and is r) where all outcomes are equal. NaN if x or y is constant given the outcome, as for the
    outcome itself, or for fewer than two stimuli more than there are outcomes.
    """
    contact, no_contact = sample.sums_by_outcome
    return correlation_within_groups([(s.n_people, s.x, s.y, s.xx, s.yy, s.xy)
                                      for s in (contact, no_contact)])  # fmt: skip


def _beyond_of_two_people(sample: Sample) -> Array:
    """Return kappa of two people less (2h - 1)^2."""
    kappa = metrics.get("kappa_from_averages").of_two_people(sample)
    return np.asarray(kappa - (2 * human_accuracy(sample.of_people) - 1) ** 2)


@register_metric(
    "kappa_beyond_outcome",
    label="kappa beyond the outcome",
    definition="kappa from averages less (2a − 1)(2h − 1), what a model of accuracy a has if its "
    "errors are independent of those of people of accuracy h",
    better="higher",
    needs="people",
    in_scores=True,
    in_measures=True,
    two_people=_beyond_of_two_people,
)
def kappa_beyond_outcome(sample: Sample) -> Array:
    """Return kappa less what independent errors give, (b, m).

    Notes
    -----
    With the model's accuracy a and people's accuracy h on the same stimuli::

        kappa - (2a - 1)(2h - 1)

    Two who err independently agree with the probability a h + (1 - a)(1 - h) =
    (1 + (2a - 1)(2h - 1)) / 2. Where agreement by chance is 1/2 (the model or people say yes to
    half of the stimuli), their kappa is (2a - 1)(2h - 1); where both say yes, or no, more often,
    it is less, and values fall below 0: `kappa_within_outcomes` does without that. One person with
    another: a = h.
    """
    sums = sample.sums
    model, human = sums.correct_people / sums.n_people, sums.human / sums.n_people
    return kappa_from_averages(sample) - (2 * model - 1) * (2 * human - 1)


def _within_of_two_people(sample: Sample) -> Array:
    sums = sample.of_people.sums
    yes = sums.y / sums.n_people + 0.5
    agreement = 1 - sums.differ / sums.n_people
    independent = sum(
        _agreeing(part.n_people, _yes_of_people(part), _yes_of_people(part))
        for part in sample.of_people.sums_by_outcome
    )
    return _in_units_of_kappa(agreement - independent / sums.n_people, yes, yes)


@register_metric(
    "kappa_within_outcomes",
    label="kappa within outcomes",
    definition="kappa from averages less what errors give that are independent of people's, with "
    "the same fractions of yes at contacts and at no contacts: 0 for any base rate",
    better="higher",
    needs="people",
    in_scores=True,
    in_measures=True,
    two_people=_within_of_two_people,
)
def kappa_within_outcomes(sample: Sample) -> Array:
    """Return kappa less what errors that are independent given the outcome give, (b, m).

    Notes
    -----
    With the model's answer m and the fraction of people p who say yes, by stimulus, and C as in
    `kappa_from_averages`::

        (A - B) / (1 - C)
        A = mean(m p + (1 - m) (1 - p))                             agreement
        B = mean(m_z p_z + (1 - m_z) (1 - p_z))                     of independent answers

    where m_z and p_z are the means of m and p over the stimuli of the same outcome. It is 0 for a
    constant answer and for the outcome itself, and 0 in expectation for answers drawn independently
    of people's given the outcome, whatever the fraction of contacts.
    """
    sums = sample.sums
    model, people = sums.yes / sums.n_people, _yes_of_people(sums) / sums.n_people
    agreement = 1 - model - people + 2 * sums.both_yes / sums.n_people
    independent = sum(
        _agreeing(part.n_people, part.yes, _yes_of_people(part)) for part in sample.sums_by_outcome
    )
    return _in_units_of_kappa(agreement - independent / sums.n_people, model, people)


def _yes_of_people(sums: Sums) -> Array:
    """Return the sum over stimuli of P(yes)."""
    return sums.y + 0.5 * sums.n_people


def _agreeing(n: Array, first: Array, second: Array) -> Array:
    """Return the expected agreements in n stimuli of two with so many yes in random places."""
    with_both = np.where(n > 0, 2 * first * second / n, 0.0)
    return np.asarray(n - first - second + with_both)


def _in_units_of_kappa(excess: Array, first: Array, second: Array) -> Array:
    """Return an excess of agreement divided by 1 - C, with the fractions of yes of both."""
    rest = first * (1 - second) + second * (1 - first)
    return np.where(rest > ROUNDING, excess / rest, np.nan)
