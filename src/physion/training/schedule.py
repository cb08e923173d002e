"""Learning rate of a step: warm-up, then constant, cosine, or lowered when validation stalls."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from physion.models.settings import TrainingSettings

_THRESHOLD = 1e-4
"""Relative decrease of the validation loss that counts as an improvement, as in torch."""


def learning_rate(settings: TrainingSettings, step: int, factor: float = 1.0) -> float:
    """Return the learning rate of a step.

    With base rate r, w steps of warm-up and n steps in all, step k (from 0) has

    - k < w: r (k + 1) / w,
    - k >= w, ``cosine``: r (1 + cos(pi (k - w) / (n - w))) / 2, which would be 0 at step n,
    - k >= w, otherwise: r.

    It is multiplied by ``factor``, that of `Plateau`.
    """
    rate = settings.learning_rate * factor
    if step < settings.warmup:
        return rate * (step + 1) / settings.warmup
    if settings.schedule == "cosine":
        done = (step - settings.warmup) / max(settings.steps - settings.warmup, 1)
        return rate * (1 + math.cos(math.pi * done)) / 2
    return rate


@dataclass
class Plateau:
    """Factor of the learning rate that falls when the validation loss stops falling.

    The rule is that of torch's ``ReduceLROnPlateau``: after more than ``patience`` validations in
    a row that are not lower than the best one by a ten-thousandth, the rate is lowered.
    """

    factor: float = 1.0
    best: float | None = None
    waited: int = 0

    def update(self, loss: float, settings: TrainingSettings) -> None:
        """Take the loss of a validation into account."""
        if self.best is None or loss < self.best - abs(self.best) * _THRESHOLD:
            self.best, self.waited = loss, 0
            return
        self.waited += 1
        if self.waited > settings.plateau_patience:
            self.factor, self.waited = self.factor * settings.plateau_factor, 0

    def state(self) -> dict[str, Any]:
        """Return the state as JSON values."""
        return {"factor": self.factor, "best": self.best, "waited": self.waited}

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> Plateau:
        """Return the plateau with a stored `state`."""
        best = state["best"]
        return cls(
            float(state["factor"]), None if best is None else float(best), int(state["waited"])
        )
