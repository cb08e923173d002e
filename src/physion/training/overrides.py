"""Settings of a training that a user sets in place of those of the model."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from physion.models.settings import TrainingSettings


@dataclass(frozen=True, slots=True)
class TrainingOverrides:
    """Single fields of `TrainingSettings`; None leaves the value of the model."""

    steps: int | None = None
    """Steps of the optimiser; default: that of the model, as for all settings up to
    checkpoint-every."""
    batch: int | None = None
    """Clips of a step, divided among the devices."""
    accumulate: int | None = None
    """Batches whose gradients are averaged for a step; raise it where memory is short."""
    optimizer: Literal["adam", "adamw"] | None = None
    """Optimiser."""
    learning_rate: float | None = None
    """Learning rate."""
    betas: tuple[float, float] | None = None
    """Decay rates of the optimiser's moments."""
    weight_decay: float | None = None
    """Weight decay."""
    schedule: Literal["constant", "cosine", "plateau"] | None = None
    """Schedule of the learning rate after the warm-up."""
    warmup: int | None = None
    """Steps in which the learning rate rises linearly."""
    plateau_factor: float | None = None
    """Factor of the learning rate when the validation loss stalls (schedule plateau)."""
    plateau_patience: int | None = None
    """Validations without improvement that are waited for (schedule plateau)."""
    clip: float | None = None
    """Largest norm of the gradient; 0 does not clip."""
    precision: Literal["32-true", "16-mixed", "bf16-mixed"] | None = None
    """Precision of the computation; weights stay float32."""
    held_out: float | None = None
    """Fraction of the trials that is held out for validation."""
    validate_every: int | None = None
    """Steps between two validations."""
    log_every: int | None = None
    """Steps of which one line of metrics holds the means."""
    checkpoint_every: int | None = None
    """Steps between two checkpoints."""

    def apply(self, settings: TrainingSettings) -> TrainingSettings:
        """Return ``settings`` with the fields that are not None."""
        # Not of a subclass, which has settings of other things too.
        names = [field.name for field in dataclasses.fields(TrainingOverrides)]
        values = {name: getattr(self, name) for name in names}
        return dataclasses.replace(
            settings, **{name: value for name, value in values.items() if value is not None}
        )
