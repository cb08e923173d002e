"""Particles on the surface of a shape, evenly spaced, corners first."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.numerics.linear_algebra import cross, norm
from physion.scenes.scene import Vec3
from physion.scenes.shapes.primitives import shape

F64 = NDArray[np.float64]

_FINE = 3
"""Candidates per distance of neighbouring points."""
_KEPT = 8192
"""Shapes whose points are kept, about 5 kB each: several models ask for those of all trials in
turn."""


def surface_points(shape_name: str, scale: Vec3, spacing: float, limit: int) -> tuple[F64, F64]:
    """Return points (P, 3) on the surface of a shape and unit normals (P, 3), in the body's frame.

    They are chosen one after the other, each the candidate farthest from those before, until every
    candidate has one closer than ``spacing`` (Gonzalez 1985) or there are ``limit`` points, so that
    a limit thins them evenly. The corners of the mesh are the first candidates, beginning with the
    one farthest from the middle of the bounds; then follow points on edges and faces. Where faces
    meet, the normal is the mean of theirs.

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
        If the spacing is not above 0, the limit below 1, or the shape has no faces.

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
    points, normals = _spread(shape_name, (x, y, z), float(spacing), int(limit))
    return points.copy(), normals.copy()


@lru_cache(maxsize=_KEPT)
def _spread(shape_name: str, scale: Vec3, spacing: float, limit: int) -> tuple[F64, F64]:
    candidates, normals, corner = _candidates(shape_name, scale, spacing, limit)
    middle = (candidates.min(axis=0) + candidates.max(axis=0)) / 2
    chosen: list[int] = []
    nearest = np.full(len(candidates), np.inf)
    first = norm(candidates - middle)
    for allowed in (corner, np.ones_like(corner)):
        while len(chosen) < limit:
            farthest = int(np.argmax(np.where(allowed, nearest if chosen else first, -1.0)))
            if nearest[farthest] < spacing:
                break
            chosen.append(farthest)
            nearest = np.minimum(nearest, norm(candidates - candidates[farthest]))
    return candidates[chosen], normals[chosen]


def _candidates(
    shape_name: str, scale: Vec3, spacing: float, limit: int
) -> tuple[F64, F64, NDArray[np.bool_]]:
    """Return points on the surface, their normals, and which are corners of the mesh.

    The others are the middles of sides of split faces.

    The longest side of every face is halved until it is at most a third of the spacing, or of the
    distance that ``limit`` points on the surface have, sqrt(area / limit).
    """
    mesh = shape(shape_name).mesh.moved(scale)
    if len(mesh.faces) == 0:
        raise BadInputError(f"shape {shape_name!r} has no faces on which particles could lie")
    faces = mesh.vertices[mesh.faces]
    areas = cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]) / 2
    total = float(np.sum(norm(areas)))
    longest = max(spacing, math.sqrt(total / limit)) / _FINE
    points, normals = [faces.reshape(-1, 3)], [np.repeat(areas, 3, axis=0)]
    while len(faces):
        sides = np.stack([norm(faces[:, (k + 1) % 3] - faces[:, k]) for k in range(3)], axis=1)
        split = sides.max(axis=1) > longest
        faces, areas, first = faces[split], areas[split], np.argmax(sides[split], axis=1)
        rows = np.arange(len(faces))
        a, b, c = (faces[rows, (first + k) % 3] for k in range(3))
        middle = (a + b) / 2
        points.append(middle)
        normals.append(areas)
        faces = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        areas = np.concatenate([areas, areas]) / 2
    rounded = np.round(np.concatenate(points), 6)
    unique, place = np.unique(rounded, axis=0, return_inverse=True)
    sums = np.zeros_like(unique)
    np.add.at(sums, place.ravel(), np.concatenate(normals))
    outward: F64 = sums / np.maximum(norm(sums), 1e-12)[:, None]
    corner = np.zeros(len(unique), np.bool_)
    corner[place.ravel()[: len(points[0])]] = True
    return np.asarray(unique, np.float64), outward, corner
