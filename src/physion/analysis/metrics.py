"""Registry of the metrics: the one definition of every number that compares a model with people.

A metric is one entry: a function of a `Sample`, decorated with `register_metric`. The tables of
scores (`tables.score_tables`), of measures (`models.model_people`), the leaderboard and the report
ask this registry, so that a new metric appears in all of them. ``docs/how-to/add-a-metric.md``
shows how to add one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.people.answers import ScenarioAnswers, mean_over_people
from physion.analysis.statistics.correlation import correlation_from_sums
from physion.analysis.statistics.kappa import (
    correctness,
    cross_kappa,
    resampled_kappa,
    resampled_mean_kappa,
)
from physion.registry import Registry

Array = npt.NDArray[np.float64]

Resampled = Literal["people", "stimuli", "both"]
RESAMPLED: tuple[Resampled, ...] = ("people", "stimuli", "both")
"""What is drawn with replacement for an interval."""


class Sums(NamedTuple):
    """Weighted sums over stimuli, each of shape (b, m): b resamples, m models.

    - ``n``, ``correct``, ``correct_shown``: stimuli that the model predicts, those of them where
      its answer equals the official outcome, and the outcome of the trial that it was shown;
    - ``n_people``, ``correct_people``: the first two for the stimuli that people answered as well;
      the sums below are over these stimuli;
    - ``human``: fraction of people who are right;
    - ``square``: squared difference of P(contact) and P(yes);
    - ``x``, ``y``, ``xx``, ``yy``, ``xy``: of x = P(contact) - 0.5, y = P(yes) - 0.5 and their
      products. Centring at 0.5 keeps rounding errors small.
    """

    n: Array
    correct: Array
    correct_shown: Array
    n_people: Array
    correct_people: Array
    human: Array
    square: Array
    x: Array
    y: Array
    xx: Array
    yy: Array
    xy: Array


@dataclass(frozen=True)
class Sample:
    """Answers of m models and of people to s stimuli, with the weights of b resamples.

    - ``p_contact``, ``predicted`` (m, s): P(contact) in 0..1, and the predicted outcome 1 or 0;
      NaN where a model does not predict the stimulus;
    - ``label``, ``shown`` (s,): the official outcome, and that of the trial the model was shown;
    - ``p_yes``, ``human_accuracy`` (b, s) or (1, s): fraction of people who say yes, and who are
      right; NaN where nobody answered;
    - ``stimuli`` (b, s): how often each stimulus is drawn;
    - ``answers``, ``people`` (b, n): answers of single participants, and how often each of them is
      drawn; None if only averages are known;
    - ``drawn``: what is drawn with replacement; None for the sample itself (b = 1).
    """

    p_contact: Array
    predicted: Array
    label: Array
    shown: Array
    p_yes: Array
    human_accuracy: Array
    stimuli: Array
    answers: ScenarioAnswers | None = None
    people: Array | None = None
    drawn: Resampled | None = None
    _parts: tuple[Sample, ...] = field(default=(), repr=False)

    @cached_property
    def sums(self) -> Sums:
        """Sums over all stimuli."""
        if self._parts:
            return _total([part.sums for part in self._parts])
        return self._sums(np.ones(len(self.label)))

    @cached_property
    def sums_same_outcome(self) -> Sums:
        """Sums over the stimuli for which the model was shown the official outcome."""
        if self._parts:
            return _total([part.sums_same_outcome for part in self._parts])
        return self._sums((self.label == self.shown).astype(np.float64))

    def _sums(self, mask: Array) -> Sums:
        known = ~np.isnan(self.p_contact)
        has = known * mask
        a = np.where(known, self.p_contact - 0.5, 0.0) * mask
        right = np.nan_to_num(correctness(self.predicted, self.label)) * mask
        right_shown = np.nan_to_num(correctness(self.predicted, self.shown)) * mask
        answered = np.isfinite(self.p_yes)
        w = np.where(answered, self.stimuli, 0.0)
        b = np.where(answered, self.p_yes - 0.5, 0.0)
        human = np.where(answered, self.human_accuracy, 0.0)
        weighted = w * b
        xx, yy, xy = w @ (a * a).T, (weighted * b) @ has.T, weighted @ a.T
        square = xx - 2 * xy + yy
        if len(self.p_yes) == 1:
            # The same people in every resample: sum the squares themselves, which is more exact.
            gap = np.where(known & answered, self.p_contact - self.p_yes, 0.0) * mask
            square = w @ (gap * gap).T
        return Sums(
            n=self.stimuli @ has.T,
            correct=self.stimuli @ right.T,
            correct_shown=self.stimuli @ right_shown.T,
            n_people=w @ has.T,
            correct_people=w @ right.T,
            human=(w * human) @ has.T,
            square=np.maximum(square, 0.0),
            x=w @ a.T,
            y=weighted @ has.T,
            xx=xx,
            yy=yy,
            xy=xy,
        )

    @cached_property
    def mean_kappa(self) -> Array:
        """Cohen's kappa of each model with each participant, mean over participants, (b, m)."""
        return self._mean_kappa(self._answers.yes, self.predicted)

    @cached_property
    def mean_error_consistency(self) -> Array:
        """Kappa of right and wrong answers with each participant, mean over them, (b, m)."""
        right = correctness(self.predicted, self.label)
        return self._mean_kappa(self._answers.correct, right)

    @cached_property
    def kappa_among_people(self) -> Array:
        """Mean kappa of all pairs of participants, (b, 1)."""
        stimuli = self.stimuli if self.drawn in ("stimuli", "both") else None
        return resampled_mean_kappa(self._answers.yes, stimuli, self._people)[:, None]

    def _mean_kappa(self, of_people: Array, of_models: Array) -> Array:
        if self.drawn not in ("stimuli", "both"):
            return mean_over_people(cross_kappa(of_people, of_models), self._people)
        means = []
        for model in of_models:
            kappa = resampled_kappa(of_people, model, self.stimuli)
            known = np.isfinite(kappa)
            total = np.sum(np.where(known, kappa, 0.0) * self._people, axis=1)
            means.append(total / np.sum(known * self._people, axis=1))
        return np.stack(means, axis=1)

    @property
    def _answers(self) -> ScenarioAnswers:
        assert self.answers is not None, "this metric needs the answers of single participants"
        return self.answers

    @property
    def _people(self) -> Array:
        assert self.people is not None, "this metric needs the answers of single participants"
        return self.people


def _total(sums: Sequence[Sums]) -> Sums:
    return Sums(*(np.sum(values, axis=0) for values in zip(*sums, strict=True)))


def pool(samples: Sequence[Sample]) -> Sample:
    """Return the stimuli of several samples as one sample; no answers of single participants."""

    def joined(name: str) -> Array:
        return np.asarray(np.concatenate([getattr(one, name) for one in samples], axis=-1))

    names = ("p_contact", "predicted", "label", "shown", "p_yes", "human_accuracy", "stimuli")
    return Sample(**{name: joined(name) for name in names}, _parts=tuple(samples))  # type: ignore[arg-type]


def sample_of_rows(rows: pd.DataFrame, stimuli: Array) -> Sample:
    """Return the sample of one model whose stimuli are rows of a table.

    Parameters
    ----------
    rows
        One row a stimulus with ``p_contact``, ``predicted``, ``label``, ``simulated``, ``p_yes``
        and ``human_accuracy`` (NaN without people).
    stimuli
        (b, s): how often each stimulus is drawn.
    """

    def column(name: str) -> Array:
        return np.asarray(rows[name], dtype=np.float64)

    return Sample(
        p_contact=column("p_contact")[None],
        predicted=column("predicted")[None],
        label=column("label"),
        shown=column("simulated"),
        p_yes=column("p_yes")[None],
        human_accuracy=column("human_accuracy")[None],
        stimuli=stimuli,
    )


# --- the registry -------------------------------------------------------------------------------


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


# --- the metrics --------------------------------------------------------------------------------


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
    return cross_kappa(sample._answers.yes, sample.predicted)


def _errors_by_participant(sample: Sample) -> Array:
    return cross_kappa(sample._answers.correct, correctness(sample.predicted, sample.label))


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
