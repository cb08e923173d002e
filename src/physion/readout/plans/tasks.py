"""Tasks of a plan: one training each, or one evaluation."""

from __future__ import annotations

from dataclasses import dataclass

from physion.readout.plans.selection import ModelChoice
from physion.readout.trainings import PlannedTraining
from physion.training.protocols import Training


@dataclass(frozen=True)
class TrainingTask:
    """One training of a plan, and the key of its record."""

    choice: ModelChoice
    protocol: Training
    planned: PlannedTraining
    seed: int
    key: str

    @property
    def label(self) -> str:
        """Model, set of trials, seed, and fold of a cross-validation."""
        fold = f", fold {self.planned.fold}" if self.planned.fold >= 0 else ""
        return f"{self.choice.name}, {self.planned.name}, seed {self.seed}{fold}"


@dataclass(frozen=True)
class EvaluationTask:
    """One evaluation of a plan, and the key of its record.

    ``scenario`` is empty where one training is tested on all scenarios. ``set_name`` is the name
    of the set that trains, or empty for a model that is not trained.
    """

    choice: ModelChoice
    protocol: Training
    set_name: str
    scenario: str
    seed: int
    key: str

    @property
    def label(self) -> str:
        """Model, set of trials if it is trained, and seed."""
        trained = f", {self.set_name}" if self.set_name else ""
        return f"{self.choice.name}{trained}, seed {self.seed}"
