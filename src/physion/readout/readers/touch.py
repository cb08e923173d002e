"""Reader of rollouts by the distance at which the model itself says that objects touch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from physion.readout.logistic import ReadoutConfig
from physion.readout.readers.reader import Reading
from physion.readout.rollouts import Knobs, Outcomes


@dataclass(frozen=True)
class TouchReader:
    """Fraction of futures with a contact, or a gap of at most 0. Nothing is fitted.

    For n > 1 futures, k of them with a contact, it is (k + 1/2) / (n + 1); for one it is k.
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
        known = probability_of(fit[knobs]) > 0.5
        accuracy = float(np.mean(known == labels)) if len(labels) else float("nan")
        return Reading(probability_of(test[knobs]), accuracy, fitted=dict(knobs))


def probability_of(outcomes: Outcomes) -> NDArray[np.float64]:
    """Return P(contact) of every trial from its futures."""
    samples = outcomes.samples
    count: NDArray[np.float64] = outcomes.touches().sum(axis=1).astype(np.float64)
    return count if samples == 1 else (count + 0.5) / (samples + 1)
