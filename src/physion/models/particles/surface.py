"""Particles on the surface of a shape, evenly spaced, corners first."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.numerics.linear_algebra import norm
from physion.scenes.scene import Vec3
from physion.scenes.shapes.primitives import shape

F64 = NDArray[np.float64]

_FINE = 3
"""Candidates per spacing along the side of a face."""
_MAX_CANDIDATES = 2**18
"""Largest number of candidates on a shape: their distances must fit in time."""


def surface_points(shape_name: str, scale: Vec3, spacing: float, limit: int) -> F64:
    """Return points (P, 3) on the surface of a shape, metres in the body's frame.

    They are chosen one after the other, each the candidate farthest from those before, beginning
    with the one that is farthest from the middle of the bounds, until every candidate has one
    closer than ``spacing`` (Gonzalez 1985) or there are ``limit`` points. Corners are therefore
    among the first, and a limit thins the points evenly.

    Parameters
    ----------
    shape_name, scale
        Shape and its factors along x, y, z.
    spacing : float
        Metres; larger than 0.
    limit : int
        Largest number of points, at least 1.

    Raises
    ------
    UnknownNameError
        If there is no such shape.
    BadInputError
        If the spacing or limit is too small, or the shape has no faces.

    References
    ----------
    T. F. Gonzalez, Clustering to minimize the maximum intercluster distance, Theoretical Computer
    Science 38, 1985.
    """
    if not spacing > 0 or limit < 1:
        raise BadInputError(
            f"particles need a spacing above 0 m and a limit of at least 1, not {spacing} m and "
            f"{limit}"
        )
    x, y, z = (float(value) for value in scale)
    return _spread(shape_name, (x, y, z), float(spacing), int(limit)).copy()


@lru_cache(maxsize=1024)
def _spread(shape_name: str, scale: Vec3, spacing: float, limit: int) -> F64:
    candidates = _candidates(shape_name, scale, spacing)
    middle = (candidates.min(axis=0) + candidates.max(axis=0)) / 2
    chosen = [int(np.argmax(norm(candidates - middle)))]
    nearest = norm(candidates - candidates[chosen[0]])
    while len(chosen) < limit:
        farthest = int(np.argmax(nearest))
        if nearest[farthest] < spacing:
            break
        chosen.append(farthest)
        nearest = np.minimum(nearest, norm(candidates - candidates[farthest]))
    return candidates[chosen]


def _candidates(shape_name: str, scale: Vec3, spacing: float) -> F64:
    """Return a fine triangular grid of points on every face; corners of faces are among them."""
    mesh = shape(shape_name).mesh.moved(scale)
    if len(mesh.faces) == 0:
        raise BadInputError(f"shape {shape_name!r} has no faces on which particles could lie")
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    longest = np.max([norm(b - a), norm(c - b), norm(a - c)], axis=0)
    parts = np.maximum(np.ceil(_FINE * longest / spacing), 1).astype(int)
    count = int(np.sum((parts + 1) * (parts + 2) // 2))
    if count > _MAX_CANDIDATES:
        raise BadInputError(
            f"{shape_name!r} needs {count} candidates for particles at a spacing of {spacing} m; "
            f"at most {_MAX_CANDIDATES}: use a larger spacing"
        )
    groups = [mesh.vertices]
    for n in np.unique(parts):
        rows = parts == n
        i, j = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
        u, v = (i / n)[None, :, None], (j / n)[None, :, None]
        start = a[rows][:, None]
        points = start + u * (b[rows][:, None] - start) + v * (c[rows][:, None] - start)
        groups.append(points.reshape(-1, 3))
    return np.unique(np.round(np.concatenate(groups), 6), axis=0)
