"""Vertices, triangles and springs of an undeformed cloth."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.numerics.linear_algebra import norm, unit
from physion.numerics.rotations import rotate_vectors
from physion.physics.cloth.springs import SheetSprings
from physion.scenes.scene import Cloth

Points = NDArray[np.float64]
Indices = NDArray[np.int32]


def sheet_vertices(cloth: Cloth) -> Points:
    """Return the vertices (V, 3) of an undeformed cloth in metres, world.

    They come row by row along x, then y: the first ``resolution`` vertices have the lowest x.
    """
    if cloth.resolution < 2:
        raise BadInputError(
            f"cloth {cloth.name!r} needs at least 2 vertices a side, not {cloth.resolution}"
        )
    along_x, along_y = (np.linspace(-s / 2, s / 2, cloth.resolution) for s in cloth.size[:2])
    x, y = np.meshgrid(along_x, along_y, indexing="ij")
    flat = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    return np.asarray(rotate_vectors(unit(cloth.rotation), flat) + np.asarray(cloth.position))


@lru_cache(maxsize=8)
def sheet_triangles(resolution: int) -> Indices:
    """Return the triangles (T, 3) of a sheet: two for each square, along the same diagonal."""
    index = np.arange(resolution**2, dtype=np.int32).reshape(resolution, resolution)
    a, b, c, d = (index[x, y].ravel() for x, y in _CORNERS)
    return np.stack([np.stack([a, b, d], 1), np.stack([a, d, c], 1)], 1).reshape(-1, 3)


_CORNERS = (
    (slice(None, -1), slice(None, -1)),
    (slice(1, None), slice(None, -1)),
    (slice(None, -1), slice(1, None)),
    (slice(1, None), slice(1, None)),
)


def sheet_springs(cloth: Cloth) -> SheetSprings:
    """Return the springs of a cloth, as Flex makes them from its triangles.

    Every edge has the stiffness ``stretch``, the two corners opposite every inner edge ``bend``.
    ``tether`` has no effect: Flex attaches tethers to fixed particles, and there are none.
    """
    rows = cloth.resolution
    steps = np.array(EDGES + (ACROSS if cloth.bend > 0 else ()), np.int64)
    x, y = np.divmod(np.arange(rows**2), rows)
    to_x, to_y = x + steps[:, :1], y + steps[:, 1:]
    joined = (to_x < rows) & (to_y >= 0) & (to_y < rows)
    sides = np.asarray(cloth.size[:2]) / (rows - 1)
    stiffness = np.where(np.arange(len(steps)) < len(EDGES), cloth.stretch, cloth.bend)
    offsets = steps[:, 0] * rows + steps[:, 1]
    degree = np.count_nonzero(joined, axis=0).astype(np.float64)
    for family, offset in zip(joined, offsets, strict=True):
        degree[offset:] += family[: len(degree) - offset]
    return SheetSprings(
        offsets, norm(steps * sides), np.where(joined, stiffness[:, None] / 2, 0.0), degree
    )


EDGES = ((1, 0), (0, 1), (1, 1))
"""Steps along x and y between the ends of the edges of `sheet_triangles`."""
ACROSS = ((1, -1), (1, 2), (2, 1))
"""Steps between the two corners opposite an inner edge: the diagonal, and the sides of squares."""
