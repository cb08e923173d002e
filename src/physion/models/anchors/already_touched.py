"""Anchor `already-touched`: certain if the contact was seen, else the base rate."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.models.anchors.observed_motion import motions, observed_motion, touched
from physion.models.anchors.settings_digest import settings_digest
from physion.models.batch import Batch, Provenance, Spec
from physion.models.build import make_config
from physion.version import __version__

NAME, VERSION = "already-touched", 1


@dataclass(frozen=True, slots=True)
class AlreadyTouchedConfig:
    """Settings of `AlreadyTouched`.

    - ``margin``: what is left for the other outcome: probabilities lie in margin .. 1 - margin.
    """

    margin: float = 0.01

    def __post_init__(self) -> None:
        if not 0 <= self.margin < 0.5:
            raise BadInputError(
                f"{NAME}: margin must be at least 0 and below 0.5, not {self.margin}"
            )


class AlreadyTouched:
    """Model that knows one thing: whether agent and patient touched in the observed part.

    P(contact) is 1 - margin if they did, else the base rate: the fraction of contacts among the
    fitted trials that had not touched, and 0.5 without such a trial.
    """

    answers = "observed"

    def __init__(self, config: AlreadyTouchedConfig) -> None:
        self.config = config
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0, anchor="end")

    def fit(self, batch: Batch, labels: NDArray[np.bool_], seed: int) -> TouchedOrBaseRate:
        """Return the model with the base rate of some trials and outcomes (B,); no seed is used."""
        if len(labels) != len(batch):
            raise BadInputError(f"{NAME}: {len(labels)} labels for {len(batch)} trials")
        later = np.asarray(labels, np.bool_)[~_touched(batch)]
        rate = np.count_nonzero(later) / len(later) if len(later) else 0.5
        return TouchedOrBaseRate(self.config, rate)

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return Provenance(NAME, "none", versions=f"physion {__version__}")

    def digest(self) -> str:
        """Return the SHA-256 of code version and settings."""
        return settings_digest(NAME, VERSION, dataclasses.asdict(self.config))


@dataclass(frozen=True, slots=True)
class TouchedOrBaseRate:
    """`AlreadyTouched` with a base rate in 0..1."""

    config: AlreadyTouchedConfig
    base_rate: float
    answers: str = "observed"

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return P(contact) (B,)."""
        margin = self.config.margin
        rate = min(max(self.base_rate, margin), 1 - margin)
        return np.where(_touched(batch), 1 - margin, rate)

    def digest(self) -> str:
        """Return the SHA-256 of code version, settings and base rate."""
        settings = dataclasses.asdict(self.config) | {"base_rate": self.base_rate}
        return settings_digest(NAME, VERSION, settings)


def already_touched(**options: Any) -> AlreadyTouched:
    """Build a model that is certain if the contact was seen, and else gives the base rate.

    ``options`` are the fields of `AlreadyTouchedConfig`.
    """
    return AlreadyTouched(make_config(AlreadyTouchedConfig, NAME, options))


def _touched(batch: Batch) -> NDArray[np.bool_]:
    """Return which trials (B,) had a contact in the observed part."""
    pairs = zip(motions(batch, NAME), batch.trials, strict=True)
    return np.array([touched(observed_motion(motion, trial)) for motion, trial in pairs], np.bool_)
