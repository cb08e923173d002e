"""Closest points of two convex hulls, by the algorithm of Gilbert, Johnson and Keerthi (GJK).

The closest points of hulls A and B belong to the point of the Minkowski difference
A - B = {a - b} that is closest to the origin. GJK finds it with a simplex of up to four points of
A - B, each the difference of a corner of A and a corner of B:

1. find the point c of the simplex that is closest to the origin, and drop the corners that it does
   not need;
2. find the corner s of A - B that is farthest in the direction -c (`support`);
3. if s is no closer to the origin along c than c itself, c is the answer; otherwise add s, repeat.

Both hulls are given in the frame of B. If the origin lies inside A - B the hulls overlap, and
`physion.physics.rigid.collision.penetration` takes over from the last simplex.

References
----------
E. G. Gilbert, D. W. Johnson, S. S. Keerthi, A fast procedure for computing the distance between
complex objects in three-dimensional space, IEEE J. Robotics and Automation 4, 1988.
C. Ericson, Real-Time Collision Detection, 2005, sections 5.1 and 9.5 (closest points of a simplex).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

APART, CLOSE, OVERLAPPING = 0, 1, 2
"""Results of `closest_points`."""
CONVERGED = 1e-9
"""Part of the distance: what a further corner could at most gain where the search ends."""
TOUCHING = 1e-14
"""Square metres: hulls whose squared distance is smaller count as overlapping, since the direction
from one to the other would be noise."""
FLAT = 1e-12
"""Squared sine of the angle between a face and the fourth corner of a tetrahedron under which the
tetrahedron counts as flat."""
MAX_CORNERS = 48
"""Corners added before the search ends with the best simplex so far. Exact arithmetic needs no
limit; a dozen are usual."""


class Simplex(NamedTuple):
    """Simplex of up to four points of A - B; work space of `closest_points`.

    - ``point`` (4, 9): point w = a - b, then a, then b, metres, in the frame of B.
    - ``corner`` (4, 2): rows in the vertices of the corners a and b.
    - ``weight`` (4,): barycentric weights of the point closest to the origin.
    - ``closest`` (3,): that point, metres.
    - ``trial`` (4,): weights that are being compared.
    """

    point: F64
    corner: I64
    weight: F64
    closest: F64
    trial: F64


def new_simplex() -> Simplex:
    """Return the work space of one search."""
    return Simplex(
        np.zeros((4, 9)), np.zeros((4, 2), np.int64), np.zeros(4), np.zeros(3), np.zeros(4)
    )


@in_place_kernel
def support(vertices: F64, start: int, stop: int, x: float, y: float, z: float) -> int:
    """Return the row of the corner that lies farthest along (x, y, z); the first of equals.

    ``vertices[start:stop]`` (V, 3) are the corners.
    """
    best = -np.inf
    chosen = start
    for i in range(start, stop):
        along = vertices[i, 0] * x + vertices[i, 1] * y + vertices[i, 2] * z
        if along > best:
            best = along
            chosen = i
    return chosen


@in_place_kernel
def set_corner(
    simplex: Simplex, k: int, a: int, b: int, vertices: F64, rot: F64, shift: F64
) -> None:
    """Make point ``k`` of the simplex the difference of the corners ``a`` and ``b``.

    ``rot`` (3, 3) and ``shift`` (3,) lead from the frame of A to that of B.
    """
    point = simplex.point
    simplex.corner[k, 0], simplex.corner[k, 1] = a, b
    for i in range(3):
        in_b = (
            shift[i]
            + rot[i, 0] * vertices[a, 0]
            + rot[i, 1] * vertices[a, 1]
            + rot[i, 2] * vertices[a, 2]
        )
        point[k, 3 + i] = in_b
        point[k, 6 + i] = vertices[b, i]
        point[k, i] = in_b - vertices[b, i]


@in_place_kernel
def find_corner(
    vertices: F64, span: I64, rot: F64, x: float, y: float, z: float
) -> tuple[int, int]:
    """Return the corners of A and B whose difference lies farthest along (x, y, z).

    ``span`` (4,): start and stop of the vertices of A, then of B. The direction is in the frame of
    B, and ``rot`` (3, 3) leads from the frame of A to that of B.
    """
    a = support(
        vertices,
        span[0],
        span[1],
        rot[0, 0] * x + rot[1, 0] * y + rot[2, 0] * z,
        rot[0, 1] * x + rot[1, 1] * y + rot[2, 1] * z,
        rot[0, 2] * x + rot[1, 2] * y + rot[2, 2] * z,
    )
    b = support(vertices, span[2], span[3], -x, -y, -z)
    return a, b


@in_place_kernel
def _segment(point: F64, i: int, j: int, weight: F64) -> float:
    """Weight the points of segment i-j for its point closest to the origin; return |point|^2.

    t = -p_i . (p_j - p_i) / |p_j - p_i|^2, clamped to 0..1.
    """
    along = 0.0
    length = 0.0
    for k in range(3):
        edge = point[j, k] - point[i, k]
        along -= point[i, k] * edge
        length += edge * edge
    t = 0.0
    if along > 0.0:
        t = 1.0 if along >= length else along / length
    for k in range(4):
        weight[k] = 0.0
    weight[i] = 1.0 - t
    weight[j] = t
    total = 0.0
    for k in range(3):
        c = point[i, k] + t * (point[j, k] - point[i, k])
        total += c * c
    return total


@in_place_kernel
def _triangle(point: F64, i: int, j: int, k: int, weight: F64) -> float:
    """Weight the corners of triangle i-j-k for its point closest to the origin; return |point|^2.

    The origin lies over a corner, an edge or the inside, which the products of the edges with the
    corners tell (Ericson, section 5.1.5).
    """
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for m in range(3):
        a, b, c = point[i, m], point[j, m], point[k, m]
        ab, ac = b - a, c - a
        d1 -= ab * a
        d2 -= ac * a
        d3 -= ab * b
        d4 -= ac * b
        d5 -= ab * c
        d6 -= ac * c
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    u = v = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        u = v = 0.0
    elif d3 >= 0.0 and d4 <= d3:
        u, v = 1.0, 0.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        u, v = d1 / (d1 - d3), 0.0
    elif d6 >= 0.0 and d5 <= d6:
        u, v = 0.0, 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        u, v = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        v = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        u = 1.0 - v
    else:
        total = va + vb + vc
        u, v = vb / total, vc / total
    for m in range(4):
        weight[m] = 0.0
    weight[i], weight[j], weight[k] = 1.0 - u - v, u, v
    squared = 0.0
    for m in range(3):
        p = weight[i] * point[i, m] + u * point[j, m] + v * point[k, m]
        squared += p * p
    return squared


@in_place_kernel
def _beyond(point: F64, i: int, j: int, k: int, opposite: int) -> bool:
    """Return whether the origin lies beyond face i-j-k of a tetrahedron, or this is unclear.

    It lies beyond where the origin and the fourth corner are on different sides of the plane. Where
    the tetrahedron is flat the face is not ruled out.
    """
    x0, y0, z0 = point[i, 0], point[i, 1], point[i, 2]
    ax, ay, az = point[j, 0] - x0, point[j, 1] - y0, point[j, 2] - z0
    bx, by, bz = point[k, 0] - x0, point[k, 1] - y0, point[k, 2] - z0
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    origin = -(x0 * nx + y0 * ny + z0 * nz)
    cx, cy, cz = point[opposite, 0] - x0, point[opposite, 1] - y0, point[opposite, 2] - z0
    fourth = cx * nx + cy * ny + cz * nz
    squared = (nx * nx + ny * ny + nz * nz) * (cx * cx + cy * cy + cz * cz)
    return bool(origin * fourth < 0.0 or fourth * fourth <= FLAT * squared)


@in_place_kernel
def reduce_simplex(simplex: Simplex, size: int) -> tuple[int, float]:
    """Find the point of a simplex closest to the origin; drop the corners that it does not need.

    Returns the number of corners that are left and the squared distance in square metres, which is
    0 where a tetrahedron holds the origin. ``weight`` and ``closest`` are filled.
    """
    point, weight, trial = simplex.point, simplex.weight, simplex.trial
    if size == 1:
        weight[0] = 1.0
        best = point[0, 0] ** 2 + point[0, 1] ** 2 + point[0, 2] ** 2
    elif size == 2:
        best = _segment(point, 0, 1, weight)
    elif size == 3:
        best = _triangle(point, 0, 1, 2, weight)
    else:
        best = np.inf
        for face in range(4):
            i, j, k = (face + 1) % 4, (face + 2) % 4, (face + 3) % 4
            if not _beyond(point, i, j, k, face):
                continue
            squared = _triangle(point, i, j, k, trial)
            if squared < best:
                best = squared
                for m in range(4):
                    weight[m] = trial[m]
        if best == np.inf:
            return 4, 0.0
    left = 0
    for k in range(size):
        if weight[k] > 0.0:
            if k != left:
                weight[left] = weight[k]
                simplex.corner[left, 0] = simplex.corner[k, 0]
                simplex.corner[left, 1] = simplex.corner[k, 1]
                for m in range(9):
                    point[left, m] = point[k, m]
            left += 1
    for m in range(3):
        simplex.closest[m] = 0.0
        for k in range(left):
            simplex.closest[m] += weight[k] * point[k, m]
    return left, best


@in_place_kernel
def closest_points(
    vertices: F64,
    span: I64,
    rot: F64,
    shift: F64,
    reach: float,
    simplex: Simplex,
    size: int,
) -> tuple[int, int, float]:
    """Find the closest points of two hulls.

    Parameters
    ----------
    vertices, span : (V, 3), (4,)
        Corners of all hulls, each in the frame of its own body; start and stop of A, then of B.
    rot, shift : (3, 3), (3,)
        From the frame of A to that of B.
    reach : float
        Metres. Hulls that are proved to be farther apart give `APART` at once.
    simplex : Simplex
        Work space. On entry its first ``size`` corners, if any, are where the search starts: those
        of the last search of the same pair, so that it usually ends at once.
    size : int
        0 to 4.

    Returns
    -------
    result : int
        `APART`, `CLOSE` or `OVERLAPPING`.
    size : int
        Corners of the last simplex, in ``simplex``.
    distance : float
        Metres: the distance for `CLOSE`, a lower bound of it for `APART`. With `CLOSE` the
        direction from B to A is ``simplex.closest`` / distance, and the closest points are the
        weighted sums of ``point[:, 3:6]`` and ``point[:, 6:9]``.
    """
    corner = simplex.corner
    for k in range(size):
        set_corner(simplex, k, corner[k, 0], corner[k, 1], vertices, rot, shift)
    if size == 0:
        a, b = find_corner(vertices, span, rot, -shift[0], -shift[1], -shift[2])
        set_corner(simplex, 0, a, b, vertices, rot, shift)
        size = 1
    size, squared = reduce_simplex(simplex, size)
    for _ in range(MAX_CORNERS):
        if squared < TOUCHING or size == 4:
            return OVERLAPPING, size, 0.0
        x, y, z = simplex.closest[0], simplex.closest[1], simplex.closest[2]
        distance = np.sqrt(squared)
        a, b = find_corner(vertices, span, rot, -x, -y, -z)
        known = False
        for k in range(size):
            known = known or (corner[k, 0] == a and corner[k, 1] == b)
        if known:
            if distance > reach:
                return APART, size, distance
            return CLOSE, size, distance
        set_corner(simplex, size, a, b, vertices, rot, shift)
        point = simplex.point
        along = x * point[size, 0] + y * point[size, 1] + z * point[size, 2]
        if along > reach * distance:
            return APART, size, along / distance
        if squared - along <= CONVERGED * squared:
            return CLOSE, size, distance
        last = squared
        size, squared = reduce_simplex(simplex, size + 1)
        if squared >= last:
            # Rounding: the new corner brought nothing.
            if squared < TOUCHING:
                return OVERLAPPING, size, 0.0
            return CLOSE, size, np.sqrt(squared)
    return CLOSE, size, np.sqrt(squared)


@in_place_kernel
def fill_closest(simplex: Simplex, size: int, distance: float, closest: F64) -> None:
    """Fill in the closest points that `closest_points` found for two hulls that are apart.

    With the weights w_k of the corners a_k - b_k of the simplex, and c = sum w_k (a_k - b_k), the
    closest point of A is sum w_k a_k, that of B is sum w_k b_k, and c / |c| points from B to A.

    Parameters
    ----------
    simplex : Simplex
        As `closest_points` left it.
    size : int
        Number of its corners.
    distance : float
        Metres between the hulls, |c|.
    closest : (10,)
        Output: direction from B to A, point of A, point of B, depth, which is -distance.
    """
    for i in range(3):
        closest[i] = simplex.closest[i] / distance
        closest[3 + i] = 0.0
        closest[6 + i] = 0.0
        for k in range(size):
            closest[3 + i] += simplex.weight[k] * simplex.point[k, 3 + i]
            closest[6 + i] += simplex.weight[k] * simplex.point[k, 6 + i]
    closest[9] = -distance
