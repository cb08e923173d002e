"""Baselines that see pictures: `copy-last-frame` and `blob-centroids`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import Batch, Provenance, Rollout, Spec
from physion.core.errors import BadInputError
from physion.models.baselines.motion import Baseline
from physion.models.interface import ModelSettings
from physion.scenes.looks import RED, ROLE_HUES, STRONG_SATURATION, STRONG_VALUE, YELLOW

# Baseline `copy-last-frame`: pixels, and a future that looks like the last observed frame.


@dataclass(frozen=True, kw_only=True)
class PixelSettings(ModelSettings):
    """Settings of a baseline that sees pictures.

    - ``image_size``: pixels per side of the pictures. ``stride``, ``context``, ``future``,
      ``context_at``: frames of a clip, as in `Spec`.
    """

    image_size: int
    stride: int = 6
    context: int = 0
    future: int | None = None
    context_at: Literal["start", "end"] = "end"

    def spec(self) -> Spec:
        """Return what the model asks for."""
        return Spec(
            image_size=self.image_size,
            stride=self.stride,
            context=self.context,
            future=self.future,
            context_at=self.context_at,
        )


@dataclass(frozen=True, kw_only=True)
class CopyLastFrameSettings(PixelSettings):
    """Settings of `CopyLastFrame`: see `PixelSettings`."""

    image_size: int = 32


class CopyLastFrame(Baseline):
    """Model whose features are pixels and that imagines that nothing changes.

    Features: red, green and blue in 0..1 of all pixels, row by row. The imagined ones repeat the
    last context frame. A model that predicts pixels must predict better than this.
    """

    name = "copy-last-frame"
    sees = "pixels"

    def __init__(self, settings: CopyLastFrameSettings) -> None:
        super().__init__(settings)
        self.spec = settings.spec()

    def encode(self, batch: Batch) -> NDArray[np.float32]:
        """Return the pixels (B, T, 3 * size * size) in 0..1."""
        rgb = pictures(batch, self.spec.image_size, self.name)
        return np.divide(rgb.reshape(*rgb.shape[:2], -1), 255, dtype=np.float32)

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Return the last frame's features, repeated; all ``samples`` are equal.

        With pictures in ``context``, ``shown`` holds them under ``rgb``.
        """
        features = self.encode(context) if context.features is None else context.features
        return Rollout(
            features=_repeat(features, samples, context.future),
            shown={}
            if context.rgb is None
            else {"rgb": _repeat(context.rgb, samples, context.future)},
        )

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return dataclasses.replace(super().provenance(), dynamics_type="none")


def pictures(batch: Batch, size: int, model: str) -> NDArray[np.uint8]:
    """Return ``batch.rgb`` (B, T, H, W, 3), pictures of ``size`` pixels a side.

    Raises `BadInputError` for a batch without pictures or with others.
    """
    if batch.rgb is None or batch.rgb.shape[2:] != (size, size, 3):
        held = "none" if batch.rgb is None else f"pictures of shape {batch.rgb.shape[2:]}"
        raise BadInputError(f"{model} needs pictures (input rgb) of {size} x {size}, not {held}")
    return np.asarray(batch.rgb)


def _repeat(frames: NDArray[Any], samples: int, future: int) -> NDArray[Any]:
    """Return the last of frames (B, T, ...) as (B, samples, future, ...)."""
    last = np.asarray(frames)[:, -1]
    shape = (len(last), samples, future, *last.shape[1:])
    return np.array(np.broadcast_to(last[:, None, None], shape))


# Baseline `blob-centroids`: where the red and the yellow pixels are.

FEATURES = ("red x", "red y", "red area", "yellow x", "yellow y", "yellow area")
"""Features of a frame. Centroids of pixel centres from 0 to 1 of width (to the right) and height
(downwards), 0.5 where there is no such pixel; areas are fractions of the picture."""


@dataclass(frozen=True, kw_only=True)
class BlobCentroidsSettings(PixelSettings):
    """Settings of `BlobCentroids`: see `PixelSettings`."""

    image_size: int = 64


class BlobCentroids(Baseline):
    """Encoder of six numbers a frame: centroid and area of the red and of the yellow pixels.

    It is meant for the look with a red agent and a yellow patient. Pixels count as red or yellow by
    the rule that keeps other bodies from being mistaken for them (`physion.scenes.looks`). It knows
    neither shape nor depth nor occlusion; a model that sees more should predict better.
    """

    name = "blob-centroids"
    sees = "colour blobs"

    def __init__(self, settings: BlobCentroidsSettings) -> None:
        super().__init__(settings)
        self.spec = settings.spec()

    def encode(self, batch: Batch) -> NDArray[np.float32]:
        """Return the features called `FEATURES` (B, T, 6) of every frame."""
        rgb = pictures(batch, self.spec.image_size, self.name)
        features = np.empty((*rgb.shape[:2], len(FEATURES)), np.float32)
        for clip, frames in enumerate(rgb):
            features[clip] = np.concatenate([_centroid(mask) for mask in color_masks(frames)], -1)
        return features

    def digest(self) -> str:
        """Return the SHA-256 of code version, settings and the rule of the colours."""
        rule = [ROLE_HUES[RED], ROLE_HUES[YELLOW], STRONG_SATURATION, STRONG_VALUE]
        return self.digest_of([dataclasses.asdict(self.settings), rule])


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
