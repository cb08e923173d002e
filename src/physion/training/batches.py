"""Training batches: windows of features, sampled as a function of seed and step."""

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
    """Random windows of ``length`` time steps of ``features`` (trials, time, features).

    A batch is a function of the seed and the step alone, so that a resumed training receives
    the same batches as one that was not interrupted.
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
        """Return ``features`` (size, length, features) of a step."""
        rng = generator("batch", self.seed, step)
        trials = rng.integers(len(self.features), size=self.size)
        starts = rng.integers(self.features.shape[1] - self.length + 1, size=self.size)
        times = starts[:, None] + np.arange(self.length)
        return {"features": torch.from_numpy(self.features[trials[:, None], times])}

    def digest(self) -> str:
        """Return the hexadecimal SHA-256 of the features and of the settings of the windows."""
        sha = hashlib.sha256(repr((self.features.shape, self.length, self.size)).encode())
        sha.update(np.ascontiguousarray(self.features).tobytes())
        return sha.hexdigest()


def hold_out(count: int, fraction: float, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the sorted rows for training and those held out for validation.

    ``fraction`` of ``count`` rows is held out, but at least one if there are two or more; a single
    row is used for both.
    """
    if count < 2:
        rows = np.arange(count)
        return rows, rows
    held = min(count - 1, max(1, round(fraction * count)))
    order = generator("hold out", seed).permutation(count)
    return np.sort(order[held:]), np.sort(order[:held])


def copy_last_loss(features: Floats, context: int) -> float:
    """Return the mean squared error of predicting the last feature again, over all windows.

    ``features`` is (trials, time, features). This is the baseline of dynamics; NaN if no window
    fits.
    """
    change = np.diff(features.astype(np.float64), axis=1)[:, context - 1 :]
    return float(np.mean(change**2)) if change.size else float("nan")
