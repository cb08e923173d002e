"""Answers of models and people to the same stimuli, with weights: what metrics compute from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.people.measures import ScenarioAnswers, mean_over_people
from physion.analysis.statistics.agreement import (
    correctness,
    cross_kappa,
    pair_difference,
    resampled_kappa,
    resampled_mean_kappa,
)

Array = npt.NDArray[np.float64]

Resampled = Literal["people", "stimuli", "both"]
RESAMPLED: tuple[Resampled, ...] = ("people", "stimuli", "both")
"""What an interval takes as drawn at random: it is about others of the same number."""


class Sums(NamedTuple):
    """Weighted sums over stimuli, each of shape (b, m): b sets of weights, m models.

    - ``n``, ``correct``, ``correct_shown``: stimuli that the model predicts, how many of them where
      its answer equals the official outcome, and the outcome of the trial that it was shown;
    - ``n_people``, ``correct_people``: the first two for the stimuli that people answered as well;
      the sums below are over these stimuli;
    - ``human``: fraction of people who are right;
    - ``yes``, ``both_yes``: the model's answers yes, and P(yes) where it answers yes;
    - ``differ``: probability that two people answer differently;
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
    yes: Array
    both_yes: Array
    differ: Array
    square: Array
    x: Array
    y: Array
    xx: Array
    yy: Array
    xy: Array


@dataclass(frozen=True)
class Sample:
    """Answers of m models and of people to s stimuli, with b sets of weights.

    - ``p_contact``, ``predicted`` (m, s): P(contact) in 0..1, and the predicted outcome 1 or 0;
      NaN where a model does not predict the stimulus;
    - ``label``, ``shown`` (s,): the official outcome, and the outcome of the trial the model was
      shown;
    - ``p_yes``, ``human_accuracy`` (b, s) or (1, s): fraction of people who say yes, and who are
      right; NaN where nobody answered;
    - ``differ`` (b, s) or (1, s): fraction of pairs of different people who answer differently; NaN
      where fewer than two answered;
    - ``stimuli`` (b, s): weight of each stimulus: 0 where it is left out;
    - ``answers``, ``people`` (b, n): answers of single participants, and the weight of each of
      them; None if only averages are known;
    - ``drawn``: whose weights differ from 1; None for the sample itself (b = 1).
    """

    p_contact: Array
    predicted: Array
    label: Array
    shown: Array
    p_yes: Array
    human_accuracy: Array
    differ: Array
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

    @cached_property
    def of_people(self) -> Sample:
        """The same people with a single model that answers with the official outcome.

        Its sums about people are over all stimuli that people answered, whatever the models
        predict.
        """
        parts = tuple(part.of_people for part in self._parts)
        return replace(self, p_contact=self.label[None], predicted=self.label[None], _parts=parts)

    @cached_property
    def sums_by_outcome(self) -> tuple[Sums, Sums]:
        """Sums over the stimuli with contact, and over those without."""
        if self._parts:
            by_part = [part.sums_by_outcome for part in self._parts]
            return _total([one for one, _ in by_part]), _total([other for _, other in by_part])
        return self._sums((self.label == 1).astype(np.float64)), self._sums(
            (self.label == 0).astype(np.float64)
        )

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
        said_yes = np.nan_to_num(self.predicted) * mask
        weighted = w * b
        xx, yy, xy = w @ (a * a).T, (weighted * b) @ has.T, weighted @ a.T
        square = xx - 2 * xy + yy
        if len(self.p_yes) == 1:
            # The same people for all weights: sum the squares themselves, which is more exact.
            gap = np.where(known & answered, self.p_contact - self.p_yes, 0.0) * mask
            square = w @ (gap * gap).T
        return Sums(
            n=self.stimuli @ has.T,
            correct=self.stimuli @ right.T,
            correct_shown=self.stimuli @ right_shown.T,
            n_people=w @ has.T,
            correct_people=w @ right.T,
            human=(w * human) @ has.T,
            yes=w @ said_yes.T,
            both_yes=(w * np.where(answered, self.p_yes, 0.0)) @ said_yes.T,
            differ=np.where(w > 0, w * self.differ, 0.0) @ has.T,
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
        return self._mean_kappa(self.single_answers.yes, self.predicted)

    @cached_property
    def mean_error_consistency(self) -> Array:
        """Kappa of right and wrong answers with each participant, mean over them, (b, m)."""
        right = correctness(self.predicted, self.label)
        return self._mean_kappa(self.single_answers.correct, right)

    @cached_property
    def kappa_among_people(self) -> Array:
        """Mean kappa of all pairs of participants, (b, 1)."""
        stimuli = self.stimuli if self.drawn in ("stimuli", "both") else None
        return resampled_mean_kappa(self.single_answers.yes, stimuli, self._people)[:, None]

    def _mean_kappa(self, of_people: Array, of_models: Array) -> Array:
        if self.drawn not in ("stimuli", "both"):
            return mean_over_people(cross_kappa(of_people, of_models), self._people)
        # Rows that draw the same stimuli share the kappas of single people.
        draws, row = np.unique(self.stimuli, axis=0, return_inverse=True)
        means = []
        for model in of_models:
            kappa = resampled_kappa(of_people, model, draws)[row]
            known = np.isfinite(kappa)
            total = np.sum(np.where(known, kappa, 0.0) * self._people, axis=1)
            means.append(total / np.sum(known * self._people, axis=1))
        return np.stack(means, axis=1)

    @property
    def single_answers(self) -> ScenarioAnswers:
        """Answers of single participants, for metrics that need them."""
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

    names = ("p_contact", "predicted", "label", "shown", "p_yes", "human_accuracy", "differ",
             "stimuli")  # fmt: skip
    return Sample(**{name: joined(name) for name in names}, _parts=tuple(samples))  # type: ignore[arg-type]


def sample_of_rows(rows: pd.DataFrame, stimuli: Array) -> Sample:
    """Return the sample of one model whose stimuli are rows of a table.

    Parameters
    ----------
    rows
        One row per stimulus with ``p_contact``, ``predicted``, ``label``, ``simulated``, and, NaN
        without people, ``p_yes``, ``human_accuracy`` and ``count``.
    stimuli
        (b, s): weight of each stimulus.
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
        differ=pair_difference(column("p_yes"), column("count"))[None],
        stimuli=stimuli,
    )
