"""Settings of an evaluation."""

from __future__ import annotations

from dataclasses import dataclass, field

from physion.core.errors import BadInputError
from physion.readout.logistic import ReadoutConfig
from physion.training.loop import TrainingOverrides


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings(TrainingOverrides):
    """Settings that all evaluations of a plan have in common, and of the trainings they need."""

    readouts: tuple[str, ...] = ()
    """Protocols: observed, observed+simulated, full. Default: all that the model supports."""
    untrained: bool = False
    """Leave the weights of the model as they are; the table says untrained."""
    reader: str = ""
    """Reader of features or rollouts (physion ls readers); default: the model's own."""
    readout: ReadoutConfig = field(default_factory=ReadoutConfig)
    """Settings of the readout."""
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
class EvaluationConfig(EvaluationSettings):
    """Settings of one evaluation."""

    training: str = "all"
    """Scenarios that train the model: all, all-but or only the tested one."""
    scenario: str = ""
    """Tested scenario, under all-but and only; default: all of them."""
    seed: int = 0
    """Seed of folds and training."""
