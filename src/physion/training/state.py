"""How far a training is: what a checkpoint holds in addition to weights and optimiser."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from physion.training.schedule import Plateau


@dataclass
class TrainingState:
    """How far a training is, as stored in its checkpoints.

    - ``step``: finished steps.
    - ``recent``: values of the steps since the last line of the metrics, by name.
    - ``loss``: mean loss of the last interval of ``log_every`` steps.
    - ``validation``, ``baseline``: of the last validation; NaN without one.
    """

    step: int = 0
    recent: list[dict[str, float]] = field(default_factory=list)
    plateau: Plateau = field(default_factory=Plateau)
    loss: float = math.nan
    validation: float = math.nan
    baseline: float = math.nan

    def to_json(self) -> dict[str, Any]:
        """Return the state as JSON values."""
        return {
            "step": self.step,
            "recent": self.recent,
            "plateau": self.plateau.state(),
            "loss": _finite(self.loss),
            "validation": _finite(self.validation),
            "baseline": _finite(self.baseline),
        }

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> TrainingState:
        """Return the state with the given JSON values."""
        losses = {
            name: math.nan if values[name] is None else float(values[name])
            for name in ("loss", "validation", "baseline")
        }
        plateau = Plateau.of(values["plateau"])
        return cls(int(values["step"]), list(values["recent"]), plateau, **losses)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
