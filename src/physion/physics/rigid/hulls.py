"""Convex hulls that stand for a body in collisions.

The official simulator uses hulls of meshes for all shapes, balls and cylinders included. A hull
rolls and slides unlike a smooth ball, so ours are hulls as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import arctan2
from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import cross, dot, ordered_mean, unit
from physion.scenes.scene import Vec3
from physion.scenes.shapes.meshes import revolve
from physion.scenes.shapes.primitives import ConvexPiece, ball_mesh, shape

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BALL_SEGMENTS = 16
"""Meridians of a ball's hull, with half as many bands. With 24, balls roll on for longer than in
the recorded trials; with 12 they stop too soon. (PhysX allows 255 corners.)"""
CYLINDER_SIDES = 16
"""Sides of a cylinder's hull. With 32, as drawn, outcomes, contact frames and final positions of
the recorded trials are all predicted worse, with 24 by half as much
(benchmarks/results/calibration.md)."""
SAME_FACE_COSINE = 1 - 1e-7
SAME_FACE_OFFSET = 1e-5
"""Triangles of a hull are one face where their normals agree by this cosine, and their offsets to
this fraction of the hull's size: what rounding leaves of a plane."""
ACROSS = 1e-7
"""A plane whose normal has no larger component along a direction does not cut it."""
CACHED_HULLS = 512
"""Scaled shapes whose hulls are kept in memory."""


@dataclass(frozen=True, eq=False)
class Hull:
    """Convex hull in the frame of its body.

    - ``corners`` (K, 3): metres. ``center`` (3,): their mean.
    - ``faces``: for each face its corner numbers, counterclockwise from outside.
    - ``inner_box`` (3,): half extents in metres of a box round ``center`` inside the hull.
    - ``inradius``: metres: the least scale times the radius of a ball round ``center`` inside the
      hull at unit scale, as PhysX 4 takes it.
    """

    corners: F64
    center: F64
    faces: tuple[I64, ...]
    inner_box: F64
    inradius: float


@lru_cache(maxsize=CACHED_HULLS)
def collision_hulls(name: str, scale: Vec3) -> tuple[Hull, ...]:
    """Return the hulls of all convex pieces of the shape ``name``, scaled, in the body's frame."""
    hulls = []
    for corners, faces, inradius in _unit_hulls(name):
        scaled = corners * np.asarray(scale)
        center = ordered_mean(scaled, axis=0)
        box = inner_box(scaled, faces, center)
        hulls.append(Hull(scaled, center, faces, box, float(min(scale)) * inradius))
    return tuple(hulls)


@cache
def _unit_hulls(name: str) -> tuple[tuple[F64, tuple[I64, ...], float], ...]:
    """Return corners, faces and the radius of an inscribed ball of the hulls at unit scale.

    Points inside a face, such as the middle of a cylinder's ends, are no corners: a body would rest
    on them in place of its rim.
    """
    hulls = []
    for piece in shape(name).pieces:
        points = _corners(piece)
        faces = hull_faces(points)
        used = np.unique(np.concatenate(faces))
        corners = points[used]
        kept = tuple(np.searchsorted(used, face) for face in faces)
        hulls.append((corners, kept, inscribed_radius(corners, kept)))
    return tuple(hulls)


def _corners(piece: ConvexPiece) -> F64:
    """Return the corners (K, 3) of a piece at unit scale."""
    if piece.kind == "convex":
        return piece.vertices
    if piece.kind == "sphere":
        return ball_mesh(piece.half[0], BALL_SEGMENTS).moved(offset=piece.center).vertices
    if piece.kind == "cylinder":
        outline = [(0.0, -1.0), (1.0, -1.0), (1.0, 1.0), (0.0, 1.0)]
        solid = revolve(outline, CYLINDER_SIDES).moved(piece.half).rotated(piece.rotation)
        return solid.moved(offset=piece.center).vertices
    return piece.mesh.vertices


def hull_faces(corners: F64) -> list[I64]:
    """Return the corner numbers of every flat face of a convex hull, in order round the face.

    ``corners`` (K, 3) are points in metres, on the hull or within its faces.
    """
    # Imported late: what only reads scenes and trials starts faster.
    from scipy.spatial import ConvexHull

    hull = ConvexHull(corners)
    size = float(np.ptp(corners, axis=0).max())
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    face_of = np.full(len(normals), -1)
    faces: list[I64] = []
    for t in range(len(normals)):
        if face_of[t] >= 0:
            continue
        same = (dot(normals, normals[t]) > SAME_FACE_COSINE) & (
            np.abs(offsets - offsets[t]) < SAME_FACE_OFFSET * size
        )
        # Triangles of one plane are one face.
        same &= face_of < 0
        face_of[same] = len(faces)
        used = np.unique(hull.simplices[same])
        points = corners[used] - ordered_mean(corners[used], axis=0)
        normal = normals[t]
        first = unit(points[0] - normal * dot(points[0], normal))
        second = cross(normal, first)
        angle = arctan2(dot(points, second), dot(points, first))
        faces.append(used[np.argsort(angle, kind="stable")].astype(np.int64))
    return faces


@kernel
def face_planes(vertices: F64, loops: I64, first_loop: I64) -> F64:
    """Return the planes (F, 4) of faces: outward unit normal n, and d in n . p = d.

    ``loops`` (L,) are rows of ``vertices`` (V, 3), those of face f from ``first_loop[f]`` on,
    counterclockwise from outside. The normal is the sum of the cross products of a fan of triangles
    from the face's first corner.
    """
    planes = np.zeros((len(first_loop) - 1, 4))
    for f in range(len(planes)):
        start, stop = first_loop[f], first_loop[f + 1]
        a = loops[start]
        x = y = z = 0.0
        for k in range(start + 1, stop - 1):
            b, c = loops[k], loops[k + 1]
            ux, uy, uz = (
                vertices[b, 0] - vertices[a, 0],
                vertices[b, 1] - vertices[a, 1],
                vertices[b, 2] - vertices[a, 2],
            )
            wx, wy, wz = (
                vertices[c, 0] - vertices[a, 0],
                vertices[c, 1] - vertices[a, 1],
                vertices[c, 2] - vertices[a, 2],
            )
            x += uy * wz - uz * wy
            y += uz * wx - ux * wz
            z += ux * wy - uy * wx
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        planes[f, 0], planes[f, 1], planes[f, 2] = x, y, z
        planes[f, 3] = x * vertices[a, 0] + y * vertices[a, 1] + z * vertices[a, 2]
    return planes


def inscribed_radius(corners: F64, faces: tuple[I64, ...]) -> float:
    """Return the radius in metres of the ball round the mean of the corners inside a hull."""
    first_loop = np.cumsum([0, *(len(face) for face in faces)]).astype(np.int64)
    planes = face_planes(corners, np.concatenate(faces), first_loop)
    center = ordered_mean(corners, axis=0)
    return float((planes[:, 3] - dot(planes[:, :3], center)).min())


def inner_box(corners: F64, faces: tuple[I64, ...], center: F64) -> F64:
    """Return half extents (3,) in metres of a box round ``center`` inside a hull; see `Hull`."""
    first_loop = np.cumsum([0, *(len(face) for face in faces)]).astype(np.int64)
    planes = face_planes(corners, np.concatenate(faces), first_loop)
    return _inner_box(planes, center, np.ptp(corners, axis=0))


# With r the radius of the ball round the centre that fits in, the box starts as the cube in that
# ball, half a side r / sqrt 3; it is lengthened along the hull's longest axis until it meets a
# face, then widened alike along the other two. As PhysX 4 does when it cooks a mesh
# (``ComputeInternalExtent``): a manifold's tolerances depend on it.


@kernel
def _inner_box(planes: F64, center: F64, size: F64) -> F64:
    """Return the half extents of the box from the hull's planes (F, 4) and its size (3,)."""
    distance = np.zeros(len(planes))
    least = np.inf
    for f in range(len(planes)):
        distance[f] = planes[f, 3]
        for k in range(3):
            distance[f] -= planes[f, k] * center[k]
        least = min(least, abs(distance[f]))
    least /= np.sqrt(3.0)
    longest = int(np.argmax(size))
    i, j = (longest + 1) % 3, (longest + 2) % 3
    if size[i] < size[j]:
        i, j = j, i
    reach = width = np.inf
    for f in range(len(planes)):
        if abs(planes[f, longest]) <= ACROSS:
            continue
        for corner in range(4):
            along_i = least if corner % 2 else -least
            along_j = least if corner // 2 else -least
            side = along_i * planes[f, i] + along_j * planes[f, j]
            reach = min(reach, max(abs((distance[f] - side) / planes[f, longest]), least))
    for f in range(len(planes)):
        for diagonal in (-1.0, 1.0):
            along = planes[f, i] + diagonal * planes[f, j]
            if abs(along) <= ACROSS:
                continue
            for end in (-reach, reach):
                left = distance[f] - end * planes[f, longest]
                width = min(width, max(abs(left / along), least))
    half = np.zeros(3)
    half[longest], half[i], half[j] = reach, width, width
    return half
