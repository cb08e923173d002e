"""Reader of rollouts by a threshold on the smallest distance of agent and patient."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.models.threshold import best_threshold
from physion.readout.logistic import ReadoutConfig
from physion.readout.readers.reader import Reading, fraction_of_futures
from physion.readout.rollouts import Knobs, Outcomes


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
