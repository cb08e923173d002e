"""Build closed triangle meshes: turned on a lathe, extruded, or as the hull of points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

from physion.numerics.elementary import cos, sin
from physion.numerics.linear_algebra import apply, dot, ordered_sum, outer

Points = NDArray[np.float64]
Faces = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in a shape's own frame, z up.

    - ``vertices`` (V, 3): metres at unit scale.
    - ``faces`` (F, 3): indices, counter-clockwise as seen from outside.
    - ``smooth``: crease angle in radians. Faces that meet at less than this angle are shaded as
      one curved surface; 0 shades every face flat.
    """

    vertices: Points
    faces: Faces
    smooth: float = 0.0

    @property
    def bounds(self) -> Points:
        """(2, 3): smallest and largest coordinates."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def moved(self, scale: ArrayLike = 1.0, offset: ArrayLike = 0.0) -> Mesh:
        """The mesh scaled (factors above zero) along its axes, then shifted by ``offset``."""
        return Mesh(self.vertices * np.asarray(scale) + np.asarray(offset), self.faces, self.smooth)

    def rotated(self, matrix: Points) -> Mesh:
        """The mesh turned by the rotation ``matrix`` (3, 3)."""
        return Mesh(apply(matrix, self.vertices), self.faces, self.smooth)


def hull(points: ArrayLike, smooth: float = 0.0) -> Mesh:
    """The convex hull of ``points`` (K, 3), with outward faces."""
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
    """Turn a profile of (radius, height) points about the z axis.

    The solid lies to the left of the profile as it is walked, so an outer wall is walked upwards.
    An open profile starts and ends on the axis (radius 0); a ``closed`` one is a loop off the axis.
    ``phase`` turns the first of ``segments`` corners away from the x axis (radians).
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
    """A convex polygon (K, 2), counter-clockwise, pulled from ``bottom`` to ``top`` along z."""
    base = np.asarray(polygon, np.float64)
    low = np.column_stack([base, np.full(len(base), bottom)])
    high = np.column_stack([base, np.full(len(base), top)])
    return hull(np.concatenate([low, high]))


def box(center: ArrayLike, half: ArrayLike) -> Mesh:
    """An axis-aligned box by its centre and half sizes."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    return hull(signs).moved(half, center)


def merge(meshes: Iterable[Mesh], smooth: float | None = None) -> Mesh:
    """Several closed meshes as one; they may overlap. The first one's crease angle is kept."""
    parts = list(meshes)
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=True)]
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate(faces).astype(np.int32),
        parts[0].smooth if smooth is None else smooth,
    )


def solid_properties(mesh: Mesh) -> tuple[float, Points, Points]:
    """Volume, centre of mass (3,), and inertia tensor (3, 3) about it for a mass of 1 kg.

    The mesh is closed and filled evenly. Sums over the tetrahedra from the origin to every face,
    so that the result is exact (Tonon, Journal of Mathematics and Statistics 1, 2005).
    """
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    volumes = dot(a, np.cross(b, c)) / 6.0
    volume = float(ordered_sum(volumes))
    total = a + b + c
    center = ordered_sum(volumes[:, None] * total, axis=0) / (4.0 * volume)
    second = np.zeros((3, 3))
    for point in (a, b, c, total):
        second += ordered_sum(outer(volumes[:, None] * point, point), axis=0)
    second /= 20.0 * volume
    return volume, center, inertia_from_second_moment(second - outer(center, center))


def inertia_from_second_moment(second: Points) -> Points:
    """Inertia tensor (3, 3) of a unit mass with the second moments ``second`` about its centre."""
    trace = second[0, 0] + second[1, 1] + second[2, 2]
    return np.asarray(trace * np.eye(3) - second)
