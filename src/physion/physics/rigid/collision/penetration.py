"""Depth of the overlap of two convex hulls, by the expanding polytope algorithm (EPA).

If hulls A and B overlap, the origin lies inside their Minkowski difference A - B, and the shortest
way to part them is to the closest point of its surface. EPA keeps a polytope inside A - B that
holds the origin, starting from the last simplex of `closest_points`, and pushes its face closest
to the origin outwards until that face lies on the surface of A - B:

1. take the face closest to the origin, with unit normal n and distance d;
2. find the corner s of A - B that lies farthest along n; if s . n - d is negligible, the hulls
   overlap by d, and moving A by -d n parts them;
3. otherwise remove all faces that s sees, and join s to the edges of the hole.

Reference: G. van den Bergen, Proximity queries and penetration depth computation on 3D game
objects, Game Developers Conference, 2001.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.closest_points import Simplex, find_corner, set_corner

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MAX_POINTS = 96
"""Points of the polytope; with more the search ends with the closest face so far."""
MAX_FACES = 4 * MAX_POINTS
GAIN = 1e-8
"""Metres: a face is on the surface of A - B if no corner lies farther out than this."""
SEEN = 1e-12
"""Metres: a point this far outside a face sees it."""
MIN_VOLUME = 1e-15
"""Smallest squared length (m^2) and squared area (m^4, times 4) of a first simplex, and smallest
volume (m^3, times 6) of a first tetrahedron. Smaller ones are given other corners."""


class Polytope(NamedTuple):
    """Polytope inside A - B; work space of `penetration`.

    - ``point`` (P, 9): as in `Simplex`.
    - ``face`` (F, 3): corners of each face, counterclockwise from outside; ``normal`` (F, 3): unit,
      outward; ``distance`` (F,): metres from the origin, inf where the face was removed.
    - ``edge`` (E, 2): edges of the hole that a new point is joined to.
    """

    point: F64
    face: I64
    normal: F64
    distance: F64
    edge: I64


def new_polytope() -> Polytope:
    """Return the work space of one search."""
    return Polytope(
        np.zeros((MAX_POINTS, 9)),
        np.zeros((MAX_FACES, 3), np.int64),
        np.zeros((MAX_FACES, 3)),
        np.zeros(MAX_FACES),
        np.zeros((MAX_FACES, 2), np.int64),
    )


@in_place_kernel
def _set_face(polytope: Polytope, f: int, i: int, j: int, k: int) -> None:
    """Make face ``f`` the triangle of points i, j, k; a triangle without area counts as removed."""
    p = polytope.point
    ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
    bx, by, bz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    polytope.face[f, 0], polytope.face[f, 1], polytope.face[f, 2] = i, j, k
    if length == 0.0:
        polytope.distance[f] = np.inf
        return
    nx, ny, nz = nx / length, ny / length, nz / length
    polytope.normal[f, 0], polytope.normal[f, 1], polytope.normal[f, 2] = nx, ny, nz
    polytope.distance[f] = nx * p[i, 0] + ny * p[i, 1] + nz * p[i, 2]


@in_place_kernel
def _sixfold_volume(p: F64) -> float:
    """Return six times the signed volume of the tetrahedron of the first four points (P, 9)."""
    ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    bx, by, bz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    cx, cy, cz = p[3, 0] - p[0, 0], p[3, 1] - p[0, 1], p[3, 2] - p[0, 2]
    return float(cx * (ay * bz - az * by) + cy * (az * bx - ax * bz) + cz * (ax * by - ay * bx))


@in_place_kernel
def complete_simplex(
    vertices: F64, span: I64, rot: F64, shift: F64, simplex: Simplex, size: int
) -> bool:
    """Add corners to a simplex until it is a tetrahedron with volume; return whether it worked.

    The corners are the farthest of A - B along directions in which the simplex has no extent.
    """
    p = simplex.point
    nx = ny = nz = 0.0
    while size < 4:
        if size == 3:
            ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
            bx, by, bz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        found = False
        for attempt in range(6):
            sign = 1.0 if attempt % 2 == 0 else -1.0
            x = y = z = 0.0
            if size == 3:
                x, y, z = sign * nx, sign * ny, sign * nz
            elif size == 2:
                # Across the segment: its product with an axis.
                ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
                if attempt < 2:
                    x, y, z = 0.0, sign * az, -sign * ay
                elif attempt < 4:
                    x, y, z = -sign * az, 0.0, sign * ax
                else:
                    x, y, z = sign * ay, -sign * ax, 0.0
            elif attempt < 2:
                x = sign
            elif attempt < 4:
                y = sign
            else:
                z = sign
            a, b = find_corner(vertices, span, rot, x, y, z)
            set_corner(simplex, size, a, b, vertices, rot, shift)
            dx, dy, dz = (
                p[size, 0] - p[0, 0],
                p[size, 1] - p[0, 1],
                p[size, 2] - p[0, 2],
            )
            if size == 1:
                found = dx * dx + dy * dy + dz * dz > MIN_VOLUME
            elif size == 2:
                ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
                cx, cy, cz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
                found = cx * cx + cy * cy + cz * cz > MIN_VOLUME
            else:
                found = abs(_sixfold_volume(p)) > MIN_VOLUME
            if found:
                break
        if not found:
            return False
        size += 1
    return bool(abs(_sixfold_volume(p)) > MIN_VOLUME)


@in_place_kernel
def penetration(
    vertices: F64,
    span: I64,
    rot: F64,
    shift: F64,
    simplex: Simplex,
    size: int,
    polytope: Polytope,
    out: F64,
) -> bool:
    """Find depth and direction of the overlap of two hulls, and the points where it is least.

    Parameters
    ----------
    vertices, span, rot, shift
        As in `closest_points`.
    simplex, size
        Its last simplex. The simplex is changed.
    polytope : Polytope
        Work space.
    out : (10,)
        Filled with the unit direction n in which B pushes A (3), the point of A (3) and of B (3),
        in the frame of B, metres, and the depth in metres; point A - point B = -depth n.

    Returns
    -------
    bool
        False where no polytope with volume could be made; ``out`` is then not filled.
    """
    if not complete_simplex(vertices, span, rot, shift, simplex, size):
        return False
    p, face, normal, distance = polytope.point, polytope.face, polytope.normal, polytope.distance
    for k in range(4):
        for m in range(9):
            p[k, m] = simplex.point[k, m]
    if _sixfold_volume(p) > 0.0:
        # Then 0-1-2 is counterclockwise seen from 3, that is from inside: swap two points.
        for m in range(9):
            p[0, m], p[1, m] = p[1, m], p[0, m]
    _set_face(polytope, 0, 0, 1, 2)
    _set_face(polytope, 1, 0, 3, 1)
    _set_face(polytope, 2, 1, 3, 2)
    _set_face(polytope, 3, 2, 3, 0)
    points, faces = 4, 4
    best = 0
    while True:
        best = 0
        for f in range(1, faces):
            if distance[f] < distance[best]:
                best = f
        x, y, z = normal[best, 0], normal[best, 1], normal[best, 2]
        if points == MAX_POINTS:
            break
        a, b = find_corner(vertices, span, rot, x, y, z)
        set_corner(simplex, 0, a, b, vertices, rot, shift)
        for m in range(9):
            p[points, m] = simplex.point[0, m]
        out_x, out_y, out_z = p[points, 0], p[points, 1], p[points, 2]
        if out_x * x + out_y * y + out_z * z - distance[best] <= GAIN:
            break
        edges = 0
        for f in range(faces):
            if distance[f] == np.inf:
                continue
            i = face[f, 0]
            height = (
                (out_x - p[i, 0]) * normal[f, 0]
                + (out_y - p[i, 1]) * normal[f, 1]
                + (out_z - p[i, 2]) * normal[f, 2]
            )
            if height <= SEEN:
                continue
            distance[f] = np.inf
            for e in range(3):
                i, j = face[f, e], face[f, (e + 1) % 3]
                # An edge that both removed faces share is inside the hole.
                shared = -1
                for other in range(edges):
                    if polytope.edge[other, 0] == j and polytope.edge[other, 1] == i:
                        shared = other
                        break
                if shared >= 0:
                    edges -= 1
                    polytope.edge[shared, 0] = polytope.edge[edges, 0]
                    polytope.edge[shared, 1] = polytope.edge[edges, 1]
                elif edges < MAX_FACES:
                    polytope.edge[edges, 0], polytope.edge[edges, 1] = i, j
                    edges += 1
        row = 0
        for e in range(edges):
            while row < faces and distance[row] != np.inf:
                row += 1
            if row == MAX_FACES:
                return False
            _set_face(polytope, row, polytope.edge[e, 0], polytope.edge[e, 1], points)
            faces = max(faces, row + 1)
            row += 1
        points += 1
        if edges == 0:
            return False
    if distance[best] == np.inf:
        return False
    i, j, k = face[best, 0], face[best, 1], face[best, 2]
    # Weights of the point d n on the triangle: areas of the three parts over the whole.
    u, v = _barycentric(p, i, j, k, x * distance[best], y * distance[best], z * distance[best])
    for m in range(3):
        out[m] = -normal[best, m]
        out[3 + m] = (1.0 - u - v) * p[i, 3 + m] + u * p[j, 3 + m] + v * p[k, 3 + m]
        out[6 + m] = (1.0 - u - v) * p[i, 6 + m] + u * p[j, 6 + m] + v * p[k, 6 + m]
    out[9] = max(distance[best], 0.0)
    return True


@in_place_kernel
def _barycentric(
    p: F64, i: int, j: int, k: int, x: float, y: float, z: float
) -> tuple[float, float]:
    """Return the weights of points j and k for (x, y, z) in the plane of triangle i-j-k.

    Solves u ab + v ac = q with ab, ac the edges from i and q from i to the point, by Cramer's rule
    on the normal equations. A triangle without area gives (0, 0).
    """
    bb = bc = cc = qb = qc = 0.0
    for m in range(3):
        ab, ac = p[j, m] - p[i, m], p[k, m] - p[i, m]
        q = (x if m == 0 else (y if m == 1 else z)) - p[i, m]
        bb += ab * ab
        bc += ab * ac
        cc += ac * ac
        qb += q * ab
        qc += q * ac
    area = bb * cc - bc * bc
    if area <= 0.0:
        return 0.0, 0.0
    return (qb * cc - qc * bc) / area, (qc * bb - qb * bc) / area
