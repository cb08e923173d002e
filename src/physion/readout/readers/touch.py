"""Reader of rollouts by the distance at which the model itself says that objects touch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from physion.readout.logistic import ReadoutConfig
from physion.readout.readers.reader import Reading, fraction_of_futures
from physion.readout.rollouts import Knobs, Outcomes


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
