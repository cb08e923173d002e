"""Plans of trainings and of evaluations of the tiny models in `plan_models`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from physion.readout.logistic import ReadoutConfig
from physion.readout.plans.evaluation_plan import EvaluationPlan
from physion.readout.plans.selection import ModelChoice, Selection
from physion.readout.plans.training_plan import TrainingPlan
from physion.readout.settings import EvaluationSettings
from physion.readout.trainings import SharedTrainConfig
from physion.training.loop import TrainingOverrides
from physion.training.protocols import Training
from physion.trials.dataset import Dataset
from support.plans import plan_models

FILE = plan_models.__file__
IMAGINING = ModelChoice(f"{FILE}:Imagining")
FAILS = ModelChoice(f"{FILE}:FailsOnDrop")
UNTRAINED = ModelChoice(f"{FILE}:NothingToTrain")
EVERY = (Training.ALL, Training.ALL_BUT, Training.ONLY)
SETS = ["all", "no_collide", "no_drop", "collide", "drop"]
"""Names of the sets of trials that train a model under `EVERY` protocol."""
QUICK: dict[str, Any] = {"accelerator": "cpu", "readout": ReadoutConfig(grid=(1e-2, 1.0))}
"""Settings of evaluations."""


def make_training_plan(
    dots: Dataset,
    folder: Path,
    models: Sequence[ModelChoice] = (IMAGINING,),
    protocols: Sequence[Training] = EVERY,
    seeds: Sequence[int] = (0, 1),
    overrides: TrainingOverrides | None = None,
    scenario: str = "",
    **changes: Any,
) -> TrainingPlan:
    selection = Selection(tuple(models), tuple(protocols), tuple(seeds), scenario)
    shared = SharedTrainConfig(**{"accelerator": "cpu", **changes})
    return TrainingPlan(dots, folder, selection, overrides or TrainingOverrides(), shared)


def make_evaluation_plan(
    dots: Dataset,
    folder: Path,
    models: Sequence[ModelChoice] = (IMAGINING,),
    protocols: Sequence[Training] = EVERY,
    seeds: Sequence[int] = (0, 1),
    scenario: str = "",
    **changes: Any,
) -> EvaluationPlan:
    selection = Selection(tuple(models), tuple(protocols), tuple(seeds), scenario)
    return EvaluationPlan(dots, folder, selection, EvaluationSettings(**{**QUICK, **changes}))
