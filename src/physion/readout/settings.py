"""Settings of evaluations and trainings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from physion.core.errors import BadInputError
from physion.readout.logistic import LogisticSettings


@dataclass(frozen=True, kw_only=True)
class HarnessSettings:
    """Settings that evaluations and trainings have in common."""

    folds: int = 5
    """Folds of the cross-validation of a dataset without a readout split."""
    encoder_batch: int = 4
    """Clips that a network encodes at a time; lower it when memory runs out."""
    rendered: bool = False
    """Render the pictures from the stored motions instead of reading the movies."""
    accelerator: str = "auto"
    """Device of the networks, by Lightning's name: auto, cpu, cuda, ..."""

    def __post_init__(self) -> None:
        if self.encoder_batch < 1 or self.folds < 2:
            raise BadInputError(
                f"encoder_batch must be at least 1 and folds at least 2, not "
                f"{self.encoder_batch} and {self.folds}"
            )


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings(HarnessSettings):
    """Settings of evaluations."""

    readouts: tuple[str, ...] = ()
    """Readouts: observed, observed+simulated, full. Default: all that the model supports."""
    decision: str = ""
    """What turns features or rollouts into P(contact) (physion ls decisions); default: the model's
    own."""
    untrained: bool = False
    """Leave the weights of the model as they are; the table says untrained."""
    logistic: Annotated[LogisticSettings, tyro.conf.Suppress] = field(
        default_factory=LogisticSettings
    )
    """Settings of the logistic regression."""
