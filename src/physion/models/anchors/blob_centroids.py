"""Anchor `blob-centroids`: where the red and the yellow pixels are."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.models.anchors.copy_last_frame import pictures
from physion.models.anchors.settings_digest import settings_digest
from physion.models.batch import Batch, Provenance, Spec
from physion.models.build import make_config
from physion.scenes.looks import RED, ROLE_HUES, STRONG_SATURATION, STRONG_VALUE, YELLOW
from physion.version import __version__

NAME, VERSION = "blob-centroids", 1
FEATURES = ("red x", "red y", "red area", "yellow x", "yellow y", "yellow area")
"""Features of a frame. Centroids of pixel centres from 0 to 1 of width (to the right) and height
(downwards), 0.5 where there is no such pixel; areas are fractions of the picture."""


@dataclass(frozen=True, slots=True)
class BlobCentroidsConfig:
    """Settings of `BlobCentroids`.

    - ``image_size``: pixels per side of the pictures. ``stride``, ``context``, ``future``: frames
      of a clip, as in `Spec`.
    """

    image_size: int = 64
    stride: int = 6
    context: int = 7
    future: int = 18


class BlobCentroids:
    """Encoder of six numbers a frame: centroid and area of the red and of the yellow pixels.

    It is meant for the look with a red agent and a yellow patient. Pixels count as red or yellow by
    the rule that keeps other bodies from being mistaken for them (`physion.scenes.looks`). It knows
    neither shape nor depth nor occlusion; a model that sees more should predict better.
    """

    def __init__(self, config: BlobCentroidsConfig) -> None:
        self.config = config
        self.spec = Spec(
            image_size=config.image_size,
            stride=config.stride,
            context=config.context,
            future=config.future,
        )

    def encode(self, batch: Batch) -> NDArray[np.float32]:
        """Return the features called `FEATURES` (B, T, 6) of every frame."""
        rgb = pictures(batch, self.spec.image_size, NAME)
        features = np.empty((*rgb.shape[:2], len(FEATURES)), np.float32)
        for clip, frames in enumerate(rgb):
            features[clip] = np.concatenate([_centroid(mask) for mask in color_masks(frames)], -1)
        return features

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return Provenance(
            NAME, "none", encoder_type="colour blobs", versions=f"physion {__version__}"
        )

    def digest(self) -> str:
        """Return the SHA-256 of code version, settings and the rule of the colours."""
        rule = [ROLE_HUES[RED], ROLE_HUES[YELLOW], STRONG_SATURATION, STRONG_VALUE]
        return settings_digest(NAME, VERSION, [dataclasses.asdict(self.config), rule])


def color_masks(rgb: NDArray[np.uint8]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which pixels (...) of pictures (..., 3) are red, and which are yellow.

    They have the hue of the role's colour (`ROLE_HUES`), a saturation of at least
    `STRONG_SATURATION` and a value of at least `STRONG_VALUE`, as in HSV.
    """
    colors = rgb.astype(np.float32) / 255
    red, green, blue = np.moveaxis(colors, -1, 0)
    value, least = colors.max(axis=-1), colors.min(axis=-1)
    spread = value - least
    strong = (spread >= STRONG_SATURATION * value) & (value >= STRONG_VALUE)
    # Hue of pixels without blue as the largest channel: -1/6 .. 1/2, as far as the ranges go.
    with np.errstate(divide="ignore", invalid="ignore"):
        hue = np.where(red >= green, green - blue, 2 * spread + blue - red) / (6 * spread)
    strong &= (value > blue) | (spread == 0)
    masks = [
        strong & (spread > 0) & (low <= hue) & (hue <= high)
        for low, high in (ROLE_HUES[RED], ROLE_HUES[YELLOW])
    ]
    return masks[0], masks[1]


def _centroid(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return x, y and area (T, 3) of the pixels in masks (T, H, W)."""
    steps, height, width = mask.shape
    counts = np.count_nonzero(mask.reshape(steps, -1), axis=1)
    across = mask.sum(axis=1) @ (np.arange(width) + 0.5) / width
    down = mask.sum(axis=2) @ (np.arange(height) + 0.5) / height
    middle = np.stack([across, down], axis=1) / np.maximum(counts, 1)[:, None]
    middle[counts == 0] = 0.5
    return np.column_stack([middle, counts / (height * width)]).astype(np.float32)


def blob_centroids(**options: Any) -> BlobCentroids:
    """Build features that say where the red and the yellow pixels are.

    ``options`` are the fields of `BlobCentroidsConfig`.
    """
    return BlobCentroids(make_config(BlobCentroidsConfig, NAME, options))
