"""Registry of the metrics: the one definition of every number that compares a model with people.

A metric is one entry: a function of a `Sample`, decorated with `register_metric`. The tables of
scores (`models.score_tables`), of measures (`models.model_people`), the leaderboard and the report
ask this registry, so that a new metric appears in all of them. ``docs/how-to/add-a-metric.md``
shows how to add one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from physion.analysis.sample import RESAMPLED, Array, Resampled, Sample, Sums
from physion.analysis.statistics.correlation import correlation_from_sums
from physion.analysis.statistics.kappa import correctness, cross_kappa
from physion.registry import Registry

Compute = Callable[[Sample], Array]


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
    - ``resampled``: what an interval can be drawn over;
    - ``in_scores``, ``in_measures``, ``on_leaderboard``: the tables that contain it: scores of
      models by stimulus, measures with single participants, the leaderboard;
    - ``by_participant``: from a `Sample` to the value with each participant (n, m), if any.
    """

    name: str
    compute: Compute
    label: str
    heading: str
    definition: str
    better: Literal["higher", "lower", "zero", ""]
    needs: Literal["outcome", "people", "participants"]
    resampled: tuple[Resampled, ...]
    in_scores: bool
    in_measures: bool
    on_leaderboard: bool
    by_participant: Compute | None
    position: int

    def __call__(self, sample: Sample) -> Array:
        """Return the values (b, m); division by zero gives NaN without a warning."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.compute(sample), dtype=np.float64)


metrics: Registry[Metric] = Registry("metric")
"""Every metric by name."""

_count = iter(range(1_000_000))


def register_metric(
    name: str,
    *,
    label: str,
    definition: str,
    better: Literal["higher", "lower", "zero", ""],
    needs: Literal["outcome", "people", "participants"],
    heading: str = "",
    resampled: tuple[Resampled, ...] = RESAMPLED,
    in_scores: bool = False,
    in_measures: bool = False,
    on_leaderboard: bool = False,
    by_participant: Compute | None = None,
) -> Callable[[Compute], Compute]:
    """Register the decorated function of a `Sample` as a metric; see `Metric` for the parameters.

    Tables list the metrics in the order in which they are registered.
    """

    def add(compute: Compute) -> Compute:
        metric = Metric(
            name=name,
            compute=compute,
            label=label,
            heading=heading or label,
            definition=definition,
            better=better,
            needs=needs,
            resampled=resampled,
            in_scores=in_scores,
            in_measures=in_measures,
            on_leaderboard=on_leaderboard,
            by_participant=by_participant,
            position=next(_count),
        )
        metrics.register(name)(metric)
        return compute

    return add


def all_metrics() -> list[Metric]:
    """Return every metric in the order of registration."""
    return sorted((metrics.get(name) for name in metrics.names()), key=lambda one: one.position)


def score_metrics() -> list[Metric]:
    """Return the metrics in the table of scores by stimulus."""
    return [metric for metric in all_metrics() if metric.in_scores]


def measure_metrics() -> list[Metric]:
    """Return the metrics in the table of measures with single participants."""
    return [metric for metric in all_metrics() if metric.in_measures]


def leaderboard_metrics() -> list[Metric]:
    """Return the metrics on the leaderboard."""
    return [metric for metric in all_metrics() if metric.on_leaderboard]


@register_metric(
    "accuracy",
    label="accuracy",
    definition="fraction of the model's answers that equal the official outcome",
    better="higher",
    needs="outcome",
    resampled=("stimuli", "both"),
    in_scores=True,
    in_measures=True,
    on_leaderboard=True,
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
    needs="people",
    in_scores=True,
)
def human_accuracy(sample: Sample) -> Array:
    """Return the mean over stimuli of the fraction of people who are right."""
    return sample.sums.human / sample.sums.n_people


@register_metric(
    "difference",
    label="accuracy less people's",
    heading="difference",
    definition="accuracy less that of people on the same stimuli",
    better="higher",
    needs="people",
    in_scores=True,
    in_measures=True,
    on_leaderboard=True,
)
def difference(sample: Sample) -> Array:
    """Return the accuracy of the model minus that of people on the same stimuli."""
    return (sample.sums.correct_people - sample.sums.human) / sample.sums.n_people


@register_metric(
    "r",
    label="r",
    heading="Pearson r",
    definition="correlation over stimuli of P(contact) with the fraction of people who say yes, "
    "that is, with the average person",
    better="higher",
    needs="people",
    in_scores=True,
    in_measures=True,
    on_leaderboard=True,
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
    "since people and model saw different events there",
    better="higher",
    needs="people",
    in_scores=True,
)
def r_same_outcome(sample: Sample) -> Array:
    """Return Pearson's r over the stimuli whose shown outcome is the official one."""
    return _correlation(sample.sums_same_outcome)


@register_metric(
    "rmsd",
    label="RMSD",
    definition="square root of the mean squared difference between P(contact) and the fraction of "
    "people who say yes",
    better="lower",
    needs="people",
    in_scores=True,
    in_measures=True,
    on_leaderboard=True,
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
    needs="people",
    in_measures=True,
)
def euclid_over_n(sample: Sample) -> Array:
    """Return the RMSD divided by the root of the number of stimuli, as the released notebooks
    do.
    """
    return rmsd(sample) / np.sqrt(sample.sums.n_people)


def _kappa_by_participant(sample: Sample) -> Array:
    return cross_kappa(sample.single_answers.yes, sample.predicted)


def _errors_by_participant(sample: Sample) -> Array:
    return cross_kappa(sample.single_answers.correct, correctness(sample.predicted, sample.label))


@register_metric(
    "kappa",
    label="kappa",
    definition="Cohen's kappa with each participant, mean over participants",
    better="higher",
    needs="participants",
    in_measures=True,
    on_leaderboard=True,
    by_participant=_kappa_by_participant,
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
    """Return the mean kappa with participants minus the mean kappa among participants."""
    return sample.mean_kappa - sample.kappa_among_people


@register_metric(
    "error_consistency",
    label="error consistency",
    definition="kappa of right and wrong answers with each participant, mean over participants "
    "(Geirhos and others, 2020)",
    better="higher",
    needs="participants",
    in_measures=True,
    by_participant=_errors_by_participant,
)
def error_consistency(sample: Sample) -> Array:
    """Return the kappa of correctness with each participant, mean over participants."""
    return sample.mean_error_consistency


def _correlation(sums: Sums) -> Array:
    return correlation_from_sums(sums.n_people, sums.x, sums.y, sums.xx, sums.yy, sums.xy)
