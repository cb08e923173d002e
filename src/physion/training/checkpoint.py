"""Checkpoints: one safetensors file, written atomically, with metadata as JSON in its header.

Only safetensors and JSON are read, so that no code in a file can be executed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.optim import Optimizer

from physion.atomic import write_atomic
from physion.errors import BadInputError

_METADATA = "physion"
_MODEL, _OPTIMIZER, _LOSSES = "model/", "optimizer/", "losses"


@dataclass(frozen=True)
class Checkpoint:
    """State of a training after ``step`` steps.

    ``losses`` has one value per step. ``config_hash`` identifies everything that determines the
    losses; a checkpoint is not resumed under another one.
    """

    step: int
    losses: tuple[float, ...]
    config_hash: str
    details: Mapping[str, Any]


def hash_config(parts: Mapping[str, Any]) -> str:
    """Return the hexadecimal SHA-256 of JSON values, independent of the order of keys."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def save_checkpoint(
    path: Path, checkpoint: Checkpoint, model: nn.Module, optimizer: Optimizer
) -> None:
    """Write model, optimiser and metadata; also the metadata alone, as a ``.json`` file."""
    tensors = {_MODEL + name: value for name, value in model.state_dict().items()}
    for index, values in optimizer.state_dict()["state"].items():
        tensors |= {f"{_OPTIMIZER}{index}/{key}": value for key, value in values.items()}
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    tensors[_LOSSES] = torch.tensor(checkpoint.losses, dtype=torch.float64)
    metadata = json.dumps(
        {
            "step": checkpoint.step,
            "config_hash": checkpoint.config_hash,
            "details": dict(checkpoint.details),
        },
        sort_keys=True,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, save(tensors, {_METADATA: metadata}))
    write_atomic(path.with_suffix(".json"), metadata.encode() + b"\n")


def load_checkpoint(
    path: Path, config_hash: str, model: nn.Module, optimizer: Optimizer | None = None
) -> Checkpoint:
    """Load a checkpoint into ``model`` and ``optimizer``.

    Raises `BadInputError`, and changes nothing, if the file is damaged or belongs to another
    config or network.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = json.loads((file.metadata() or {})[_METADATA])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        losses = tuple(float(value) for value in tensors[_LOSSES])
        checkpoint = Checkpoint(
            metadata["step"], losses, metadata["config_hash"], metadata["details"]
        )
    except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
        raise BadInputError(
            f"checkpoint {path} cannot be read ({error}); delete it to start training again"
        ) from error
    if checkpoint.config_hash != config_hash:
        raise BadInputError(
            f"checkpoint {path} belongs to another config ({checkpoint.config_hash[:12]}, "
            f"not {config_hash[:12]}); use another folder, or delete it"
        )
    weights = _with_prefix(tensors, _MODEL)
    expected = model.state_dict()
    if {k: v.shape for k, v in weights.items()} != {k: v.shape for k, v in expected.items()}:
        raise BadInputError(f"checkpoint {path} holds the weights of another network")
    model.load_state_dict(weights)
    if optimizer is not None:
        _load_optimizer(optimizer, _with_prefix(tensors, _OPTIMIZER))
    return checkpoint


def _with_prefix(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _load_optimizer(optimizer: Optimizer, tensors: Mapping[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        index, _, key = name.partition("/")
        state.setdefault(int(index), {})[key] = value
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})
