"""Windows of features to train dynamics on, drawn by seed and step alone."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from physion.errors import BadInputError
from physion.seeds import generator

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class WindowBatches:
    """Random windows of ``features`` (trials, time, features), ``length`` steps each.

    The batch of a step is a function of the seed and the step, never of the steps before, so
    that training that was stopped goes on with the very batches it would have had.
    """

    features: Floats
    length: int
    size: int
    seed: int

    def __post_init__(self) -> None:
        trials, time = self.features.shape[:2]
        if trials == 0 or time < self.length:
            raise BadInputError(
                f"training needs windows of {self.length} steps, but there are {trials} trials "
                f"of {time} steps"
            )

    def __call__(self, step: int) -> dict[str, Tensor]:
        """``features`` (size, length, features) of the step."""
        rng = generator("batch", self.seed, step)
        trials = rng.integers(len(self.features), size=self.size)
        starts = rng.integers(self.features.shape[1] - self.length + 1, size=self.size)
        moments = starts[:, None] + np.arange(self.length)
        return {"features": torch.from_numpy(self.features[trials[:, None], moments])}

    def digest(self) -> str:
        """Hexadecimal SHA-256 of the features and of how windows are drawn."""
        sha = hashlib.sha256(repr((self.features.shape, self.length, self.size)).encode())
        sha.update(np.ascontiguousarray(self.features).tobytes())
        return sha.hexdigest()


def hold_out(count: int, share: float, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sorted rows to train on and rows held out to validate, ``share`` of ``count``.

    At least one row is held out where there are two or more; a single row is both.
    """
    if count < 2:
        rows = np.arange(count)
        return rows, rows
    held = min(count - 1, max(1, round(share * count)))
    order = generator("hold out", seed).permutation(count)
    return np.sort(order[held:]), np.sort(order[:held])


def copy_last_loss(features: Floats, context: int) -> float:
    """Mean squared error of saying that the next feature is the last one, over all windows.

    ``features`` (trials, time, features). It is what any dynamics must beat; NaN without a window.
    """
    change = np.diff(features.astype(np.float64), axis=1)[:, context - 1 :]
    return float(np.mean(change**2)) if change.size else float("nan")
