"""The training loop: seeded, resumable to the bit on a CPU, ended by a loss that is not finite."""

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
from physion.errors import BadInputError, PhysionError
from physion.seeds import stable_hash
from physion.training.checkpoint import (
    Checkpoint,
    hash_config,
    load_checkpoint,
    save_checkpoint,
)

CHECKPOINT, METRICS = "checkpoint.safetensors", "metrics.jsonl"
_FREE = ("steps", "log_every", "checkpoint_every")
"""Settings that do not change the curve, only how far and how often it is written down."""

Batches = Callable[[int], Mapping[str, Tensor]]
Progress = Callable[[str, int, int], None]


class TrainingStoppedError(PhysionError):
    """The loss became NaN or infinite. The last checkpoint before it stays."""


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """How dynamics are trained.

    - ``steps``, ``batch`` (windows a step), ``learning_rate`` of Adam, whose moments are kept
      from step to step. The released setting is 1000, 32 and 1e-2, with moments thrown away.
    - ``seed``: of batches and of anything random inside the model.
    - ``log_every``, ``checkpoint_every``: steps.
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
            raise BadInputError(f"learning rate must be above zero, not {self.learning_rate}")


@dataclass(frozen=True)
class TrainingResult:
    """``losses``: one a step, from the first step on, also those before a resume."""

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
    """Train ``model`` in place for ``config.steps`` steps; its ``forward(batch)`` is the loss.

    ``batches(step)`` gives the batch of a step, steps counted from 0. With a ``folder`` a
    checkpoint and ``metrics.jsonl`` are kept there, and training goes on from what is there;
    ``identity`` (JSON values) then says which model and data it is. Raises `TrainingStoppedError`
    with the step of a loss that is not finite, `BadInputError` for a checkpoint of another config.
    """
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in _FREE}
    config_hash = hash_config({"training": settings, "identity": dict(identity or {})})
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    optimizer = torch.optim.Adam(trained, lr=config.learning_rate)
    losses: list[float] = []
    path = folder / CHECKPOINT if folder is not None else None
    wrapped, wrapped_optimizer = fabric.setup(model, optimizer)
    if path is not None and path.is_file():
        # After the set-up, so that the optimiser's state follows the weights to their device.
        losses = list(load_checkpoint(path, config_hash, model, optimizer).losses)
        if len(losses) > config.steps:
            raise BadInputError(f"{path} has {len(losses)} steps, more than the {config.steps}")
    model.train()
    for step in range(len(losses), config.steps):
        loss = _step(wrapped, wrapped_optimizer, batches(step), step, config.seed, fabric)
        losses.append(loss)
        done = step + 1 == config.steps
        if path is not None and (done or (step + 1) % config.checkpoint_every == 0):
            story = Checkpoint(step + 1, tuple(losses), config_hash, dict(identity or {}))
            save_checkpoint(path, story, model, optimizer)
            _write_metrics(path.with_name(METRICS), losses, config.log_every)
        if progress is not None:
            progress("training", step + 1, config.steps)
    model.eval()
    return TrainingResult(tuple(losses), config_hash)


def _step(
    model: Any, optimizer: Any, batch: Mapping[str, Tensor], step: int, seed: int, fabric: Fabric
) -> float:
    # Seeded by the step, so that what is random in a model needs no stored generator.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(stable_hash("step", seed, step) % 2**63)
        optimizer.zero_grad(set_to_none=True)
        loss: Tensor = model({name: fabric.to_device(value) for name, value in batch.items()})
        value = float(loss.detach())
        if not math.isfinite(value):
            raise TrainingStoppedError(
                f"training stopped at step {step}: the loss is {value}; "
                "lower the learning rate, or look at the features of that batch"
            )
        fabric.backward(loss)
        optimizer.step()
    return value


def _write_metrics(path: Path, losses: list[float], every: int) -> None:
    """All of them anew: a resume can then neither double nor lose a line."""
    kept = [i for i in range(len(losses)) if i % every == 0 or i + 1 == len(losses)]
    lines = [json.dumps({"step": i, "loss": losses[i]}) + "\n" for i in kept]
    write_atomic(path, "".join(lines).encode())
