"""Training of dynamics on features of whole clips, with the copy-last baseline."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning_fabric import Fabric
from numpy.typing import NDArray
from torch import nn

from physion.compute.progress import Progress
from physion.errors import BadInputError
from physion.models.interface import Learns, Model, Simulates
from physion.training.batches import WindowBatches, copy_last_loss, hold_out
from physion.training.checkpoint import hash_config
from physion.training.loop import TrainingConfig, TrainingResult, train

Floats = NDArray[np.float32]

HELD_OUT = 0.1
"""Fraction of the training trials that are held out for validation."""


@dataclass(frozen=True)
class DynamicsReport:
    """Losses of a training, as mean squared errors of the next feature.

    ``validation`` and ``copy_last`` (the baseline of `copy_last_loss`) are of the held-out trials
    after training; dynamics that have learnt something have ``validation`` < ``copy_last``.
    """

    training: TrainingResult
    validation: float
    copy_last: float


def train_dynamics(
    model: Model,
    features: Floats,
    config: TrainingConfig,
    fabric: Fabric,
    *,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> DynamicsReport:
    """Train ``model`` in place on ``features`` (trials, time, features) of whole clips.

    If ``folder`` is given, the checkpoint is kept in a sub-folder that is named by the hash of
    config, model and data. Raises `BadInputError` for a model that cannot be trained.
    """
    if not (isinstance(model, nn.Module) and isinstance(model, Learns)):
        raise BadInputError(f"model {model.provenance().model!r} has nothing to train")
    rows, held = hold_out(len(features), HELD_OUT, config.seed)
    context = model.spec.context
    batches = WindowBatches(features[rows], context + 1, config.batch, config.seed)
    identity: dict[str, Any] = {"data": batches.digest(), "model": _describe(model)}
    settings = {**dataclasses.asdict(config), **identity}
    subfolder = folder / hash_config(settings)[:16] if folder is not None else None
    model.adapt(torch.from_numpy(features[rows]))
    result = train(
        model, batches, config, fabric, folder=subfolder, identity=identity, progress=progress
    )
    return DynamicsReport(
        result,
        one_step_loss(model, features[held], fabric),
        copy_last_loss(features[held], context),
    )


def simulate_features(
    model: Model, context: Floats, steps: int, fabric: Fabric, *, batch: int = 64
) -> Floats:
    """Return features (trials, steps, features), float32, simulated from ``context``.

    ``context`` is (trials, context, features).
    """
    if not isinstance(model, Simulates):
        raise BadInputError(f"model {model.provenance().model!r} does not simulate")
    simulated = []
    with torch.inference_mode():
        for start in range(0, len(context), batch):
            inputs = fabric.to_device(torch.from_numpy(context[start : start + batch].copy()))
            simulated.append(model.simulate(inputs, steps).cpu().numpy())
    empty = np.zeros((0, steps, context.shape[2]), np.float32)
    return np.concatenate(simulated).astype(np.float32) if simulated else empty


def one_step_loss(model: Model, features: Floats, fabric: Fabric) -> float:
    """Return the mean squared error of the next feature over all windows of ``features``.

    It has the unit of `copy_last_loss`, to which it compares; NaN if no window fits.
    """
    context = model.spec.context
    total, count = 0.0, 0
    for start in range(features.shape[1] - context):
        inputs, following = features[:, start : start + context], features[:, start + context]
        predicted = simulate_features(model, inputs, 1, fabric)[:, 0]
        total += float(np.square(predicted.astype(np.float64) - following).sum())
        count += following.size
    return total / count if count else float("nan")


def _describe(model: Any) -> dict[str, Any]:
    """Return provenance and config of a model; the features identify the encoder's weights."""
    described: dict[str, Any] = dataclasses.asdict(model.provenance())
    config = getattr(model, "config", None)
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        described["config"] = {k: str(v) for k, v in dataclasses.asdict(config).items()}
    return described
