"""Folder of one training: checkpoints while it runs, weights and model card when it is done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from physion.atomic import remove_leftovers, write_atomic
from physion.models.checkpoints.checkpoint import (
    WEIGHTS,
    DamagedFileError,
    check_same,
    read_checkpoint,
    versions,
    write_checkpoint,
)

CHECKPOINT, PREVIOUS = "checkpoint.safetensors", "previous.safetensors"
CARD = "model_card.md"
_DAMAGED = ".damaged"
"""Suffix of damaged files that were set aside."""


@dataclass(frozen=True, eq=False)
class CheckpointContent:
    """Content of a checkpoint, or of the file of a trained model."""

    path: Path
    tensors: Mapping[str, Tensor]
    metadata: Mapping[str, Any]


class TrainingFolder:
    """Files of one training.

    While it runs there are two checkpoints, so that one remains if the other is damaged. When it
    is done, the weights alone are written, without the state of the optimiser, and the checkpoints
    are deleted.

    Parameters
    ----------
    path
        The folder; it need not exist.
    config
        JSON values of everything that determines the weights. Files of another config are refused.
    """

    def __init__(self, path: Path, config: Mapping[str, Any]) -> None:
        self.path, self._config = path, config
        self.notes: list[str] = []
        """What was found damaged, in sentences."""
        self._damaged: list[Path] = []

    def finished(self) -> CheckpointContent | None:
        """Return the trained model, if there is one."""
        return self._read(WEIGHTS)

    def resumable(self) -> CheckpointContent | None:
        """Return the newest whole checkpoint, if there is one.

        Raises `BadInputError` if it was written by other versions of the libraries, with which the
        results would be a mixture.
        """
        found = self._read(CHECKPOINT) or self._read(PREVIOUS)
        if found is not None:
            check_same(found.path, "version", found.metadata["versions"], versions())
        if self._damaged:
            start = f"step {found.metadata['step']}" if found is not None else "the beginning"
            self.notes.append(f"training goes on from {start}")
        return found

    def clean(self) -> None:
        """Create the folder, set damaged files aside, delete what an interrupted writer left."""
        self.path.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self.path)
        for path in self._damaged:
            path.replace(path.with_name(path.name + _DAMAGED))

    def save(self, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
        """Write a checkpoint and keep the one before."""
        path = self.path / CHECKPOINT
        if path.is_file():
            path.replace(self.path / PREVIOUS)
        write_checkpoint(path, tensors, metadata)

    def finish(self, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any], card: str) -> None:
        """Write the trained model and its card, and delete the checkpoints."""
        write_atomic(self.path / CARD, card.encode())
        write_checkpoint(self.path / WEIGHTS, tensors, metadata)
        self.remove_checkpoints()

    def remove_checkpoints(self) -> None:
        """Delete the checkpoints of a training that is done."""
        for name in (CHECKPOINT, PREVIOUS):
            (self.path / name).unlink(missing_ok=True)

    def _read(self, name: str) -> CheckpointContent | None:
        path = self.path / name
        if not path.is_file():
            return None
        try:
            tensors, metadata = read_checkpoint(path)
        except DamagedFileError as error:
            self.notes.append(f"{error}; it is set aside as {name}{_DAMAGED}")
            self._damaged.append(path)
            return None
        check_same(path, "config", metadata["config"], self._config)
        return CheckpointContent(path, tensors, metadata)
