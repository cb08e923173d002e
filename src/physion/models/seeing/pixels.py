"""Rays of a frame: what is known about each object from its mask and the depth of the picture.

With o the position of the camera and v the vector of a pixel to depth 1, what the pixel sees is at
o + D v, where D is its depth along the axis of the camera. From the view matrix (R | t) and the
projection P of a pinhole camera, for the pixel in column j and row i of a picture of W by H pixels,

    o = -R^T t,     v = R^T ((2 (j + 1/2) / W - 1) / P00, (1 - 2 (i + 1/2) / H) / P11, 1).

An object is on every pixel of its mask at that pixel's depth. On every other pixel it is not in
front of what is seen there: the ray is free up to its depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import SCENERY_ID
from physion.core.errors import BadInputError
from physion.core.seeds import generator

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_PIXELS = 8
"""Pixels that a mask needs for a fit."""
BORDER, MARGIN = 2, 6
"""Pixels around a mask whose rays are free: most within the first distance, the rest within the
second of the box around the mask."""
FLOOR_RANGE = 0.03
"""Metres around 0 in which the floor is looked for."""


@dataclass(frozen=True, eq=False)
class Rays:
    """N rays of one frame that say something about one object.

    - ``origin`` (3,): of the camera, metres. ``vectors`` (N, 3): to depth 1.
    - ``depth`` (N,): of what is seen, metres. ``on`` (N,): whether that is the object; else the
      object is not in front of it.
    """

    origin: F64
    vectors: F64
    depth: F64
    on: Mask

    def points(self) -> F64:
        """Return the points (M, 3) of the object that are seen, metres."""
        on = self.on
        return np.asarray(self.origin + self.vectors[on] * self.depth[on, None])

    def first(self, count: int) -> Rays:
        """Return at most ``count`` rays, half of them on the object where there are so many."""
        on, off = np.flatnonzero(self.on), np.flatnonzero(~self.on)
        kept = np.concatenate([on[: count // 2], off[: count - count // 2]])
        return Rays(self.origin, self.vectors[kept], self.depth[kept], self.on[kept])


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """One frame: ``ids`` (H, W), ``depth`` (H, W) metres, and the rays of its pixels.

    ``origin`` (3,) metres and ``vectors`` (H, W, 3) are as in `Rays`.
    """

    ids: NDArray[np.uint8]
    depth: F64
    origin: F64
    vectors: F64

    def points(self, mask: Mask) -> F64:
        """Return the points (M, 3) that are seen on the pixels of a mask, metres."""
        return np.asarray(self.origin + self.vectors[mask] * self.depth[mask][:, None])

    def pixels(self, number: int) -> int:
        """Return how many pixels an object has."""
        return int(np.count_nonzero(self.ids == number))

    def rays(self, number: int, count: int = 600) -> Rays | None:
        """Return about ``count`` rays for an object, in a random order; None if it is not seen.

        Half are on the object, a third of these on the border of its mask.
        """
        mask = self.ids == number
        if np.count_nonzero(mask) < LEAST_PIXELS:
            return None
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        box = (
            slice(max(rows[0] - MARGIN, 0), rows[-1] + MARGIN + 1),
            slice(max(columns[0] - MARGIN, 0), columns[-1] + MARGIN + 1),
        )
        mask = mask[box]
        inner = ~_grown(~mask, 1)
        near = _grown(mask, BORDER) & ~mask
        rng = generator("seeing", "pixels of an object")
        half = count // 2
        on = _drawn(rng, (mask & ~inner, inner), (half // 3, half - half // 3))
        off = _drawn(rng, (near, ~mask & ~near), (2 * half // 3, half - 2 * half // 3))
        chosen = np.concatenate([on, off])
        return Rays(
            self.origin,
            self.vectors[box].reshape(-1, 3)[chosen],
            self.depth[box].reshape(-1)[chosen],
            np.arange(len(chosen)) < len(on),
        )


def picture_of(ids: NDArray[np.uint8], depth: NDArray[np.floating], camera: F64) -> SeenFrame:
    """Return a frame with its rays.

    Parameters
    ----------
    ids, depth
        (H, W), as in `physion.clips.batch.Batch`.
    camera
        View and projection matrix (2, 4, 4).

    Raises
    ------
    BadInputError
        If the matrices are not of a pinhole camera.
    """
    view, projection = camera
    rotation = view[:3, :3]
    pinhole = np.zeros((4, 4), np.bool_)
    pinhole[[0, 1, 2, 2, 3], [0, 1, 2, 3, 2]] = True
    fits = (
        np.isfinite(camera).all()
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        and np.allclose(view[3], (0, 0, 0, 1))
        and np.allclose(projection[~pinhole], 0)
        and np.isclose(projection[3, 2], 1)
        and abs(projection[0, 0] * projection[1, 1]) > 0
    )
    if not fits:
        raise BadInputError(
            "seeing needs a pinhole camera that looks along its z axis, with its axis through the "
            "middle of the picture; these view and projection matrices are of another one"
        )
    height, width = ids.shape
    x = (2 * (np.arange(width) + 0.5) / width - 1) / projection[0, 0]
    y = (1 - 2 * (np.arange(height) + 0.5) / height) / projection[1, 1]
    rays = np.ones((height, width, 3))
    rays[..., 0], rays[..., 1] = x[None, :], y[:, None]
    return SeenFrame(
        np.asarray(ids), np.asarray(depth, np.float64), -rotation.T @ view[:3, 3], rays @ rotation
    )


def floor_height(picture: SeenFrame) -> float:
    """Return the height of the floor in metres: the median of scenery that is seen near 0.

    It is 0 if almost nothing is seen there.
    """
    seen = (picture.ids == SCENERY_ID) & np.isfinite(picture.depth)
    heights = picture.points(seen)[:, 2]
    near = heights[np.abs(heights) < FLOOR_RANGE]
    return round(float(np.median(near)), 4) + 0.0 if len(near) >= 100 else 0.0


def _grown(mask: Mask, pixels: int) -> Mask:
    """Return a mask with all pixels that are within ``pixels`` rows and columns of it."""
    grown = mask.copy()
    for _ in range(pixels):
        wide = grown.copy()
        wide[:, 1:] |= grown[:, :-1]
        wide[:, :-1] |= grown[:, 1:]
        grown = wide.copy()
        grown[1:] |= wide[:-1]
        grown[:-1] |= wide[1:]
    return grown


def _drawn(
    rng: np.random.Generator, masks: tuple[Mask, Mask], counts: tuple[int, int]
) -> NDArray[np.int64]:
    """Return numbers of pixels of two masks, mixed; the second fills up what the first lacks."""
    first, second = (rng.permutation(np.flatnonzero(mask)) for mask in masks)
    first = first[: counts[0]]
    second = second[: sum(counts) - len(first)]
    return rng.permutation(np.concatenate([first, second]))
