"""Training loop: the loss falls, resuming is exact, a loss that is not finite stops it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from physion.errors import BadInputError
from physion.models.batch import Batch
from physion.models.settings import TrainingSettings
from physion.training.checkpoint import read_checkpoint
from physion.training.devices import Devices, OutOfMemoryError, make_fabric
from physion.training.folder import CARD, CHECKPOINT, PREVIOUS, WEIGHTS
from physion.training.loop import TrainingStoppedError
from physion.training.metrics_log import METRICS, read_metrics
from physion.training.schedule import Plateau, learning_rate
from physion.training.train import TrainedModel, train_model
from support.trained_models import QUICK, MovingValues, NextBrightness, equal_weights

CPU = make_fabric(Devices("cpu"), "32-true")


class Killed(Exception):
    """End of a training in the middle, as by a signal: nothing is written after it."""


def kill_at(step: int) -> Callable[[str, int, int], None]:
    def progress(what: str, done: int, total: int) -> None:
        if done == step:
            raise Killed

    return progress


def run(model: NextBrightness, folder: Path | None = None, **options: Any) -> TrainedModel:
    source = options.pop("source", None) or MovingValues()
    features = source.features if model.diet == "features" else None
    return train_model(
        model,
        source,
        source.trials,
        **{"seed": 0, "name": "all", "folder": folder, "features": features, **options},
        fabric=CPU,
    )


def files_of(folder: Path) -> dict[str, bytes]:
    return {
        path.name: path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.parent.name != "events"
    }


@pytest.mark.parametrize("diet", ["clips", "features", "states"])
def test_a_model_learns_from_every_diet(diet: Any) -> None:
    model = NextBrightness(diet)
    source = MovingValues(spec=model.spec)
    result = run(model, source=source, settings=replace(QUICK, steps=200))
    assert result.loss < 0.2 * NextBrightness_loss_at_start(diet)
    assert result.validation < 0.5 * result.baseline
    assert not model.training and len(model.prepared) == 1


def NextBrightness_loss_at_start(diet: Any) -> float:
    model = NextBrightness(diet)
    source = MovingValues(spec=model.spec)
    first = run(model, source=source, settings=replace(QUICK, steps=1, learning_rate=1e-9))
    return first.loss
