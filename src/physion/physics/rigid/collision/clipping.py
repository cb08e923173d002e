"""Clipping of one convex face against another, in the plane of the reference face.

After PhysX 4 (``geomutils``, contact generation of convex meshes): ``generatedContacts``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel

F64 = NDArray[np.float64]
Flags = NDArray[np.bool_]

MAX_POINTS = 64
"""Points of one clipping before they are reduced; further ones are dropped (PhysX)."""
EDGE_TOLERANCE = 1e-12
"""Square metres: a point this close to an edge (twice the area with its ends) counts as on it; and
a face whose normal has no larger component upwards is vertical, so that its plane has no height."""


@in_place_kernel
def _inside(polygon: F64, corners: int, u: float, v: float) -> bool:
    """Return whether (u, v) lies in a convex polygon of either winding."""
    sign = 0.0
    for i in range(corners):
        j = i + 1 if i + 1 < corners else 0
        area = (polygon[j, 0] - polygon[i, 0]) * (v - polygon[i, 1]) - (
            polygon[j, 1] - polygon[i, 1]
        ) * (u - polygon[i, 0])
        if abs(area) <= EDGE_TOLERANCE:
            continue
        if sign == 0.0:
            sign = area
        elif sign * area < 0:
            return False
    return True


# Clipping in the plane of the reference face, seen from above. Points of the overlap of two convex
# polygons are (1) corners of the incident face inside the reference face, (2) corners of the
# reference face inside the incident one, with the height of the incident plane there,
#     z = z_0 - (n_u (u - u_0) + n_v (v - v_0)) / n_w,
# and (3) crossings of their edges: edges a-b and c-d cross where a, b lie on both sides of c-d and
# c, d on both sides of a-b; on a-b the crossing is at t = A(a) / (A(a) - A(b)), A the signed area
# with c-d. A point is a contact where it is lower than ``reach`` above the reference face.
# Where one face lies wholly within the other, the remaining cases add nothing and are left out.


@in_place_kernel
def clip_faces(
    reference: F64, n: int, incident: F64, m: int, reach: float, low: Flags, clipped: F64
) -> int:
    """Fill ``clipped`` with the points where two faces come closer than ``reach``; return how many.

    Parameters
    ----------
    reference, n : (MAX_LOOP, 3), int
        Corners in order as (u, v, height) in metres, all of one height; their number.
    incident, m : (MAX_LOOP, 3), int
        The same of the other face, with heights of their own.
    reach : float
        Metres.
    low, clipped
        See `physion.physics.rigid.collision.facing_faces.ClipSpace`.
    """
    inside = _clip_corners(reference, n, incident, m, reach, low, clipped)
    if inside == m:
        return inside
    used = _clip_reference_corners(reference, n, incident, m, reach, clipped, inside)
    if used - inside == n:
        return used
    return _clip_edges(reference, n, incident, m, reach, low, clipped, used)


@in_place_kernel
def _add_point(clipped: F64, used: int, u: float, v: float, z: float, height: float) -> int:
    """Make row ``used`` of ``clipped`` the point (u, v, z) over ``height``; return ``used`` + 1."""
    clipped[used, 0], clipped[used, 1], clipped[used, 2], clipped[used, 3] = u, v, z, z - height
    return used + 1


@in_place_kernel
def _clip_corners(
    reference: F64, n: int, incident: F64, m: int, reach: float, low: Flags, clipped: F64
) -> int:
    """Add corners of the incident face inside the reference face (1), and fill ``low``.

    Returns the number of points; see `clip_faces` for the parameters.
    """
    used = 0
    height = reference[0, 2]
    for i in range(m):
        u, v, z = incident[i, 0], incident[i, 1], incident[i, 2]
        low[i] = z - height < reach
        if low[i] and used < MAX_POINTS and _inside(reference, n, u, v):
            used = _add_point(clipped, used, u, v, z, height)
    return used


@in_place_kernel
def _clip_reference_corners(
    reference: F64, n: int, incident: F64, m: int, reach: float, clipped: F64, used: int
) -> int:
    """Add corners of the reference face inside the incident face (2).

    Returns the number of points, of which ``used`` were there before; see `clip_faces` for the
    other parameters.
    """
    height = reference[0, 2]
    nu = nv = nw = 0.0
    for i in range(1, m - 1):
        a0, a1 = incident[i, 0] - incident[0, 0], incident[i, 1] - incident[0, 1]
        a2 = incident[i, 2] - incident[0, 2]
        b0, b1 = incident[i + 1, 0] - incident[0, 0], incident[i + 1, 1] - incident[0, 1]
        b2 = incident[i + 1, 2] - incident[0, 2]
        nu += a1 * b2 - a2 * b1
        nv += a2 * b0 - a0 * b2
        nw += a0 * b1 - a1 * b0
    if abs(nw) <= EDGE_TOLERANCE:
        return used
    for i in range(n):
        u, v = reference[i, 0], reference[i, 1]
        if not _inside(incident, m, u, v):
            continue
        z = incident[0, 2] - (nu * (u - incident[0, 0]) + nv * (v - incident[0, 1])) / nw
        if z - height < reach and used < MAX_POINTS:
            used = _add_point(clipped, used, u, v, z, height)
    return used


@in_place_kernel
def _clip_edges(
    reference: F64,
    n: int,
    incident: F64,
    m: int,
    reach: float,
    low: Flags,
    clipped: F64,
    used: int,
) -> int:
    """Add the crossings of the edges of both faces (3), at heights of the incident face.

    Returns the number of points, of which ``used`` were there before; see `clip_faces` for the
    other parameters.
    """
    height = reference[0, 2]
    for i in range(m):
        before = i - 1 if i > 0 else m - 1
        if not (low[before] or low[i]):
            continue
        a0, a1, b0, b1 = incident[before, 0], incident[before, 1], incident[i, 0], incident[i, 1]
        for j in range(n):
            last = j - 1 if j > 0 else n - 1
            c0, c1 = reference[last, 0], reference[last, 1]
            d0, d1 = reference[j, 0], reference[j, 1]
            area_a = (d0 - c0) * (a1 - c1) - (d1 - c1) * (a0 - c0)
            area_b = (d0 - c0) * (b1 - c1) - (d1 - c1) * (b0 - c0)
            if area_a * area_b >= 0:
                continue
            area_c = (b0 - a0) * (c1 - a1) - (b1 - a1) * (c0 - a0)
            area_d = (b0 - a0) * (d1 - a1) - (b1 - a1) * (d0 - a0)
            if area_c * area_d >= 0:
                continue
            t = area_a / (area_a - area_b)
            z = incident[before, 2] + t * (incident[i, 2] - incident[before, 2])
            if z - height < reach and used < MAX_POINTS:
                u, v = a0 + t * (b0 - a0), a1 + t * (b1 - a1)
                used = _add_point(clipped, used, u, v, z, height)
    return used
