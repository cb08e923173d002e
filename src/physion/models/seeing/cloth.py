"""A sheet of cloth that is released flat in the first frame.

Points of a sheet that is level at height z have that height, however it is seen. A ray o + D v
meets the plane at D_z = (z - o_z) / v_z: it is on the sheet where the mask is, and misses it where
something farther away is seen. The sheet is a square along x and y, as in our own presets, with the
larger extent of its points as its side. Where less of the other extent is seen, since something
hides an edge or the picture ends, it lies where it covers the fewest rays that miss it.

Stiffness cannot be seen while a sheet falls. It is drawn as in our own presets, from 0 to 1
(`with_stiffness`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from physion.core.seeds import generator
from physion.models.seeing.pixels import LEAST_PIXELS, SeenFrame
from physion.scenes.scenarios.drape import VERTEX_SPACING
from physion.scenes.scene import Cloth, Look

LEVEL, MOST = 0.004, 0.7
"""Metres within which points of a flat sheet have one height, and the least fraction of them:
something may reach through it."""
ABOVE, WIDE = 0.3, 0.5
"""Least height of a sheet above the floor, and the least extents that are seen, metres."""
FALLEN = 0.01
"""Metres by which it has fallen in the second frame."""
STIFFNESSES = 10
"""Stiffnesses that are drawn."""
PLACES = 21
"""Places along an axis at which a partly hidden sheet is tried."""


def sheet_of(
    number: int, first: SeenFrame, second: SeenFrame, floor: float, look: Look
) -> Cloth | None:
    """Return an object as a cloth, or None if it is not a level sheet in the air that falls.

    ``first`` and ``second``: the first two frames that are seen.
    """
    mask, later = first.ids == number, second.ids == number
    if min(np.count_nonzero(mask), np.count_nonzero(later)) < LEAST_PIXELS:
        return None
    points = first.points(mask)
    height = float(np.median(points[:, 2]))
    level = np.abs(points[:, 2] - height) < LEVEL
    if level.mean() < MOST or height < floor + ABOVE:
        return None
    low, high = points[level, :2].min(axis=0), points[level, :2].max(axis=0)
    fallen = height - float(np.median(second.points(later)[:, 2]))
    if (high - low).min() < WIDE or fallen < FALLEN:
        return None
    side = float((high - low).max())
    vectors = first.vectors.reshape(-1, 3)
    along = (height - first.origin[2]) / np.where(vectors[:, 2] == 0, np.nan, vectors[:, 2])
    missing = (along > 0) & (first.depth.reshape(-1) > along) & ~mask.reshape(-1)
    free = (first.origin + vectors[missing] * along[missing, None])[:, :2]
    tried = [
        np.linspace(end - side, start, PLACES) + side / 2
        for start, end in zip(low, high, strict=True)
    ]
    centers = np.stack(np.meshgrid(*tried, indexing="ij"), axis=-1).reshape(-1, 2)
    covered = [np.count_nonzero((np.abs(free - c) < side / 2).all(axis=1)) for c in centers]
    x, y = centers[np.equal(covered, min(covered))].mean(axis=0)
    return Cloth(
        str(number),
        (float(x), float(y), height),
        (side, side, 0.0),
        resolution=max(2, round(side / VERTEX_SPACING) + 1),
        look=look,
    )


def with_stiffness(cloths: Sequence[Cloth]) -> list[tuple[Cloth, ...]]:
    """Return the cloths with each of `STIFFNESSES` triples of stretch, bend and tether.

    Each of the three takes the middle of every tenth of 0 to 1 once, in a random order.
    """
    rng = generator("seeing", "stiffness of a cloth")
    middles = (np.arange(STIFFNESSES) + 0.5) / STIFFNESSES
    drawn = np.stack([rng.permutation(middles) for _ in range(3)], axis=1)
    return [
        tuple(replace(c, stretch=float(a), bend=float(b), tether=float(t)) for c in cloths)
        for a, b, t in drawn
    ]
