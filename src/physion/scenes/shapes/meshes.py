"""Closed triangle meshes: revolved, extruded and convex ones; mass properties."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.numerics.elementary import cos, sin
from physion.numerics.linear_algebra import apply, dot, ordered_sum, outer

Points = NDArray[np.float64]
Faces = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh in the coordinates of a shape, z up.

    - ``vertices`` (V, 3): metres at unit scale.
    - ``faces`` (F, 3): indices, counter-clockwise as seen from outside.
    - ``smooth``: crease angle in radians. Faces that meet at a smaller angle are shaded smoothly; 0
      shades every face flat.
    """

    vertices: Points
    faces: Faces
    smooth: float = 0.0

    @property
    def bounds(self) -> Points:
        """Return the smallest and largest coordinates (2, 3)."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def moved(self, scale: ArrayLike = 1.0, offset: ArrayLike = 0.0) -> Mesh:
        """Return the mesh scaled (by factors above zero), then shifted by ``offset``."""
        return Mesh(self.vertices * np.asarray(scale) + np.asarray(offset), self.faces, self.smooth)

    def rotated(self, matrix: Points) -> Mesh:
        """Return the mesh rotated by ``matrix`` (3, 3)."""
        return Mesh(apply(matrix, self.vertices), self.faces, self.smooth)


def hull(points: ArrayLike, smooth: float = 0.0) -> Mesh:
    """Return the convex hull of ``points`` (K, 3), with faces oriented outwards."""
    # Imported late: what only reads scenes and trials starts faster.
    from scipy.spatial import ConvexHull

    cloud = np.asarray(points, np.float64)
    convex = ConvexHull(cloud)
    faces = convex.simplices.astype(np.int32)
    corners = cloud[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = dot(normals, convex.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    used, renumbered = np.unique(faces, return_inverse=True)
    return Mesh(cloud[used], renumbered.reshape(-1, 3).astype(np.int32), smooth)


def revolve(
    profile: Sequence[tuple[float, float]],
    segments: int,
    *,
    closed: bool = False,
    phase: float = 0.0,
    smooth: float = 0.0,
) -> Mesh:
    """Return the surface of revolution of a profile about the z axis.

    Parameters
    ----------
    profile
        Points (radius, height). The solid lies to the left of the direction of the profile, so that
        an outer wall is given from the bottom up. An open profile starts and ends at radius 0.
    segments
        Number of corners of the circle.
    closed
        The profile is a loop that does not touch the axis, as for a torus.
    phase
        Angle of the first corner from the x axis, radians.
    smooth
        Crease angle of the mesh (`Mesh`).
    """
    angles = phase + 2 * math.pi * np.arange(segments) / segments
    circle = np.stack([cos(angles), sin(angles)], axis=1)
    vertices: list[Points] = []
    rings: list[NDArray[np.int64]] = []
    count = 0
    for radius, height in profile:
        size = segments if radius > 0 else 1
        ring = np.full((size, 3), height, np.float64)
        ring[:, :2] = circle[:size] * radius
        vertices.append(ring)
        rings.append(count + np.arange(segments) % size)
        count += size
    faces: list[NDArray[np.int64]] = []
    for lower, upper in zip(rings, rings[1:] + (rings[:1] if closed else []), strict=False):
        ahead, above = np.roll(lower, -1), np.roll(upper, -1)
        if lower[0] != lower[-1]:
            faces.append(np.stack([lower, ahead, above], axis=1))
        if upper[0] != upper[-1]:
            faces.append(np.stack([lower, above, upper], axis=1))
    return Mesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32), smooth)


def extrude(polygon: ArrayLike, bottom: float, top: float) -> Mesh:
    """Return a prism: a convex polygon (K, 2), counter-clockwise, from z ``bottom`` to ``top``."""
    base = np.asarray(polygon, np.float64)
    low = np.column_stack([base, np.full(len(base), bottom)])
    high = np.column_stack([base, np.full(len(base), top)])
    return hull(np.concatenate([low, high]))


def box(center: ArrayLike, half: ArrayLike) -> Mesh:
    """Return an axis-aligned box with this centre and these half sizes."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    return hull(signs).moved(half, center)


def merge(meshes: Iterable[Mesh], smooth: float | None = None) -> Mesh:
    """Join closed meshes, which may overlap. The crease angle is by default as in the first."""
    parts = list(meshes)
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=True)]
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate(faces).astype(np.int32),
        parts[0].smooth if smooth is None else smooth,
    )


def solid_moments(triangles: Points) -> tuple[float, Points, Points]:
    """Return the integrals of 1, x (3,) and x x^T (3, 3) over the solid inside a closed surface.

    ``triangles`` (F, 3, 3) are its faces in metres, counterclockwise from outside. The integrals
    are exact sums over the tetrahedra from the origin to every face: with the corners a, b, c of a
    face and the signed volume V = a . (b x c) / 6 these are V, V (a + b + c) / 4 and
    V (a a^T + b b^T + c c^T + s s^T) / 20 with s = a + b + c.
    """
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    volumes = dot(a, np.cross(b, c)) / 6.0
    sums = a + b + c
    squares = ordered_sum(outer(triangles, triangles), axis=1) + outer(sums, sums)
    return (
        float(ordered_sum(volumes)),
        ordered_sum(volumes[:, None] * sums / 4.0, axis=0),
        ordered_sum(volumes[:, None, None] * squares / 20.0, axis=0),
    )


def solid_properties(mesh: Mesh) -> tuple[float, Points]:
    """Return the volume and the centroid (3,) of the solid inside a closed mesh.

    The mass properties of bodies come from their collision pieces: see
    `physion.physics.rigid.bodies`.
    """
    volume, first, _ = solid_moments(mesh.vertices[mesh.faces])
    return volume, first / volume
