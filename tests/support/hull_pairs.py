"""Pairs of convex hulls for tests of collision detection, and their distance by other means."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import ConvexHull

from physion.numerics.rotations import rotation_matrices
from physion.physics.rigid.bodies import face_planes, hull_faces
from physion.physics.rigid.collision.closest_points import (
    CLOSE,
    OVERLAPPING,
    Simplex,
    closest_points,
    new_simplex,
)
from physion.physics.rigid.collision.faces import Hulls
from physion.physics.rigid.collision.penetration import new_polytope, penetration

F64 = NDArray[np.float64]
UPRIGHT = np.eye(3)
NOWHERE = np.zeros(3)


def box(x: float, y: float | None = None, z: float | None = None) -> F64:
    """Return the corners (8, 3) of a box of these half extents about the origin."""
    half = np.array([x, x if y is None else y, x if z is None else z])
    return np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * half


def random_rotation(rng: np.random.Generator) -> F64:
    """Return a rotation matrix (3, 3)."""
    q = rng.normal(size=4)
    return np.asarray(rotation_matrices(q / np.linalg.norm(q)))


def random_hull(rng: np.random.Generator, flattest: float = 1.0) -> F64:
    """Return the corners (K, 3) of a random hull about 1 m wide, flattened by up to a factor."""
    points = rng.normal(size=(rng.integers(4, 24), 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= 0.5 * flattest ** rng.uniform(0, 1, 3)
    return np.ascontiguousarray(points[ConvexHull(points).vertices])


def hulls_of(*corners: F64, margin: float = 0.05, tolerance: float = 0.02) -> Hulls:
    """Return the record of these hulls, each in a frame of its own."""
    first = np.cumsum([0, *(len(c) for c in corners)]).astype(np.int64)
    faces = [[f + start for f in hull_faces(c)] for c, start in zip(corners, first, strict=False)]
    loops = [loop for hull in faces for loop in hull]
    first_loop = np.cumsum([0, *(len(loop) for loop in loops)]).astype(np.int64)
    vertices, flat = np.concatenate(corners), np.concatenate(loops)
    bounds = [
        np.concatenate([(c.min(0) + c.max(0)) / 2, (c.max(0) - c.min(0)) / 2]) for c in corners
    ]
    radius = np.array([np.linalg.norm(c, axis=1).max() for c in corners])
    return Hulls(
        vertices=vertices,
        first_vertex=first,
        loops=flat,
        first_loop=first_loop,
        first_face=np.cumsum([0, *(len(hull) for hull in faces)]).astype(np.int64),
        plane=face_planes(vertices, flat, first_loop),
        margin=np.full(len(corners), margin),
        tolerance=np.full(len(corners), tolerance),
        radius=radius,
        extent=radius,
        box=np.array(bounds),
    )


class Found(NamedTuple):
    """What the search for closest points says: all in the frame of B."""

    result: int
    distance: float
    direction: F64
    point_a: F64
    point_b: F64


def search(
    a: F64,
    b: F64,
    rot: F64 = UPRIGHT,
    shift: F64 = NOWHERE,
    reach: float = np.inf,
    simplex: Simplex | None = None,
    size: int = 0,
) -> Found:
    """Return closest points of hulls with corners ``a``, ``b``; A is moved by ``rot``, ``shift``.

    Where the hulls overlap, the distance is minus the depth.
    """
    vertices = np.ascontiguousarray(np.concatenate([a, b]))
    span = np.array([0, len(a), len(a), len(a) + len(b)], np.int64)
    simplex = new_simplex() if simplex is None else simplex
    rot, shift = np.ascontiguousarray(rot), np.asarray(shift, np.float64)
    result, size, distance = closest_points(vertices, span, rot, shift, reach, simplex, size)
    if result == OVERLAPPING:
        out = np.zeros(10)
        done = penetration(vertices, span, rot, shift, simplex, size, new_polytope(), out)
        assert done
        return Found(result, -out[9], out[:3].copy(), out[3:6].copy(), out[6:9].copy())
    weight, point = simplex.weight[:size], simplex.point[:size]
    near_a, near_b = weight @ point[:, 3:6], weight @ point[:, 6:9]
    direction = simplex.closest / distance if result == CLOSE else NOWHERE
    return Found(result, distance, direction, near_a, near_b)


def differences(a: F64, b: F64, rot: F64, shift: F64) -> F64:
    """Return all differences (M, 3) of a corner of A, moved, and a corner of B."""
    moved = a @ rot.T + shift
    return np.asarray((moved[:, None] - b[None]).reshape(-1, 3))


def distance_by_least_squares(points: F64) -> float:
    """Return the distance of the convex hull of ``points`` (M, 3) from the origin.

    The non-negative w that brings (sum w_i p_i, sum w_i) nearest to (0, 1) is, divided by its sum,
    the convex combination nearest to 0 (Lawson and Hanson, Solving Least Squares Problems, ch. 23).
    """
    system = np.concatenate([points.T, np.ones((1, len(points)))])
    weight, _ = nnls(system, np.array([0.0, 0, 0, 1.0]))
    return float(np.linalg.norm(weight @ points) / weight.sum())


def depth_by_facets(points: F64) -> float:
    """Return the distance of the origin from the surface of the hull of ``points`` around it.

    Negative where the origin lies outside.
    """
    return float(-ConvexHull(points).equations[:, 3].max())
