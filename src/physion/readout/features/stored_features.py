"""Features of trials that are read from their files piece by piece."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.readout.features.feature_file import FeatureArrays

Floats = NDArray[np.float32]

FEATURES = "features"
"""Name of the array of features."""


class StoredFeatures:
    """Features (n, T', D) float32 of n trials, in files that are memory-mapped or in memory.

    Parameters
    ----------
    trials
        Names (n).
    rows
        For every trial the file or arrays with its features (T', D).

    Raises
    ------
    BadInputError
        If the shapes of two trials differ.
    """

    def __init__(self, trials: Sequence[str], rows: Sequence[FeatureArrays]) -> None:
        self.trials = tuple(trials)
        self._rows = tuple(rows)
        shapes = [row.shapes[FEATURES] for row in self._rows]
        for trial, shape in zip(self.trials, shapes, strict=True):
            if shape != shapes[0]:
                raise BadInputError(
                    f"features of trial {trial!r} are {shape}, those of {self.trials[0]!r} "
                    f"{shapes[0]}; a model must give equal shapes for all trials"
                )
        self._steps, self._size = shapes[0] if shapes else (0, 0)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of trials, of time steps, and of features of a step."""
        return len(self._rows), self._steps, self._size

    @property
    def width(self) -> int:
        """Number of features of a trial, all time steps together."""
        return self._steps * self._size

    def columns(self, start: int, stop: int) -> Floats:
        """Return columns ``start`` to ``stop`` of the features flattened in time, (n, columns)."""
        stop = min(stop, self.width)
        out = np.empty((len(self._rows), max(stop - start, 0)), np.float32)
        for values, row in zip(out, self._rows, strict=True):
            values[:] = row.read(FEATURES, start, stop)
        return out

    def frame(self, step: int) -> Floats:
        """Return the features (n, D) of one time step."""
        return self.columns(step * self._size, (step + 1) * self._size)

    def array(self) -> Floats:
        """Return all features (n, T', D), in memory."""
        return self.columns(0, self.width).reshape(self.shape)

    def select(self, rows: Sequence[int] | NDArray[Any]) -> StoredFeatures:
        """Return the trials with the given row numbers; their features are not read."""
        chosen = [int(row) for row in rows]
        selected = StoredFeatures(
            [self.trials[row] for row in chosen], [self._rows[row] for row in chosen]
        )
        # Without a trial the shape of one is still known.
        selected._steps, selected._size = self._steps, self._size
        return selected
