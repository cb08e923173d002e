"""Reader of noisy simulations: the level of noise under which outcomes are likeliest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import log
from physion.readout.logistic import ReadoutConfig
from physion.readout.readers.reader import Reading
from physion.readout.rollouts import Knobs, Outcomes


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
