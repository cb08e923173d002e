"""Train a model's dynamics on features of whole clips, and say whether they beat standing still."""

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

from physion.errors import BadInputError
from physion.models.interface import Learns, Model, Simulates
from physion.training.batches import WindowBatches, copy_last_loss, hold_out
from physion.training.checkpoint import hash_config
from physion.training.loop import Progress, TrainingConfig, TrainingResult, train

Floats = NDArray[np.float32]

HELD_OUT = 0.1
"""Share of the training trials whose loss is only looked at."""


@dataclass(frozen=True)
class DynamicsReport:
    """How a training went; losses are mean squared errors of one step, in squared features.

    ``validation`` and ``copy_last`` are of the held-out trials, after training: dynamics that have
    learnt anything are below ``copy_last``.
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

    With a ``folder`` the checkpoint lies in a sub-folder named by the hash of config, model and
    data, so that another setting never meets it.
    """
    if not (isinstance(model, nn.Module) and isinstance(model, Learns)):
        raise BadInputError(f"model {model.provenance().model!r} has nothing to train")
    rows, held = hold_out(len(features), HELD_OUT, config.seed)
    context = model.spec.context
    batches = WindowBatches(features[rows], context + 1, config.batch, config.seed)
    identity: dict[str, Any] = {"data": batches.digest(), "model": _describe(model)}
    settings = {**dataclasses.asdict(config), **identity}
    own = folder / hash_config(settings)[:16] if folder is not None else None
    model.adapt(torch.from_numpy(features[rows]))
    result = train(model, batches, config, fabric, folder=own, identity=identity, progress=progress)
    return DynamicsReport(
        result,
        one_step_loss(model, features[held], fabric),
        copy_last_loss(features[held], context),
    )


def simulate_features(
    model: Model, context: Floats, steps: int, fabric: Fabric, *, batch: int = 64
) -> Floats:
    """Roll ``context`` (trials, context, features) on: (trials, steps, features), float32."""
    if not isinstance(model, Simulates):
        raise BadInputError(f"model {model.provenance().model!r} does not simulate")
    made = []
    with torch.inference_mode():
        for start in range(0, len(context), batch):
            given = fabric.to_device(torch.from_numpy(context[start : start + batch].copy()))
            made.append(model.simulate(given, steps).cpu().numpy())
    empty = np.zeros((0, steps, context.shape[2]), np.float32)
    return np.concatenate(made).astype(np.float32) if made else empty


def one_step_loss(model: Model, features: Floats, fabric: Fabric) -> float:
    """Mean squared error of the next feature over all windows of ``features``, in their own units.

    The counterpart of `copy_last_loss`; NaN without a window.
    """
    context = model.spec.context
    total, count = 0.0, 0
    for start in range(features.shape[1] - context):
        given, following = features[:, start : start + context], features[:, start + context]
        made = simulate_features(model, given, 1, fabric)[:, 0]
        total += float(np.square(made.astype(np.float64) - following).sum())
        count += following.size
    return total / count if count else float("nan")


def _describe(model: Any) -> dict[str, Any]:
    """The model's config where it has one; without weights of the encoder, which data tells."""
    described: dict[str, Any] = dataclasses.asdict(model.provenance())
    config = getattr(model, "config", None)
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        described["config"] = {k: str(v) for k, v in dataclasses.asdict(config).items()}
    return described
