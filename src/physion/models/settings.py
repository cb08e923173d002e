"""Settings of a training, which belong to the model that is trained."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from physion.errors import BadInputError


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """Optimiser, schedule and length of a training.

    - ``steps``: steps of the optimiser. ``batch``: clips a step; ``accumulate``: batches whose
      gradients are averaged for a step.
    - ``optimizer``: ``adam`` or ``adamw``, with ``learning_rate``, ``betas`` and ``weight_decay``.
    - ``schedule``: of the learning rate after ``warmup`` steps of linear rise: ``constant``,
      ``cosine`` (to 0 at the last step), or ``plateau`` (times ``plateau_factor`` after
      more than ``plateau_patience`` validations in a row without improvement, as in torch).
    - ``clip``: largest norm of the gradient; 0 does not clip.
    - ``precision``: of Fabric: ``32-true``, ``16-mixed`` or ``bf16-mixed``.
    - ``validate_every``: steps between validations on held-out trials; ``held_out``: their
      fraction. ``log_every``, ``checkpoint_every``: intervals in steps.
    """

    steps: int = 1000
    batch: int = 32
    accumulate: int = 1
    optimizer: Literal["adam", "adamw"] = "adam"
    learning_rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 0.0
    schedule: Literal["constant", "cosine", "plateau"] = "constant"
    warmup: int = 0
    plateau_factor: float = 0.8
    plateau_patience: int = 3
    clip: float = 0.0
    precision: str = "32-true"
    held_out: float = 0.1
    validate_every: int = 100
    log_every: int = 10
    checkpoint_every: int = 100

    def __post_init__(self) -> None:
        counts = ("steps", "batch", "accumulate", "validate_every", "log_every", "checkpoint_every")
        for name in counts:
            value = getattr(self, name)
            if value < 1:
                raise BadInputError(f"training: {name} must be at least 1, not {value}")
        if not 0 < self.learning_rate < math.inf:
            raise BadInputError(
                f"training: learning_rate must be positive, not {self.learning_rate}"
            )
        if min(self.warmup, self.clip, self.weight_decay) < 0 or not 0 <= self.held_out < 1:
            raise BadInputError(
                "training: warmup, clip and weight_decay must not be negative, and held_out must "
                "be at least 0 and below 1"
            )
        for name, known in (
            ("optimizer", ("adam", "adamw")),
            ("schedule", ("constant", "cosine", "plateau")),
        ):
            if getattr(self, name) not in known:
                raise BadInputError(
                    f"training: {name} must be one of {', '.join(known)}, "
                    f"not {getattr(self, name)!r}"
                )
