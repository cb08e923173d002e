"""Decisions: what turns features or rollouts of a model into P(contact).

The readout says which features of a clip a decision receives:

| readout | official | features |
|---|---|---|
| *observed* | C | encoder, observed frames |
| *observed+simulated* | B | encoder, observed frames; dynamics, the rest |
| *full* | A | encoder, all frames |

*full* is detection, not prediction: the frames show the outcome. It measures how much of the
outcome the features of the encoder contain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.registry import Registry
from physion.models.noisy_simulation import best_threshold
from physion.numerics.elementary import log
from physion.readout.features import Arguments, Outcomes
from physion.readout.logistic import LogisticSettings, fit_readout

Booleans = NDArray[np.bool_]


class Readout(Enum):
    """Readout; the value is its name in the paper."""

    OBSERVED = "observed"
    OBSERVED_SIMULATED = "observed+simulated"
    FULL = "full"

    @property
    def sees_future(self) -> bool:
        """Whether the readout receives frames after the observed part."""
        return self is Readout.FULL

    @classmethod
    def named(cls, name: str) -> Readout:
        """Return the readout called ``name``; raise `UnknownNameError` with the closest names."""
        try:
            return cls(name)
        except ValueError:
            raise UnknownNameError("readout", name, [r.value for r in cls]) from None


@dataclass(frozen=True)
class Decided:
    """Probabilities of tested trials, and what was fitted to get them.

    - ``probability`` (m,): P(contact), 0..1. ``train_accuracy``: on the fit trials.
    - ``c``, ``cv_accuracy``: inverse penalty of a regression, and its accuracy over folds; NaN
      where they do not apply.
    - ``fitted``: values of other fitted quantities by name. ``note``: what was unusual;
      ``notes``: of the model on some trials, by name.
    """

    probability: NDArray[np.float64]
    train_accuracy: float
    c: float = float("nan")
    cv_accuracy: float = float("nan")
    fitted: Mapping[str, float] = field(default_factory=dict)
    note: str = ""
    notes: Mapping[str, str] = field(default_factory=dict)


def fraction_of_futures(touches: Booleans) -> NDArray[np.float64]:
    """Return P(contact) (m,) from contacts (m, S) in S futures.

    With k contacts it is (k + 1/2) / (S + 1), so that it is never 0 or 1; for one future it is k.
    """
    return touches[:, 0].astype(np.float64) if touches.shape[1] == 1 else _never_certain(touches)


def _never_certain(touches: Booleans) -> NDArray[np.float64]:
    """Return (k + 1/2) / (S + 1) (m,) for k contacts in S futures, also for one."""
    probability: NDArray[np.float64] = (touches.sum(axis=1) + 0.5) / (touches.shape[1] + 1)
    return probability


@dataclass(frozen=True)
class Decision:
    """Base class of decisions; a class that is not derived from it works as well.

    - ``settings``: of the logistic regression.
    - ``input``: what it receives. ``features``: a list of parts of the features of trials, each an
      array (n, T, D) or `StoredFeatures`, which are joined in time. ``rollouts``: a mapping from
      sets of arguments to `Outcomes`.
    - ``labels``: outcomes that it is fitted on: ``simulated``, of the trials as they were made, or
      ``recorded``, which prefers the outcomes of the official recording.
    - ``fits``: whether it is fitted; one that is not receives no fit trials.
    - ``tokens``: in the features of a time step, as the model says (`Model.tokens`).
    """

    settings: LogisticSettings = field(default_factory=LogisticSettings)
    tokens: int = 1
    fits: ClassVar[bool] = True
    input: ClassVar[str] = "rollouts"
    labels: ClassVar[str] = "simulated"

    def decide(self, fit: Any, labels: Booleans, test: Any) -> Decided:
        """Fit on n trials with their labels (n,), and decide on m others."""
        raise NotImplementedError


decisions: Registry[Callable[[LogisticSettings], Decision]] = Registry(
    "decision",
    {
        "logistic": "physion.readout.decisions:LogisticDecision",
        "released": "physion.readout.decisions:released_decision",
        "trees": "physion.readout.trees:TreesDecision",
        "attentive": "physion.readout.attentive:AttentiveDecision",
        "end": "physion.readout.decisions:EndDecision",
        "closest": "physion.readout.decisions:ClosestDecision",
        "gap": "physion.readout.decisions:GapDecision",
        "touch": "physion.readout.decisions:TouchDecision",
        "noise": "physion.readout.decisions:NoiseDecision",
    },
)
"""All decisions by name; other packages add theirs with the entry point group physion.decisions."""


# Decisions on rollouts: a fixed distance of agent and patient at the end or at any time, a fitted
# threshold on the smallest distance, the distance at which the model itself says that objects
# touch, and the likeliest level of noise.


Futures = Mapping[Arguments, Outcomes]


def _accuracy(probability: NDArray[np.float64], labels: Booleans) -> float:
    return float(np.mean((probability > 0.5) == labels)) if len(labels) else math.nan


class EndDecision(Decision):
    """Contact at the end of the predicted dynamics, by a fixed distance; nothing is fitted.

    P(contact) is `fraction_of_futures` with an ``end`` of at most 0, as in the paper for particle
    models.
    """

    fits: ClassVar[bool] = False

    def decide(self, fit: Futures, labels: Booleans, test: Futures) -> Decided:
        """Decide on the futures of the tested trials."""
        arguments = _only(test, "end")
        touches = _within_fixed(test[arguments].end, "end")
        return Decided(fraction_of_futures(touches), math.nan, fitted=dict(arguments))


class ClosestDecision(Decision):
    """Contact at any time, by the fixed distance of `EndDecision`; nothing is fitted.

    This is the rule of the released code of the particle models, but for its other distances in
    three of the scenarios. A contact in the observed part counts.
    """

    fits: ClassVar[bool] = False

    def decide(self, fit: Futures, labels: Booleans, test: Futures) -> Decided:
        """Decide on the futures of the tested trials."""
        arguments = _only(test, "closest")
        touches = _within_fixed(test[arguments].closest, "closest")
        return Decided(fraction_of_futures(touches), math.nan, fitted=dict(arguments))


def _only(futures: Futures, name: str) -> Arguments:
    """Return the one set of arguments of the futures."""
    if len(futures) > 1:
        offered = "; ".join(" ".join(f"{k}={v:g}" for k, v in each) for each in futures)
        raise BadInputError(
            f"the decision {name!r} needs one value of each argument, but the model offers "
            f"{offered}: give the model one, or use the decision 'noise', which chooses"
        )
    return next(iter(futures))


def _within_fixed(distance: NDArray[np.float64] | None, name: str) -> Booleans:
    if distance is None:
        raise BadInputError(
            f"the decision {name!r} needs distances less a fixed one, which particle models give; "
            "use the decision 'gap' or 'noise'"
        )
    return distance <= 0


class GapDecision(Decision):
    """Threshold on the gap, in metres, that is right for most of the fit trials.

    P(contact) is `fraction_of_futures` with a gap of at most the threshold. Among thresholds that
    are right equally often it is the closest to 0; without fit trials it is 0.
    """

    def decide(self, fit: Futures, labels: Booleans, test: Futures) -> Decided:
        """Fit the threshold on the gaps (n, S) of the fit trials and apply it to the others."""
        arguments = _only(fit, "gap")
        near, tested = fit[arguments].gap, test[arguments].gap
        if near is None or tested is None:
            raise BadInputError(
                "the decision 'gap' needs distances, but the model gives contacts only; "
                "use the decision 'noise'"
            )
        threshold = best_threshold(np.median(near, axis=1), labels)
        accuracy = _accuracy(fraction_of_futures(near <= threshold), labels)
        probability = fraction_of_futures(tested <= threshold)
        return Decided(probability, accuracy, fitted={**dict(arguments), "gap": threshold})


class TouchDecision(Decision):
    """Fraction of futures with a contact, or a gap of at most 0; nothing is fitted here.

    The gaps of particle models count from a distance that may be calibrated on the contacts of
    training trials, and is stored with the weights.
    """

    fits: ClassVar[bool] = False

    def decide(self, fit: Futures, labels: Booleans, test: Futures) -> Decided:
        """Decide on the futures of the tested trials."""
        arguments = _only(test, "touch")
        probability = fraction_of_futures(test[arguments].touches())
        return Decided(probability, math.nan, fitted=dict(arguments))


class NoiseDecision(Decision):
    """`fraction_of_futures` with a contact, at the arguments with the highest likelihood.

    It is fitted on recorded outcomes where there are any: compared with the outcomes of its own
    engine, a simulation would always fit best without noise.
    """

    labels: ClassVar[str] = "recorded"

    def decide(self, fit: Futures, labels: Booleans, test: Futures) -> Decided:
        """Choose the arguments on the fit trials and decide on the others."""
        touches = {arguments: outcomes.touches() for arguments, outcomes in fit.items()}
        chosen = fit_arguments(touches, labels)
        accuracy = _accuracy(fraction_of_futures(touches[chosen]), labels)
        probability = fraction_of_futures(test[chosen].touches())
        return Decided(probability, accuracy, fitted=dict(chosen))


def log_likelihood(touches: Booleans, outcomes: NDArray[Any]) -> float:
    """Return the mean log-likelihood of ``outcomes`` (n,) given (n, S) contacts; NaN for n = 0."""
    if len(touches) == 0:
        return float("nan")
    p = _never_certain(touches)
    # The exact sum: numpy's depends on the processor, and the fit compares sums.
    return math.fsum(log(np.where(np.asarray(outcomes, bool), p, 1.0 - p))) / len(p)


def fit_arguments(touches: Mapping[Arguments, Booleans], outcomes: NDArray[np.bool_]) -> Arguments:
    """Return the arguments with the highest likelihood of ``outcomes``; among equals the smallest.

    Parameters
    ----------
    touches
        For each set of arguments whether there is a contact in (n, S) simulations.
    outcomes
        Contact or not (n,), of fit trials only. Without any, the middle value is returned.
    """
    values = sorted(touches)
    if len(outcomes) == 0:
        return values[len(values) // 2]
    # `max` keeps the first, which is the smallest, of equal ones.
    return max(values, key=lambda k: log_likelihood(touches[k], outcomes))


# Decision on features: L2 logistic regression, exact or as released.


class LogisticDecision(Decision):
    """Logistic regression on standardised features of all frames (`physion.readout.logistic`)."""

    input: ClassVar[str] = "features"

    def decide(self, fit: Sequence[Any], labels: Booleans, test: Sequence[Any]) -> Decided:
        """Fit on the parts ``fit`` and return the probabilities of the parts ``test``."""
        fitted = fit_readout(fit, labels, test, self.settings)
        return Decided(
            fitted.probability,
            fitted.train_accuracy,
            c=fitted.c,
            cv_accuracy=fitted.cv_accuracy,
            note=fitted.note,
        )


def released_decision(settings: LogisticSettings) -> LogisticDecision:
    """Return the readout as it was released: lbfgs stopped at 200 iterations, labels balanced."""
    return LogisticDecision(replace(settings, released=True, balance=True))
