"""Contact points of two convex hulls, from the faces that look at each other.

`closest_points` and `penetration` give one pair of points and a direction. Where a face rests on
another, up to four points are needed: the face of each hull that looks most along the direction is
taken, one is clipped against the other (`clip_faces`), and the four points that span the overlap
are kept (`physion.physics.rigid.collision.manifold.spread_points`).

After PhysX 4 (``geomutils``, contact generation of convex meshes): `clip_faces` follows
``generatedContacts``, `facing_face` ``getWitnessPolygonIndex``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.manifold import MANIFOLD_SIZE

F64 = NDArray[np.float64]
Flags = NDArray[np.bool_]
I64 = NDArray[np.int64]


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
        See `physion.physics.rigid.collision.faces.ClipSpace`.
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


# Convex hulls as arrays that the compiled collision functions read.


class Hulls(NamedTuple):
    """G convex hulls, those of one body after the other; a hull is also called geom.

    - ``vertices`` (V, 3): corners in metres, in the frame of the actor that the hull moves with.
    - ``first_vertex`` (G + 1,): first corner of each hull, and at the end V.
    - ``loops`` (L,): rows of ``vertices``, counterclockwise round every face.
    - ``first_loop`` (F + 1,): first entry in ``loops`` of each face, and at the end L.
    - ``first_face`` (G + 1,): first face of each hull, and at the end F.
    - ``plane`` (F, 4): outward unit normal n of each face and d in n . p = d, metres.
    - ``margin`` (G,): metres that a contact may drift before it is found anew.
    - ``tolerance`` (G,): metres within which faces at the closest point count as equally close.
    - ``radius`` (G,): half diagonal in metres of the box inside the hull.
    - ``extent`` (G,): largest distance in metres of a corner from the actor's centre of mass.
    - ``box`` (G, 6): centre and half extents of the box round the hull, in the actor's frame.
    """

    vertices: F64
    first_vertex: I64
    loops: I64
    first_loop: I64
    first_face: I64
    plane: F64
    margin: F64
    tolerance: F64
    radius: F64
    extent: F64
    box: F64


MAX_LOOP = 256
"""Corners of a face."""


class ClipSpace(NamedTuple):
    """Work space of `face_points`.

    - ``reference``, ``incident`` (MAX_LOOP, 3): corners of both faces as (u, v, height).
    - ``low`` (MAX_LOOP,): corners of the incident face near the reference face.
    - ``clipped`` (MAX_POINTS, 4): u, v, height of the incident face there, and above the reference.
    - ``points`` (MAX_POINTS, 7): point of A, point of B (frame of B, metres), gap.
    - ``chosen`` (4,): rows of ``points`` that are kept. ``kept`` (4, 7): those rows.
    - ``axes`` (3, 3): the reference plane's axes and normal. ``normal`` (3,): from B to A.
    """

    reference: F64
    incident: F64
    low: Flags
    clipped: F64
    points: F64
    chosen: I64
    kept: F64
    axes: F64
    normal: F64


def new_clip_space() -> ClipSpace:
    """Return the work space."""
    return ClipSpace(
        np.zeros((MAX_LOOP, 3)),
        np.zeros((MAX_LOOP, 3)),
        np.zeros(MAX_LOOP, np.bool_),
        np.zeros((MAX_POINTS, 4)),
        np.zeros((MAX_POINTS, 7)),
        np.zeros(MANIFOLD_SIZE, np.int64),
        np.zeros((MANIFOLD_SIZE, 7)),
        np.zeros((3, 3)),
        np.zeros(3),
    )


# The direction m points from the hull to the other hull. Faces whose plane passes within
# ``tolerance`` of the closest point, compared with the nearest such plane, are candidates; planes
# that have the point more than ``tolerance`` inside are not. Among candidates the face with the
# largest n . m is taken; without any, the face that has the point farthest outside.


@in_place_kernel
def facing_face(
    hulls: Hulls, g: int, x: float, y: float, z: float, mx: float, my: float, mz: float
) -> int:
    """Return the face of hull ``g`` that looks most along (mx, my, mz) at the point (x, y, z).

    Both are in the frame of the hull's actor, metres.
    """
    plane = hulls.plane
    start, stop = hulls.first_face[g], hulls.first_face[g + 1]
    tolerance = hulls.tolerance[g]
    nearest = np.inf
    outside = -np.inf
    outer = start
    for f in range(start, stop):
        height = plane[f, 0] * x + plane[f, 1] * y + plane[f, 2] * z - plane[f, 3]
        if height >= -tolerance:
            nearest = min(nearest, abs(height))
        if height > outside:
            outside = height
            outer = f
    if nearest == np.inf:
        return int(outer)
    best = -np.inf
    chosen = outer
    for f in range(start, stop):
        height = plane[f, 0] * x + plane[f, 1] * y + plane[f, 2] * z - plane[f, 3]
        if height < -tolerance or abs(height) - nearest >= tolerance:
            continue
        cosine = plane[f, 0] * mx + plane[f, 1] * my + plane[f, 2] * mz
        if cosine > best:
            best = cosine
            chosen = f
    return int(chosen)


@in_place_kernel
def _flatten(hulls: Hulls, f: int, rot: F64, shift: F64, axes: F64, out: F64) -> int:
    """Fill ``out`` with the corners of a face along ``axes`` (3, 3); return how many.

    ``rot``, ``shift`` lead from the frame of the face's hull to that of the axes.
    """
    start, stop = hulls.first_loop[f], hulls.first_loop[f + 1]
    count = min(stop - start, MAX_LOOP)
    for k in range(count):
        c = hulls.loops[start + k]
        px, py, pz = hulls.vertices[c, 0], hulls.vertices[c, 1], hulls.vertices[c, 2]
        x = shift[0] + rot[0, 0] * px + rot[0, 1] * py + rot[0, 2] * pz
        y = shift[1] + rot[1, 0] * px + rot[1, 1] * py + rot[1, 2] * pz
        z = shift[2] + rot[2, 0] * px + rot[2, 1] * py + rot[2, 2] * pz
        for i in range(3):
            out[k, i] = axes[i, 0] * x + axes[i, 1] * y + axes[i, 2] * z
    return int(count)


@in_place_kernel
def _set_axes(axes: F64, x: float, y: float, z: float) -> None:
    """Fill ``axes`` (3, 3) with two axes across the unit normal (x, y, z), and the normal.

    The first is the coordinate axis least along the normal, made orthogonal to it.
    """
    axes[2, 0], axes[2, 1], axes[2, 2] = x, y, z
    least = 0
    if abs(y) < abs(x):
        least = 1
    if abs(z) < abs(axes[2, least]):
        least = 2
    along = axes[2, least]
    for i in range(3):
        axes[0, i] = (1.0 if i == least else 0.0) - along * axes[2, i]
    length = np.sqrt(axes[0, 0] ** 2 + axes[0, 1] ** 2 + axes[0, 2] ** 2)
    for i in range(3):
        axes[0, i] /= length
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        axes[1, i] = axes[2, j] * axes[0, k] - axes[2, k] * axes[0, j]


@in_place_kernel
def face_points(
    hulls: Hulls,
    g: int,
    h: int,
    rot: F64,
    shift: F64,
    direction: F64,
    point_a: F64,
    point_b: F64,
    reach: float,
    identity: F64,
    zero: F64,
    clip: ClipSpace,
) -> int:
    """Find the contact points of hulls A = ``g`` and B = ``h`` from the faces along ``direction``.

    The face that looks more exactly along the direction is the reference face, and gives the
    contacts their normal.

    Parameters
    ----------
    hulls : Hulls
        All hulls.
    rot, shift : (3, 3), (3,)
        From the frame of A to that of B.
    direction : (3,)
        Unit, from B to A, in the frame of B.
    point_a, point_b : (3,)
        Closest points, in the frame of B, metres.
    reach : float
        Metres: points closer than this are contacts.
    identity, zero : (3, 3), (3,)
        The rotation and shift that change nothing.
    clip : ClipSpace
        Its ``points`` and ``normal`` are filled.

    Returns
    -------
    int
        Number of points; 0 where the faces do not overlap.
    """
    dx, dy, dz = direction[0], direction[1], direction[2]
    face_b = facing_face(hulls, h, point_b[0], point_b[1], point_b[2], dx, dy, dz)
    px, py, pz = point_a[0] - shift[0], point_a[1] - shift[1], point_a[2] - shift[2]
    face_a = facing_face(
        hulls,
        g,
        rot[0, 0] * px + rot[1, 0] * py + rot[2, 0] * pz,
        rot[0, 1] * px + rot[1, 1] * py + rot[2, 1] * pz,
        rot[0, 2] * px + rot[1, 2] * py + rot[2, 2] * pz,
        -(rot[0, 0] * dx + rot[1, 0] * dy + rot[2, 0] * dz),
        -(rot[0, 1] * dx + rot[1, 1] * dy + rot[2, 1] * dz),
        -(rot[0, 2] * dx + rot[1, 2] * dy + rot[2, 2] * dz),
    )
    bx, by, bz = hulls.plane[face_b, 0], hulls.plane[face_b, 1], hulls.plane[face_b, 2]
    nx, ny, nz = hulls.plane[face_a, 0], hulls.plane[face_a, 1], hulls.plane[face_a, 2]
    ax = rot[0, 0] * nx + rot[0, 1] * ny + rot[0, 2] * nz
    ay = rot[1, 0] * nx + rot[1, 1] * ny + rot[1, 2] * nz
    az = rot[2, 0] * nx + rot[2, 1] * ny + rot[2, 2] * nz
    cosine_b = abs(bx * dx + by * dy + bz * dz)
    cosine_a = abs(ax * dx + ay * dy + az * dz)
    axes, points, clipped = clip.axes, clip.points, clip.clipped
    b_is_reference = cosine_b >= cosine_a
    if b_is_reference:
        _set_axes(axes, bx, by, bz)
        n = _flatten(hulls, face_b, identity, zero, axes, clip.reference)
        m = _flatten(hulls, face_a, rot, shift, axes, clip.incident)
        clip.normal[0], clip.normal[1], clip.normal[2] = bx, by, bz
    else:
        _set_axes(axes, ax, ay, az)
        n = _flatten(hulls, face_a, rot, shift, axes, clip.reference)
        m = _flatten(hulls, face_b, identity, zero, axes, clip.incident)
        clip.normal[0], clip.normal[1], clip.normal[2] = -ax, -ay, -az
    count = clip_faces(clip.reference, n, clip.incident, m, reach, clip.low, clipped)
    incident, reference = (0, 3) if b_is_reference else (3, 0)
    for k in range(count):
        u, v, z = clipped[k, 0], clipped[k, 1], clipped[k, 2]
        height = z - clipped[k, 3]
        for i in range(3):
            across = u * axes[0, i] + v * axes[1, i]
            points[k, incident + i] = across + z * axes[2, i]
            points[k, reference + i] = across + height * axes[2, i]
        points[k, 6] = clipped[k, 3]
    return count
