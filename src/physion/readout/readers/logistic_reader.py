"""Reader of features: L2 logistic regression, exact or as released."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from physion.readout.logistic import ReadoutConfig, fit_readout
from physion.readout.readers.reader import Reading


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
