"""Training loop: seeded, resumable with identical results on a CPU, stopped by a bad loss."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from physion.atomic import write_atomic
from physion.compute.progress import Progress
from physion.errors import BadInputError, PhysionError
from physion.seeds import stable_hash
from physion.training.checkpoint import (
    Checkpoint,
    hash_config,
    load_checkpoint,
    save_checkpoint,
)

CHECKPOINT, METRICS = "checkpoint.safetensors", "metrics.jsonl"
_NOT_HASHED = ("steps", "log_every", "checkpoint_every")
"""Settings that do not change the losses, only their number and how often they are written."""

Batches = Callable[[int], Mapping[str, Tensor]]


class TrainingStoppedError(PhysionError):
    """Error for a loss that became NaN or infinite; the last checkpoint before it is kept."""


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """Settings of the training of dynamics.

    - ``steps``, ``batch`` (windows per step), ``learning_rate`` of Adam. The released code used
      1000, 32 and 1e-2, and reset Adam's moments at every step; here they are kept.
    - ``seed``: of the batches and of random operations in the model.
    - ``log_every``, ``checkpoint_every``: intervals in steps.
    """

    steps: int = 1000
    batch: int = 32
    learning_rate: float = 1e-3
    seed: int = 0
    log_every: int = 10
    checkpoint_every: int = 100

    def __post_init__(self) -> None:
        if min(self.steps, self.batch, self.log_every, self.checkpoint_every) < 1:
            raise BadInputError("steps, batch, log_every and checkpoint_every must be at least 1")
        if not 0 < self.learning_rate < math.inf:
            raise BadInputError(f"learning rate must be positive, not {self.learning_rate}")


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training; ``losses`` has one value per step, including those before a resume."""

    losses: tuple[float, ...]
    config_hash: str


def train(
    model: nn.Module,
    batches: Batches,
    config: TrainingConfig,
    fabric: Fabric,
    *,
    folder: Path | None = None,
    identity: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> TrainingResult:
    """Train ``model`` in place for ``config.steps`` steps.

    Parameters
    ----------
    model
        Module whose ``forward(batch)`` returns the loss.
    batches
        Function that returns the batch of a step (from 0).
    config
        Settings of the training.
    fabric
        Device.
    folder
        Where a checkpoint and ``metrics.jsonl`` are kept, and from which training resumes; None
        keeps nothing.
    identity
        JSON values that identify model and data, part of the checkpoint's hash.
    progress
        Called after every step.

    Raises
    ------
    TrainingStoppedError
        If a loss is not finite; the message names the step.
    BadInputError
        If the checkpoint in ``folder`` belongs to another config.
    """
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_HASHED}
    config_hash = hash_config({"training": settings, "identity": dict(identity or {})})
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    optimizer = torch.optim.Adam(trained, lr=config.learning_rate)
    losses: list[float] = []
    path = folder / CHECKPOINT if folder is not None else None
    wrapped, wrapped_optimizer = fabric.setup(model, optimizer)
    if path is not None and path.is_file():
        # After the set-up, so that the optimiser's state is on the device of the weights.
        losses = list(load_checkpoint(path, config_hash, model, optimizer).losses)
        if len(losses) > config.steps:
            raise BadInputError(f"{path} has {len(losses)} steps, more than the {config.steps}")
    model.train()
    for step in range(len(losses), config.steps):
        loss = _step(wrapped, wrapped_optimizer, batches(step), step, config.seed, fabric)
        losses.append(loss)
        last = step + 1 == config.steps
        if path is not None and (last or (step + 1) % config.checkpoint_every == 0):
            checkpoint = Checkpoint(step + 1, tuple(losses), config_hash, dict(identity or {}))
            save_checkpoint(path, checkpoint, model, optimizer)
            _write_metrics(path.with_name(METRICS), losses, config.log_every)
        if progress is not None:
            progress("training", step + 1, config.steps)
    model.eval()
    return TrainingResult(tuple(losses), config_hash)


def _step(
    model: Any, optimizer: Any, batch: Mapping[str, Tensor], step: int, seed: int, fabric: Fabric
) -> float:
    # Seeded by the step, so that no state of a generator has to be stored.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(stable_hash("step", seed, step) % 2**63)
        optimizer.zero_grad(set_to_none=True)
        loss: Tensor = model({name: fabric.to_device(value) for name, value in batch.items()})
        value = float(loss.detach())
        if not math.isfinite(value):
            raise TrainingStoppedError(
                f"training stopped at step {step}: the loss is {value}; "
                "lower the learning rate, or check the features of that batch"
            )
        fabric.backward(loss)
        optimizer.step()
    return value


def _write_metrics(path: Path, losses: list[float], every: int) -> None:
    """Write all losses again, so that a resume neither repeats nor loses a line."""
    kept = [i for i in range(len(losses)) if i % every == 0 or i + 1 == len(losses)]
    lines = [json.dumps({"step": i, "loss": losses[i]}) + "\n" for i in kept]
    write_atomic(path, "".join(lines).encode())
