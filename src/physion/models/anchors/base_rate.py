"""Anchor `chance`: the base rate of the fitted trials, whatever the trial."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.models.anchors.settings_digest import settings_digest
from physion.models.batch import Batch, Provenance, Spec
from physion.models.build import make_config
from physion.version import __version__

NAME, VERSION = "chance", 1


@dataclass(frozen=True, slots=True)
class BaseRateConfig:
    """`BaseRate` has no settings."""


class BaseRate:
    """Model that gives every trial of a scenario the same probability.

    P(contact) is (k + 1) / (n + 2) with k contacts among the n fitted trials (Laplace's rule of
    succession), so that its yes or no is the more frequent outcome.
    """

    answers = "observed"

    def __init__(self, config: BaseRateConfig) -> None:
        self.config = config
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0, anchor="end")

    def fit(self, batch: Batch, labels: NDArray[np.bool_], seed: int) -> FittedBaseRate:
        """Return the model with the base rate of the outcomes (B,); trials and seed are unused."""
        return FittedBaseRate((int(np.count_nonzero(labels)) + 1) / (len(labels) + 2))

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        versions = f"physion {__version__}"
        return Provenance(NAME, "none", versions=versions, inputs="base rate")

    def digest(self) -> str:
        """Return the SHA-256 of the code version."""
        return settings_digest(NAME, VERSION, dataclasses.asdict(self.config))


@dataclass(frozen=True, slots=True)
class FittedBaseRate:
    """`BaseRate` of some trials, in 0..1."""

    base_rate: float
    answers: str = "observed"

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return the base rate for every trial (B,)."""
        return np.full(len(batch), self.base_rate)


def base_rate(**options: Any) -> BaseRate:
    """Build a model that gives the base rate of the fitted trials, whatever the trial.

    It has no options.
    """
    return BaseRate(make_config(BaseRateConfig, NAME, options))
