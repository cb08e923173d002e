"""What a reader offers, and the registry of readers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.core.registry import Registry
from physion.models.noisy_simulation import best_threshold
from physion.numerics.elementary import log
from physion.readout.features import Knobs, Outcomes
from physion.readout.logistic import ReadoutConfig, fit_readout

Booleans = NDArray[np.bool_]


@dataclass(frozen=True)
class Reading:
    """Probabilities of tested trials, and what was fitted to get them.

    - ``probability`` (m,): P(contact), 0..1. ``train_accuracy``: on the fit trials.
    - ``c``, ``cv_accuracy``: inverse penalty of a regression, and its accuracy over folds; NaN
      where they do not apply.
    - ``fitted``: values of other fitted quantities by name. ``note``: what was unusual.
    """

    probability: NDArray[np.float64]
    train_accuracy: float
    c: float = float("nan")
    cv_accuracy: float = float("nan")
    fitted: Mapping[str, float] = field(default_factory=dict)
    note: str = ""


def fraction_of_futures(touches: Booleans) -> NDArray[np.float64]:
    """Return P(contact) (m,) from contacts (m, S) in S futures.

    With k contacts it is (k + 1/2) / (S + 1), so that it is never 0 or 1; for one future it is k.
    """
    samples = touches.shape[1]
    count: NDArray[np.float64] = touches.sum(axis=1).astype(np.float64)
    return count if samples == 1 else (count + 0.5) / (samples + 1)


class FeatureReader(Protocol):
    """Reader of features.

    ``labels``: outcomes that it is fitted on: ``simulated``, of the trials as they were made, or
    ``recorded``, which prefers those of the official recording.
    """

    input: Literal["features"]
    labels: Literal["simulated", "recorded"]

    def read(self, fit: Sequence[Any], labels: Booleans, test: Sequence[Any]) -> Reading:
        """Fit on the parts of the features of n trials and read those of m other ones.

        Every part is an array (n, T, D) or stored features; parts are joined in time.
        """
        ...


class RolloutReader(Protocol):
    """Reader of imagined gaps or contacts, for one or several values of the knobs."""

    input: Literal["rollouts"]
    labels: Literal["simulated", "recorded"]

    def read(
        self, fit: Mapping[Knobs, Outcomes], labels: Booleans, test: Mapping[Knobs, Outcomes]
    ) -> Reading:
        """Fit on the outcomes of n trials at all knobs, and read those of m other trials."""
        ...


ReaderFactory = Callable[[ReadoutConfig], FeatureReader | RolloutReader]

readers: Registry[ReaderFactory] = Registry(
    "reader",
    {
        "logistic": "physion.readout.decisions:LogisticReader",
        "released": "physion.readout.decisions:released_reader",
        "gap": "physion.readout.decisions:GapReader",
        "touch": "physion.readout.decisions:TouchReader",
        "noise": "physion.readout.decisions:NoiseReader",
    },
)
"""All readers by name; other packages add theirs with the entry point group physion.readers."""


# Reader of rollouts by a threshold on the smallest distance of agent and patient.


@dataclass(frozen=True)
class GapReader:
    """Threshold on the gap, in metres, that is right for most of the fit trials.

    P(contact) is that of `fraction_of_futures`, where a gap of at most the threshold is a contact.
    Thresholds that are right equally often leave the one that is
    closest to 0; without fit trials it is 0.
    """

    config: ReadoutConfig = field(default_factory=ReadoutConfig)
    input: Literal["rollouts"] = "rollouts"
    labels: Literal["simulated", "recorded"] = "simulated"

    def read(
        self,
        fit: Mapping[Knobs, Outcomes],
        labels: NDArray[np.bool_],
        test: Mapping[Knobs, Outcomes],
    ) -> Reading:
        """Fit the threshold on the gaps (n, S) of the fit trials and read the others."""
        (knobs,) = fit
        near, tested = fit[knobs].gap, test[knobs].gap
        if near is None or tested is None:
            raise BadInputError(
                "the reader 'gap' needs distances, but the model gives contacts alone; "
                "use the reader 'noise'"
            )
        threshold = best_threshold(np.median(near, axis=1), labels)
        predicted = fraction_of_futures(near <= threshold) > 0.5
        accuracy = float(np.mean(predicted == labels)) if len(labels) else float("nan")
        return Reading(
            fraction_of_futures(tested <= threshold),
            accuracy,
            fitted={**dict(knobs), "gap": threshold},
        )


# Reader of rollouts by the distance at which the model itself says that objects touch.


@dataclass(frozen=True)
class TouchReader:
    """Fraction of futures with a contact, or a gap of at most 0 (`fraction_of_futures`).

    Nothing is fitted.
    """

    config: ReadoutConfig = field(default_factory=ReadoutConfig)
    input: Literal["rollouts"] = "rollouts"
    labels: Literal["simulated", "recorded"] = "simulated"

    def read(
        self,
        fit: Mapping[Knobs, Outcomes],
        labels: NDArray[np.bool_],
        test: Mapping[Knobs, Outcomes],
    ) -> Reading:
        """Read the futures of the tested trials; the fit trials give the accuracy alone."""
        (knobs,) = test
        known = fraction_of_futures(fit[knobs].touches()) > 0.5
        accuracy = float(np.mean(known == labels)) if len(labels) else float("nan")
        probability = fraction_of_futures(test[knobs].touches())
        return Reading(probability, accuracy, fitted=dict(knobs))


# Reader of noisy simulations: the level of noise under which outcomes are likeliest.


@dataclass(frozen=True)
class NoiseReader:
    """Fraction of simulations with a contact, at the knobs with the highest likelihood.

    It is fitted on recorded outcomes where there are any: compared with the outcomes of its own
    engine, a simulation would always fit best without noise.
    """

    config: ReadoutConfig = field(default_factory=ReadoutConfig)
    input: Literal["rollouts"] = "rollouts"
    labels: Literal["simulated", "recorded"] = "recorded"

    def read(
        self,
        fit: Mapping[Knobs, Outcomes],
        labels: NDArray[np.bool_],
        test: Mapping[Knobs, Outcomes],
    ) -> Reading:
        """Choose the knobs on the fit trials and return the fractions of the others."""
        fractions = {knobs: outcomes.fractions() for knobs, outcomes in fit.items()}
        samples = {knobs: outcomes.samples for knobs, outcomes in test.items()}
        chosen = fit_knobs(fractions, samples, labels)
        accuracy = np.mean((fractions[chosen] > 0.5) == labels) if len(labels) else float("nan")
        return Reading(test[chosen].fractions(), float(accuracy), fitted=dict(chosen))


def log_likelihood(fractions: NDArray[Any], samples: int, outcomes: NDArray[Any]) -> float:
    """Return the mean log-likelihood of ``outcomes`` (n,); NaN for n = 0.

    The probability of a contact is (k + 0.5) / (samples + 1), where k = fraction * samples is the
    number of simulations with a contact, so that it is never 0 or 1.
    """
    if len(fractions) == 0:
        return float("nan")
    p = (np.asarray(fractions, float) * samples + 0.5) / (samples + 1)
    # The exact sum: numpy's depends on the processor, and the fit compares sums.
    return math.fsum(log(np.where(np.asarray(outcomes, bool), p, 1.0 - p))) / len(p)


def fit_knobs(
    fractions: Mapping[Knobs, NDArray[Any]],
    samples: Mapping[Knobs, int],
    outcomes: NDArray[np.bool_],
) -> Knobs:
    """Return the knobs with the highest likelihood of ``outcomes``; among equals the smallest.

    Parameters
    ----------
    fractions
        For each value of the knobs the fractions (n,) of simulations with a contact.
    samples
        Simulations per trial, for each value.
    outcomes
        Contact or not (n,), of fit trials alone. Without any, the middle value is returned.
    """
    values = sorted(fractions)
    if len(outcomes) == 0:
        return values[len(values) // 2]
    # `max` keeps the first, which is the smallest, of equal ones.
    return max(values, key=lambda k: log_likelihood(fractions[k], samples[k], outcomes))


# Reader of features: L2 logistic regression, exact or as released.


@dataclass(frozen=True)
class LogisticReader:
    """Logistic regression on standardised features of all frames (`physion.readout.logistic`)."""

    config: ReadoutConfig = field(default_factory=ReadoutConfig)
    input: Literal["features"] = "features"
    labels: Literal["simulated", "recorded"] = "simulated"

    def read(self, fit: Sequence[Any], labels: NDArray[np.bool_], test: Sequence[Any]) -> Reading:
        """Fit on the parts ``fit`` and return the probabilities of the parts ``test``."""
        fitted = fit_readout(fit, labels, test, self.config)
        return Reading(
            fitted.probability,
            fitted.train_accuracy,
            c=fitted.c,
            cv_accuracy=fitted.cv_accuracy,
            note=fitted.note,
        )


def released_reader(config: ReadoutConfig) -> LogisticReader:
    """Return the readout as it was released: lbfgs stopped at 200 iterations, labels balanced."""
    return LogisticReader(replace(config, released=True, balance=True))
