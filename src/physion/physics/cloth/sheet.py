"""Vertices, triangles and springs of an undeformed cloth."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.numerics.linear_algebra import norm, unit
from physion.numerics.rotations import rotate_vectors
from physion.physics.cloth.solver import Springs
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


def sheet_springs(cloth: Cloth) -> Springs:
    """Return the springs of a cloth, as Flex makes them from its triangles.

    Every edge has the stiffness ``stretch``, the two corners opposite every inner edge ``bend``.
    ``tether`` has no effect: Flex attaches tethers to fixed particles, and there are none.
    """
    edges, across = _spring_pairs(cloth.resolution)
    ends = np.concatenate([edges, across]) if cloth.bend > 0 else edges
    vertices = sheet_vertices(cloth)
    lengths = norm(vertices[ends[:, 0]] - vertices[ends[:, 1]])
    stiffness = np.full(len(ends), cloth.stretch)
    stiffness[len(edges) :] = cloth.bend
    return Springs(ends.astype(np.int64), lengths, stiffness)


@lru_cache(maxsize=8)
def _spring_pairs(resolution: int) -> tuple[Indices, Indices]:
    """Return the edges (E, 2) of the sheet, and the corners (B, 2) opposite its inner edges."""
    triangles = sheet_triangles(resolution)
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    corners = np.concatenate([triangles[:, 2], triangles[:, 0], triangles[:, 1]])
    order = np.lexsort((sides.max(axis=1), sides.min(axis=1)))
    sides, corners = np.sort(sides[order], axis=1), corners[order]
    twice = np.flatnonzero((sides[1:] == sides[:-1]).all(axis=1))
    first = np.ones(len(sides), np.bool_)
    first[twice + 1] = False
    return sides[first], np.stack([corners[twice], corners[twice + 1]], axis=1)
