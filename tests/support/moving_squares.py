"""Clips of coloured squares that move at constant speed, with the boxes of the squares."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from physion.clips.batch import Batch, Spec

COLORS = ((220, 40, 30), (230, 220, 40), (40, 60, 200), (40, 180, 60))
FUTURE = 11
"""Steps that a model is asked to imagine, where its spec leaves that open."""
BACKGROUND = 110
"""Gray of the pictures around the squares."""
SIDE, MARGIN = 0.2, 0.15
"""Side of the squares, and least distance of their centres from the edge of the picture."""


def squares(
    clips: int, frames: int, spec: Spec, seed: int = 0, count: int = 2, fall: float = 0.0
) -> Batch:
    """Return clips with ``count`` squares, as tensors; other rows of the boxes are NaN.

    With ``fall`` they do not move at constant speed, but fall by so much more, as part of the
    picture's height, until the last frame.
    """
    rng = np.random.default_rng(seed)
    ends = rng.uniform(MARGIN, 1 - MARGIN, (2, clips, 1, count, 2))
    time = np.linspace(0, 1, frames)[None, :, None, None]
    centers = ends[0] + time * (ends[1] - ends[0])
    centers[..., 1] += fall * time[..., 0] ** 2
    edges = np.concatenate([centers - SIDE / 2, centers + SIDE / 2], -1)
    pixels = (np.arange(spec.image_size) + 0.5) / spec.image_size
    rgb = np.full((clips, frames, spec.image_size, spec.image_size, 3), BACKGROUND, np.uint8)
    for square in range(count):
        left, top, right, bottom = np.moveaxis(edges[:, :, square, :, None], 2, 0)
        inside = ((top < pixels) & (pixels < bottom))[..., None]
        inside = inside & ((left < pixels) & (pixels < right))[..., None, :]
        rgb[inside] = COLORS[square]
    boxes = np.full((clips, frames, spec.objects, 4), np.nan, np.float32)
    boxes[:, :, :count] = edges
    return Batch(
        trials=tuple(f"squares_{row:04d}" for row in range(clips)),
        frames=np.tile(spec.stride * np.arange(frames), (clips, 1)),
        valid=np.ones((clips, frames), np.bool_),
        rgb=rgb if "rgb" in spec.inputs else None,
        boxes=boxes if "boxes" in spec.inputs else None,
        future=FUTURE if spec.future is None else spec.future,
    ).to("cpu")


def with_arrays(batch: Batch, **arrays: Any) -> Batch:
    """Return the batch with other arrays."""
    return dataclasses.replace(batch, **arrays)
