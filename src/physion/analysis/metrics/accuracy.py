"""Metrics of correct answers: accuracy of models, of people, and their difference."""

from __future__ import annotations

from physion.analysis.metrics.registry import register_metric
from physion.analysis.sample import Array, Sample


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
    definition="accuracy less that of people on the same stimuli",
    better="higher",
    needs="people",
    in_scores=True,
    in_measures=True,
)
def difference(sample: Sample) -> Array:
    """Return the accuracy of the model minus that of people on the same stimuli."""
    return (sample.sums.correct_people - sample.sums.human) / sample.sums.n_people
