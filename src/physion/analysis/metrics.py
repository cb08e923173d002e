"""Metrics: the one definition of every number that compares a model with people, in one registry.

A metric is one entry: a function that is decorated with `register_metric`, of three arrays or of a
`Sample`. The tables of scores (`scores.score_table`), of measures with single participants
(`with_participants.measure_table`) and the report ask this registry, so that a new metric appears
in all of them. ``docs/how-to/add-a-metric.md`` shows how to add one. The tables have the order
below: correct answers, signal detection, likeness to the average person, beyond the outcome, and to
single participants.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np

from physion.analysis.intervals import Scale
from physion.analysis.sample import RESAMPLED, Array, Resampled, Sample, Sums
from physion.analysis.statistics.agreement import (
    ROUNDING,
    correctness,
    correlation_from_sums,
    correlation_within_groups,
    cross_kappa,
    in_units_of_kappa,
    kappa_from_fractions,
    z_rates,
)
from physion.core.registry import Registry

Compute = Callable[[Sample], Array]
F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class Metric:
    """A number that is computed for every model, on one scenario or on all together.

    - ``name``: its column and its value of ``measure``;
    - ``compute``: from a `Sample` to values (b, m); undefined is NaN;
    - ``label``: its name in tables of the report (empty: the report leaves it out), ``heading`` in
      the report's table of scores;
    - ``definition``: one sentence for the report;
    - ``better``: which values are better; ``zero``: those nearest to 0; empty: none is;
    - ``needs``: ``outcome`` (of the trials), ``people`` (their averages by stimulus) or
      ``participants`` (their single answers);
    - ``resampled``: what an interval can be about; ``scale``: the one on which it is symmetric;
    - ``in_scores``, ``in_measures``: the tables that contain it: scores of models by stimulus,
      measures with single participants;
    - ``by_participant``: from a `Sample` to the value with each participant (n, m), if any;
    - ``two_people``: from a `Sample` to the value (b, 1) that one person has with another one in
      place of the model, if it is defined.
    """

    name: str
    compute: Compute
    label: str
    heading: str
    definition: str
    better: Literal["higher", "lower", "zero", ""]
    needs: Literal["outcome", "people", "participants"]
    resampled: tuple[Resampled, ...]
    scale: Scale
    in_scores: bool
    in_measures: bool
    by_participant: Compute | None
    two_people: Compute | None
    position: int

    @property
    def counts(self) -> bool:
        """Whether the metric is a function of counts of the model's answers (`jackknife`)."""
        return self.needs == "outcome"

    def __call__(self, sample: Sample) -> Array:
        """Return the values (b, m); division by zero gives NaN without a warning."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.compute(sample), dtype=np.float64)

    def of_two_people(self, sample: Sample) -> Array:
        """Return the values (b, 1) of one person with another; NaN where that is not defined."""
        if self.two_people is None:
            return np.full((len(sample.stimuli), 1), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.two_people(sample), dtype=np.float64)


metrics: Registry[Metric] = Registry("metric")
"""Every metric by name."""

_count = iter(range(1_000_000))


def register_metric(
    name: str,
    *,
    label: str,
    definition: str = "",
    better: Literal["higher", "lower", "zero", ""],
    needs: Literal["outcome", "people", "participants"],
    heading: str = "",
    resampled: tuple[Resampled, ...] = RESAMPLED,
    scale: Scale = "identity",
    in_scores: bool = False,
    in_measures: bool = False,
    by_participant: Compute | None = None,
    two_people: Compute | None = None,
) -> Callable[[F], F]:
    """Register the decorated function as a metric; see `Metric` for the parameters.

    The function takes a `Sample`, or three arrays: ``f(p_model, p_people, label)``, each over the
    stimuli that model and people answered, and returns a number. It is then computed anew for every
    set of weights, so that its intervals are made as for all metrics. Without a ``definition`` the
    first line of its docstring is the definition. Tables list the metrics in the order in which
    they are registered.
    """

    def add(function: F) -> F:
        simple = len(inspect.signature(function).parameters) == 3
        compute = metric_of_arrays(function, needs) if simple else function
        sentence = (inspect.getdoc(function) or "").partition("\n")[0]
        metric = Metric(
            name=name,
            compute=compute,
            label=label,
            heading=heading or label,
            definition=definition or sentence,
            better=better,
            needs=needs,
            resampled=resampled,
            scale=scale,
            in_scores=in_scores,
            in_measures=in_measures,
            by_participant=by_participant,
            two_people=two_people,
            position=next(_count),
        )
        metrics.register(name)(metric)
        return function

    return add


def metric_of_arrays(function: Callable[..., Any], needs: str) -> Compute:
    """Return a metric of a `Sample` from a function of P(contact), P(yes) and the outcome."""

    def compute(sample: Sample) -> Array:
        stimuli, people = sample.stimuli, sample.p_yes
        rows = max(len(stimuli), len(people))
        values = np.full((rows, len(sample.p_contact)), np.nan)
        for row in range(rows):
            p_yes = people[min(row, len(people) - 1)]
            times = np.rint(stimuli[min(row, len(stimuli) - 1)]).astype(np.int64)
            for model, p_contact in enumerate(sample.p_contact):
                known = np.isfinite(p_contact) & (np.isfinite(p_yes) | (needs == "outcome"))
                at = np.repeat(np.arange(len(times)), np.where(known, times, 0))
                if len(at):
                    label = sample.label[at].astype(bool)
                    values[row, model] = function(p_contact[at], p_yes[at], label)
        return values

    return compute


def all_metrics() -> list[Metric]:
    """Return every metric in the order of registration."""
    return sorted((metrics.get(name) for name in metrics.names()), key=lambda one: one.position)


def score_metrics() -> list[Metric]:
    """Return the metrics in the table of scores by stimulus."""
    return [metric for metric in all_metrics() if metric.in_scores]


def measure_metrics() -> list[Metric]:
    """Return the metrics in the table of measures with single participants."""
    return [metric for metric in all_metrics() if metric.in_measures]


# Metrics of correct answers: accuracy of models, of people, and their difference.


def _accuracy_of_people(sample: Sample) -> Array:
    return human_accuracy(sample.of_people)


@register_metric(
    "accuracy",
    label="accuracy",
    definition="fraction of the model's answers that equal the official outcome",
    better="higher",
    scale="fraction",
    needs="outcome",
    resampled=("stimuli", "both"),
    in_scores=True,
    in_measures=True,
    two_people=_accuracy_of_people,
)
def accuracy(sample: Sample) -> Array:
    """Return the fraction of correct answers."""
    return sample.sums.correct / sample.sums.n


@register_metric(
    "accuracy_simulated",
    label="accuracy, simulated outcome",
    heading="against simulated outcome",
    definition="the same answers against the outcome of the trial as it was simulated for the "
    "model",
    better="higher",
    scale="fraction",
    needs="outcome",
    resampled=("stimuli", "both"),
    in_scores=True,
)
def accuracy_simulated(sample: Sample) -> Array:
    """Return the fraction of answers that equal the outcome of the trial that the model was
    shown.
    """
    return sample.sums.correct_shown / sample.sums.n


@register_metric(
    "human_accuracy",
    label="accuracy of people",
    heading="people",
    definition="mean over the same stimuli of the fraction of people who are right",
    better="",
    scale="fraction",
    needs="people",
    in_scores=True,
    two_people=_accuracy_of_people,
)
def human_accuracy(sample: Sample) -> Array:
    """Return the mean over stimuli of the fraction of people who are right."""
    return sample.sums.human / sample.sums.n_people


@register_metric(
    "difference",
    label="accuracy less people's",
    heading="difference",
    definition="accuracy minus people's accuracy on the same stimuli",
    better="higher",
    needs="people",
    in_scores=True,
    in_measures=True,
)
def difference(sample: Sample) -> Array:
    """Return the model's accuracy minus people's accuracy on the same stimuli."""
    return (sample.sums.correct_people - sample.sums.human) / sample.sums.n_people


# Metrics of a model with the average person: they need P(yes) by stimulus only.


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
    """Return kappa of one person with another, who both say yes in yes - P(they differ) / 2."""
    sums = sample.of_people.sums
    yes = sums.y / sums.n_people + 0.5
    return kappa_from_fractions(yes, yes, yes - sums.differ / sums.n_people / 2)


@register_metric(
    "kappa_from_averages",
    label="kappa, from averages",
    heading="kappa",
    definition="Cohen's kappa with a person drawn anew for each stimulus, from P(yes) only",
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
    return kappa_from_fractions(model, people, sums.both_yes / sums.n_people)


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


# Metrics of likeness to people beyond what both owe to the outcome.
#
# Accurate models correlate with people simply because people are accurate: even the recorded
# outcome, a perfect simulator, correlates with P(yes). These metrics remove that part.

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
    "errors are independent of the errors of people of accuracy h",
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
    return in_units_of_kappa(agreement - independent / sums.n_people, yes, yes)


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
    return in_units_of_kappa(agreement - independent / sums.n_people, model, people)


def _yes_of_people(sums: Sums) -> Array:
    """Return the sum over stimuli of P(yes)."""
    return sums.y + 0.5 * sums.n_people


def _agreeing(n: Array, first: Array, second: Array) -> Array:
    """Return the expected agreements in n stimuli of two with so many yes in random places."""
    with_both = np.where(n > 0, 2 * first * second / n, 0.0)
    return np.asarray(n - first - second + with_both)


# Metrics of a model with single participants: they need the answers of each of them.


def _kappa_by_participant(sample: Sample) -> Array:
    return cross_kappa(sample.single_answers.yes, sample.predicted)


def _errors_by_participant(sample: Sample) -> Array:
    return cross_kappa(sample.single_answers.correct, correctness(sample.predicted, sample.label))


def _participants_kappa_of_two_people(sample: Sample) -> Array:
    return sample.kappa_among_people


@register_metric(
    "kappa",
    label="kappa",
    definition="Cohen's kappa with each participant, mean over participants",
    better="higher",
    scale="correlation",
    needs="participants",
    in_measures=True,
    by_participant=_kappa_by_participant,
    two_people=_participants_kappa_of_two_people,
)
def kappa(sample: Sample) -> Array:
    """Return Cohen's kappa with each participant, mean over participants."""
    return sample.mean_kappa


@register_metric(
    "kappa_gap",
    label="kappa less people's",
    definition="kappa less the mean kappa of all pairs of participants: the preregistered "
    "criterion of how similar to people a model answers",
    better="zero",
    needs="participants",
    in_measures=True,
)
def kappa_gap(sample: Sample) -> Array:
    """Return the mean kappa with participants minus the mean kappa among participants.

    NaN for a model that lacks some of the stimuli, on which kappa among people is another one.
    """
    gap = sample.mean_kappa - sample.kappa_among_people
    return np.where(np.isnan(sample.predicted).any(axis=1), np.nan, gap)


@register_metric(
    "error_consistency",
    label="error consistency",
    definition="kappa of right and wrong answers with each participant, mean over participants "
    "(Geirhos and others, 2020)",
    better="higher",
    scale="correlation",
    needs="participants",
    in_measures=True,
    by_participant=_errors_by_participant,
)
def error_consistency(sample: Sample) -> Array:
    """Return the kappa of correctness with each participant, mean over participants."""
    return sample.mean_error_consistency


# Metrics of signal detection: how well a model tells contacts from others, and how it leans.


@register_metric(
    "d_prime",
    label="d′",
    definition="z of the rate of yes at contacts less that at no contacts, with half an answer "
    "added to each side; 0 for guessing",
    better="higher",
    needs="outcome",
    resampled=("stimuli", "both"),
    in_scores=True,
)
def d_prime(sample: Sample) -> Array:
    """Return d' of the model's answers."""
    hits, alarms = z_rates(sample.predicted, sample.label, sample.stimuli)
    return hits - alarms


@register_metric(
    "criterion",
    label="criterion",
    definition="minus the mean of the two z of d′; below 0 the model leans to yes",
    better="zero",
    needs="outcome",
    resampled=("stimuli", "both"),
    in_scores=True,
)
def criterion(sample: Sample) -> Array:
    """Return the criterion of the model's answers."""
    hits, alarms = z_rates(sample.predicted, sample.label, sample.stimuli)
    return -(hits + alarms) / 2
