"""Contact manifolds of two convex hulls, built from the faces that look at each other.

MuJoCo says which pieces are close and along which normal. PhysX then takes the face of each hull
that looks along the normal, clips one against the other, and keeps up to four points; where two
faces are nearly parallel this finds more of the touching area than MuJoCo does, in particular the
corners of a facet of a ball that rests on a box.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from physion.numerics.elementary import arctan2
from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import dot, ordered_mean, unit

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MANIFOLD_SIZE = 4
"""Points that PhysX keeps of a pair of convex shapes."""
MAX_POINTS = 128
WITNESS = 0.01
"""Metres: a face is considered only if its plane passes this close to the closest point (PhysX)."""


def hull_faces(corners: Array) -> list[Index]:
    """Corner numbers of every flat face of a convex hull, in order round the face."""
    hull = ConvexHull(corners)
    size = float(np.ptp(corners, axis=0).max())
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    face_of = np.full(len(normals), -1)
    faces: list[Index] = []
    for t in range(len(normals)):
        if face_of[t] >= 0:
            continue
        same = (dot(normals, normals[t]) > 1 - 1e-7) & (np.abs(offsets - offsets[t]) < 1e-5 * size)
        # Triangles of one plane are one face.
        same &= face_of < 0
        face_of[same] = len(faces)
        used = np.unique(hull.simplices[same])
        points = corners[used] - ordered_mean(corners[used], axis=0)
        normal = normals[t]
        first = unit(points[0] - normal * dot(points[0], normal))
        second = np.cross(normal, first)
        angle = arctan2(dot(points, second), dot(points, first))
        faces.append(used[np.argsort(angle, kind="stable")].astype(np.int64))
    return faces


@kernel
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def facing(
    corners: Any,
    loops: Any,
    first_loop: Any,
    start: int,
    stop: int,
    rot: Any,
    x: Any,
    normal: Any,
    witness: Any,
    tolerance: float,
) -> Any:
    """The face (of ``start``..``stop``) that looks most along ``normal`` near ``witness``.

    Returns its number, its world normal, and how well it looks that way (cosine). Faces whose
    plane is farther than ``tolerance`` from the witness are taken only if no face is closer.
    """
    local = np.zeros(3)
    seen = np.zeros(3)
    for i in range(3):
        for j in range(3):
            local[i] += rot[j, i] * normal[j]
            seen[i] += rot[j, i] * (witness[j] - x[j])
    best = -2.0
    chosen = start
    chosen_normal = np.zeros(3)
    for strict in range(2):
        for f in range(start, stop):
            p = corners[loops[first_loop[f]]]
            n = face_normal(corners, loops, first_loop, f)
            away = 0.0
            cosine = 0.0
            for i in range(3):
                away += (seen[i] - p[i]) * n[i]
                cosine += n[i] * local[i]
            if strict == 0 and abs(away) > tolerance:
                continue
            if cosine > best:
                best = cosine
                chosen = f
                chosen_normal = n
        if best > -2.0:
            break
    world = np.zeros(3)
    for i in range(3):
        for j in range(3):
            world[i] += rot[i, j] * chosen_normal[j]
    return chosen, world, best


@kernel
def face_normal(corners: Any, loops: Any, first_loop: Any, f: int) -> Any:
    """Unit normal of a face, outward, from its first corner and the two that span most."""
    a = corners[loops[first_loop[f]]]
    total = np.zeros(3)
    for k in range(first_loop[f] + 1, first_loop[f + 1] - 1):
        u = corners[loops[k]] - a
        w = corners[loops[k + 1]] - a
        total[0] += u[1] * w[2] - u[2] * w[1]
        total[1] += u[2] * w[0] - u[0] * w[2]
        total[2] += u[0] * w[1] - u[1] * w[0]
    return total / np.sqrt(_dot(total, total))


@kernel
def _flatten(corners: Any, loops: Any, start: int, stop: int, rot: Any, x: Any, axes: Any) -> Any:
    """Corners of a face as (u, v, height) along the three ``axes``."""
    out = np.zeros((stop - start, 3))
    for k in range(start, stop):
        c = corners[loops[k]]
        world = np.zeros(3)
        for i in range(3):
            world[i] = x[i]
            for j in range(3):
                world[i] += rot[i, j] * c[j]
        for i in range(3):
            out[k - start, i] = (
                axes[i, 0] * world[0] + axes[i, 1] * world[1] + axes[i, 2] * world[2]
            )
    return out


@kernel
def _inside(polygon: Any, u: float, v: float, slack: float) -> Any:
    """Whether (u, v) lies in a convex polygon of either winding."""
    sign = 0.0
    n = len(polygon)
    for i in range(n):
        a, b = polygon[i], polygon[(i + 1) % n]
        area = (b[0] - a[0]) * (v - a[1]) - (b[1] - a[1]) * (u - a[0])
        if abs(area) <= slack:
            continue
        if sign == 0.0:
            sign = area
        elif sign * area < 0:
            return False
    return True


@kernel
def clip_faces(reference: Any, incident: Any, reach: float) -> Any:
    """Points (K, 4) where two flattened faces come closer than ``reach``.

    Columns: u, v, the height of the incident face there, and its height above the reference face.
    """
    out = np.zeros((MAX_POINTS, 4))
    used = 0
    height = reference[0, 2]
    slack = 1e-12
    m, n = len(incident), len(reference)
    low = np.zeros(m, np.bool_)
    inside = 0
    for i in range(m):
        p = incident[i]
        low[i] = p[2] - height < reach
        if low[i] and _inside(reference, p[0], p[1], slack) and used < MAX_POINTS:
            inside += 1
            out[used, 0], out[used, 1], out[used, 2], out[used, 3] = p[0], p[1], p[2], p[2] - height
            used += 1
    if inside == m:
        return out[:used]
    # The incident plane as height = h0 + gu u + gv v.
    nu = nv = nw = 0.0
    for i in range(1, m - 1):
        a0, a1, a2 = incident[i] - incident[0]
        b0, b1, b2 = incident[i + 1] - incident[0]
        nu += a1 * b2 - a2 * b1
        nv += a2 * b0 - a0 * b2
        nw += a0 * b1 - a1 * b0
    inside = 0
    if abs(nw) > 1e-12:
        for i in range(n):
            u, v = reference[i, 0], reference[i, 1]
            if not _inside(incident, u, v, slack):
                continue
            z = incident[0, 2] - (nu * (u - incident[0, 0]) + nv * (v - incident[0, 1])) / nw
            if z - height < reach and used < MAX_POINTS:
                inside += 1
                out[used, 0], out[used, 1], out[used, 2], out[used, 3] = u, v, z, z - height
                used += 1
        if inside == n:
            return out[:used]
    for i in range(m):
        a, b = incident[i - 1], incident[i]
        if not (low[i - 1] or low[i]):
            continue
        for j in range(n):
            c, d = reference[j - 1], reference[j]
            a1 = (d[0] - c[0]) * (a[1] - c[1]) - (d[1] - c[1]) * (a[0] - c[0])
            a2 = (d[0] - c[0]) * (b[1] - c[1]) - (d[1] - c[1]) * (b[0] - c[0])
            if a1 * a2 >= 0:
                continue
            a3 = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            a4 = (b[0] - a[0]) * (d[1] - a[1]) - (b[1] - a[1]) * (d[0] - a[0])
            if a3 * a4 >= 0:
                continue
            t = a1 / (a1 - a2)
            z = a[2] + t * (b[2] - a[2])
            if z - height < reach and used < MAX_POINTS:
                out[used, 0] = a[0] + t * (b[0] - a[0])
                out[used, 1] = a[1] + t * (b[1] - a[1])
                out[used, 2] = z
                out[used, 3] = z - height
                used += 1
    return out[:used]


@kernel
def face_contacts(
    corners: Any,
    loops: Any,
    first_loop: Any,
    faces_a: Any,
    faces_b: Any,
    rot_a: Any,
    x_a: Any,
    rot_b: Any,
    x_b: Any,
    normal: Any,
    point_a: Any,
    point_b: Any,
    reach: float,
    tolerance: float,
    parallel: float,
) -> Any:
    """Manifold of two hulls whose closest points are ``point_a``, ``point_b`` along ``normal``.

    Returns normal (from a to b), points (K, 3) and separations (K,); K is 0 where the faces do
    not look along the normal well enough (cosine below ``parallel``) or do not overlap.
    """
    face_a, na, look_a = facing(
        corners, loops, first_loop, faces_a[0], faces_a[1], rot_a, x_a, normal, point_a, tolerance
    )
    face_b, nb, look_b = facing(
        corners, loops, first_loop, faces_b[0], faces_b[1], rot_b, x_b, -normal, point_b, tolerance
    )
    b_leads = look_b >= look_a
    lead = nb if b_leads else na
    if max(look_a, look_b) < parallel:
        return normal, np.zeros((0, 3)), np.zeros(0)
    axes = np.zeros((3, 3))
    axes[2] = lead
    least = np.argmin(np.abs(lead))
    axes[0, least] = 1.0
    axes[0] -= lead * lead[least]
    axes[0] /= np.sqrt(_dot(axes[0], axes[0]))
    axes[1, 0] = lead[1] * axes[0, 2] - lead[2] * axes[0, 1]
    axes[1, 1] = lead[2] * axes[0, 0] - lead[0] * axes[0, 2]
    axes[1, 2] = lead[0] * axes[0, 1] - lead[1] * axes[0, 0]
    flat_a = _flatten(corners, loops, first_loop[face_a], first_loop[face_a + 1], rot_a, x_a, axes)
    flat_b = _flatten(corners, loops, first_loop[face_b], first_loop[face_b + 1], rot_b, x_b, axes)
    found = clip_faces(flat_b, flat_a, reach) if b_leads else clip_faces(flat_a, flat_b, reach)
    points = np.zeros((len(found), 3))
    for k in range(len(found)):
        # Half way between both surfaces.
        middle = found[k, 2] - 0.5 * found[k, 3]
        for i in range(3):
            points[k, i] = found[k, 0] * axes[0, i] + found[k, 1] * axes[1, i] + middle * axes[2, i]
    separation = found[:, 3].copy()
    if len(found) > MANIFOLD_SIZE:
        chosen = spread_points(points, separation)
        points, separation = points[chosen], separation[chosen]
    return (-lead if b_leads else lead), points, separation


@kernel
def spread_points(points: Any, separation: Any) -> Any:
    """Indices of up to four points that stand for all: the deepest, then the farthest apart."""
    chosen = np.zeros(4, np.int64)
    chosen[0] = np.argmin(separation)
    best = -1.0
    for i in range(len(points)):
        off = points[i] - points[chosen[0]]
        d = _dot(off, off)
        if d > best:
            best = d
            chosen[1] = i
    a, b = points[chosen[0]], points[chosen[1]]
    along = b - a
    length = max(_dot(along, along), 1e-20)
    reference = np.zeros(3)
    best = -1.0
    for i in range(len(points)):
        p = points[i] - a
        off = p - along * (_dot(p, along) / length)
        d = _dot(off, off)
        if d > best:
            best = d
            chosen[2] = i
            reference = off
    # The fourth lies on the other side of the line through the first two.
    best = -np.inf
    for i in range(len(points)):
        p = points[i] - a
        off = p - along * (_dot(p, along) / length)
        d = -_dot(off, reference)
        if d > best:
            best = d
            chosen[3] = i
    return np.unique(chosen)


@kernel
def collect_contacts(
    geoms: Any,
    distance: Any,
    position: Any,
    frame: Any,
    moving_geoms: Any,
    geom_body: Any,
    actor_of: Any,
    vertices: Any,
    first_vertex: Any,
    loops: Any,
    first_loop: Any,
    first_face: Any,
    material: Any,
    x: Any,
    rot: Any,
    reach: float,
    height: float,
    parallel: float,
) -> Any:
    """Contacts between geoms and with the floor, sorted by pair; the floor is the last geom."""
    total = len(geom_body)
    still = len(x) - 1
    room = MANIFOLD_SIZE * (len(geoms) + len(moving_geoms)) + len(geoms)
    pair = np.zeros((room, 2), np.int64)
    normal, point, separation = np.zeros((room, 3)), np.zeros((room, 3)), np.zeros(room)
    used = 0
    start = 0
    while start < len(geoms):
        g, h = geoms[start, 0], geoms[start, 1]
        stop = start
        deepest = start
        while stop < len(geoms) and geoms[stop, 0] == g and geoms[stop, 1] == h:
            if distance[stop] < distance[deepest]:
                deepest = stop
            stop += 1
        sign = 1.0 if g < h else -1.0
        low, high = min(g, h), max(g, h)
        n = sign * frame[deepest, :3]
        half = 0.5 * distance[deepest] * n
        a, b = actor_of[geom_body[low]], actor_of[geom_body[high]]
        if distance[deepest] < reach:
            along, points, gaps = face_contacts(
                vertices,
                loops,
                first_loop,
                first_face[low : low + 2],
                first_face[high : high + 2],
                rot[a],
                x[a],
                rot[b],
                x[b],
                n,
                position[deepest] - half,
                position[deepest] + half,
                reach,
                WITNESS,
                parallel,
            )
            for k in range(len(points)):
                pair[used, 0], pair[used, 1] = low, high
                normal[used], point[used], separation[used] = along, points[k], gaps[k]
                used += 1
            if len(points) == 0:
                for c in range(start, stop):
                    if distance[c] < reach:
                        pair[used, 0], pair[used, 1] = low, high
                        normal[used] = sign * frame[c, :3]
                        point[used], separation[used] = position[c], distance[c]
                        used += 1
        start = stop
    for g in moving_geoms:
        a = actor_of[geom_body[g]]
        corners = vertices[first_vertex[g] : first_vertex[g + 1]]
        points = touching_floor(corners, x[a], rot[a], height, reach)
        for k in range(len(points)):
            pair[used, 0], pair[used, 1] = g, total
            normal[used, 2] = -1.0
            point[used], separation[used] = points[k], points[k, 2] - height
            used += 1
    key = pair[:used, 0] * (total + 1) + pair[:used, 1]
    order = np.argsort(key, kind="mergesort")
    bodies, actor = np.zeros((used, 2), np.int64), np.zeros((used, 2), np.int64)
    rubbing = np.zeros((used, 3))
    for k in range(used):
        for side in range(2):
            g = pair[order[k], side]
            body = geom_body[g] if g < total else np.int64(-1)
            bodies[k, side] = body
            actor[k, side] = actor_of[body] if g < total else still
            for i in range(3):
                rubbing[k, i] += 0.5 * material[body, i]
    contacts = (key[order], actor, normal[order], point[order], separation[order], rubbing)
    return contacts, bodies


@kernel
def touching_floor(corners: Any, x: Any, rot: Any, height: float, reach: float) -> Any:
    """World positions of at most four corners lower than ``reach`` above the floor."""
    low = np.zeros((len(corners), 3))
    used = 0
    for c in range(len(corners)):
        z = x[2]
        for j in range(3):
            z += rot[2, j] * corners[c, j]
        if z < height + reach:
            for i in range(3):
                low[used, i] = x[i]
                for j in range(3):
                    low[used, i] += rot[i, j] * corners[c, j]
            used += 1
    if used <= MANIFOLD_SIZE:
        return low[:used]
    return low[spread_points(low[:used], low[:used, 2])]
