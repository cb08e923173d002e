"""What a reader offers, and the registry of readers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from physion.readout.logistic import ReadoutConfig
from physion.readout.rollouts import Knobs, Outcomes
from physion.registry import Registry

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
        "logistic": "physion.readout.readers.logistic_reader:LogisticReader",
        "released": "physion.readout.readers.logistic_reader:released_reader",
        "gap": "physion.readout.readers.gap:GapReader",
        "touch": "physion.readout.readers.touch:TouchReader",
        "noise": "physion.readout.readers.noise:NoiseReader",
    },
)
"""All readers by name; other packages add theirs with the entry point group physion.readers."""
