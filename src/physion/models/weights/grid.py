"""Features that keep positions: the last feature map of an encoder, averaged in a small grid."""

from __future__ import annotations

import math
from typing import Final, Literal

from torch import Tensor, nn
from torch.nn import functional

from physion.errors import BadInputError

POOLED: Final = "pooled"
GRID: Final = "grid"
Pooling = Literal["pooled", "grid"]
CELLS = 4
"""Rows and columns of the grid."""


def check_pooling(pooling: str) -> None:
    """Raise `BadInputError` unless ``pooling`` is ``pooled`` or ``grid``."""
    if pooling not in (POOLED, GRID):
        raise BadInputError(f"pooling must be {POOLED} or {GRID}, not {pooling!r}")


def average_cells(feature_map: Tensor) -> Tensor:
    """Return maps (N, channels, rows, columns) averaged in cells, as `GridFeatures` orders them."""
    rows, columns = (min(CELLS, side) for side in feature_map.shape[2:])
    cells = functional.adaptive_avg_pool2d(feature_map, (rows, columns))
    return cells.permute(0, 2, 3, 1).flatten(1)


class GridFeatures(nn.Module):
    """Encoder whose features are its last map, averaged in a grid of `CELLS` x `CELLS` cells.

    It maps (B, 3, H, W) to (B, rows * columns * channels), ordered by row, then column, then
    channel. Where the sides of the map are no multiples of `CELLS`, neighbouring cells overlap by
    a row or column; a map with fewer rows or columns is not enlarged. The map of a transformer
    consists of its patch tokens, without class and register tokens.
    """

    def __init__(self, encoder: nn.Module, name: str) -> None:
        super().__init__()
        self.encoder, self.name = encoder, name

    def forward(self, pictures: Tensor) -> Tensor:
        """Return features of standardised pictures (B, 3, H, W)."""
        return average_cells(self._feature_map(pictures))

    def _feature_map(self, pictures: Tensor) -> Tensor:
        """Return the last map (B, channels, rows, columns)."""
        features = self.encoder.forward_features(pictures)  # type: ignore[operator]
        if isinstance(features, Tensor) and features.ndim == 4:
            channels = getattr(self.encoder, "num_features", None)
            last = features.shape[3] == channels != features.shape[1]
            return features.permute(0, 3, 1, 2) if last else features
        if isinstance(features, Tensor) and features.ndim == 3:
            patches = features[:, int(getattr(self.encoder, "num_prefix_tokens", 0)) :]  # type: ignore[arg-type]
            side = math.isqrt(patches.shape[1])
            if side * side == patches.shape[1]:
                return patches.transpose(1, 2).reshape(len(patches), -1, side, side)
        raise BadInputError(f"encoder {self.name!r} has no square feature map; use pooling=pooled")
