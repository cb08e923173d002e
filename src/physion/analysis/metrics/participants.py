"""Metrics of a model with single participants: they need the answers of each of them."""

from __future__ import annotations

from physion.analysis.metrics.registry import register_metric
from physion.analysis.sample import Array, Sample
from physion.analysis.statistics.kappa import correctness, cross_kappa


def _kappa_by_participant(sample: Sample) -> Array:
    return cross_kappa(sample.single_answers.yes, sample.predicted)


def _errors_by_participant(sample: Sample) -> Array:
    return cross_kappa(sample.single_answers.correct, correctness(sample.predicted, sample.label))


def _kappa_of_two_people(sample: Sample) -> Array:
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
    two_people=_kappa_of_two_people,
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
    scale="correlation",
    needs="participants",
    in_measures=True,
    by_participant=_errors_by_participant,
)
def error_consistency(sample: Sample) -> Array:
    """Return the kappa of correctness with each participant, mean over participants."""
    return sample.mean_error_consistency
