"""Contact manifolds of two convex hulls, clipped from the faces that look at each other.

MuJoCo says which hulls are close, and along which normal. For each such pair this module builds the
manifold as PhysX 4 does: take the face of each hull that looks most along the normal, clip one
against the other, and keep up to four points. Where two faces are nearly parallel this finds more
of the touching area than MuJoCo does, in particular all corners of a ball's facet on a box.

PhysX (``geomutils``, persistent contact manifold of two convex hulls): ``getWitnessPolygonIndex``
(`facing_face`), ``generatedContacts`` (`clip_faces`), ``reduceBatchContacts`` (`spread_points`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from physion.numerics.elementary import arctan2
from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import dot, ordered_mean, unit
from physion.numerics.rotations import rotation_matrix

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MANIFOLD_SIZE = 4
"""Points kept of a pair of convex hulls (PhysX)."""
MAX_POINTS = 128
"""Points of one clipping before they are reduced; further ones are dropped."""
WITNESS_DISTANCE = 0.01
"""Metres: a face is considered only if its plane passes this close to the closest point (PhysX)."""
SAME_FACE_COSINE = 1 - 1e-7
SAME_FACE_OFFSET = 1e-5
"""Triangles of a hull are one face where their normals agree by this cosine, and their offsets to
this fraction of the hull's size: what rounding leaves of a plane."""
EDGE_TOLERANCE = 1e-12
"""Square metres: a point this close to an edge (twice the area with its ends) counts as on it; and
a face whose normal has no larger component upwards is vertical, so that its plane has no height."""
MIN_LENGTH_SQUARED = 1e-20
"""Square metres that keep the line through two coinciding points from dividing by zero."""


class HullFaces(NamedTuple):
    """Corners and faces of G convex hulls, those of one hull after the other.

    - ``vertices`` (V, 3): corners in metres, in the frame of the body that the hull moves with.
    - ``first_vertex`` (G + 1,): first corner of each hull, and at the end V.
    - ``loops`` (L,): rows of ``vertices``, in order round every face.
    - ``first_loop`` (F + 1,): first entry in ``loops`` of each face, and at the end L.
    - ``first_face`` (G + 1,): first face of each hull, and at the end F.
    """

    vertices: F64
    first_vertex: I64
    loops: I64
    first_loop: I64
    first_face: I64


class HullPose(NamedTuple):
    """A hull of a pair: its number, pose, and the closest point to the other hull.

    ``hull`` is its row in `HullFaces`; ``rot`` (3, 3) and ``x`` (3,) metres place it in the world;
    ``witness`` (3,) is the closest point, in metres, world.
    """

    hull: int
    rot: F64
    x: F64
    witness: F64


class ManifoldOptions(NamedTuple):
    """Tolerances of the contact search.

    - ``contact_distance``: metres between surfaces below which points are contacts.
    - ``parallel_cosine``: least cosine between the normal and a face for faces to be clipped.
    - ``floor``: height of the floor in metres.
    """

    contact_distance: float
    parallel_cosine: float
    floor: float


class Candidates(NamedTuple):
    """Contacts as MuJoCo reports them, those of one pair in a row.

    ``geoms`` (K, 2): our numbers of the geoms. ``distance`` (K,): metres. ``position`` (K, 3):
    metres, half way between the surfaces. ``frame`` (K, 9): the normal, from the first to the
    second geom, and two tangents.
    """

    geoms: I64
    distance: F64
    position: F64
    frame: F64


class Geoms(NamedTuple):
    """What the contact search has to know of G geoms of N bodies besides their hulls.

    - ``body`` (G,): body of each geom. ``actor`` (N,): row of `Bodies` that each body moves with.
    - ``moving`` (M,): geoms of bodies that can move.
    - ``material`` (N + 1, 3): static and dynamic friction, restitution; the last row is the floor.
    """

    body: I64
    actor: I64
    moving: I64
    material: F64


def hull_faces(corners: F64) -> list[I64]:
    """Return the corner numbers of every flat face of a convex hull, in order round the face.

    ``corners`` (K, 3) are points in metres, all of them on the hull.
    """
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
        second = np.cross(normal, first)
        angle = arctan2(dot(points, second), dot(points, first))
        faces.append(used[np.argsort(angle, kind="stable")].astype(np.int64))
    return faces


@kernel
def _dot(a: F64, b: F64) -> float:
    """Return the scalar product of vectors (3,)."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@kernel
def face_normal(faces: HullFaces, f: int) -> F64:
    """Return the unit normal (3,) of face ``f``, outward, in the frame of its body.

    It is the sum of the cross products of a fan of triangles from the face's first corner.
    """
    vertices, loops, first_loop = faces.vertices, faces.loops, faces.first_loop
    a = vertices[loops[first_loop[f]]]
    total = np.zeros(3)
    for k in range(first_loop[f] + 1, first_loop[f + 1] - 1):
        u = vertices[loops[k]] - a
        w = vertices[loops[k + 1]] - a
        total[0] += u[1] * w[2] - u[2] * w[1]
        total[1] += u[2] * w[0] - u[0] * w[2]
        total[2] += u[0] * w[1] - u[1] * w[0]
    normal: F64 = total / np.sqrt(_dot(total, total))
    return normal


# The reference normal n is that of the closest points. In the frame of the hull, a face with normal
# n_f through p is chosen where n_f . n is largest among faces with |(witness - p) . n_f| <=
# WITNESS_DISTANCE; where no face is that close, among all. PhysX: `getWitnessPolygonIndex`.


@kernel
def facing_face(faces: HullFaces, pose: HullPose, normal: F64) -> tuple[int, F64, float]:
    """Return the face of a hull that looks most along a normal, near the closest point.

    Parameters
    ----------
    faces, pose
        All hulls, and the one that is asked about.
    normal : (3,)
        Unit, world, pointing to the other hull.

    Returns
    -------
    face : int
        Its number in ``faces``.
    normal : (3,)
        Its outward unit normal, world.
    cosine : float
        Of the angle between both normals.
    """
    rot, x, witness = pose.rot, pose.x, pose.witness
    start, stop = faces.first_face[pose.hull], faces.first_face[pose.hull + 1]
    local = np.zeros(3)
    closest = np.zeros(3)
    for i in range(3):
        for j in range(3):
            local[i] += rot[j, i] * normal[j]
            closest[i] += rot[j, i] * (witness[j] - x[j])
    best = -2.0
    chosen = start
    chosen_normal = np.zeros(3)
    for strict in range(2):
        for f in range(start, stop):
            p = faces.vertices[faces.loops[faces.first_loop[f]]]
            n = face_normal(faces, f)
            away = 0.0
            cosine = 0.0
            for i in range(3):
                away += (closest[i] - p[i]) * n[i]
                cosine += n[i] * local[i]
            if strict == 0 and abs(away) > WITNESS_DISTANCE:
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
def _flatten(faces: HullFaces, f: int, pose: HullPose, axes: F64) -> F64:
    """Return the corners (K, 3) of a face as coordinates (u, v, height) along ``axes`` (3, 3)."""
    start, stop = faces.first_loop[f], faces.first_loop[f + 1]
    rot, x = pose.rot, pose.x
    out = np.zeros((stop - start, 3))
    for k in range(start, stop):
        c = faces.vertices[faces.loops[k]]
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
def _inside(polygon: F64, u: float, v: float) -> bool:
    """Return whether (u, v) lies in a convex polygon (K, 2 or more) of either winding."""
    sign = 0.0
    n = len(polygon)
    for i in range(n):
        a, b = polygon[i], polygon[(i + 1) % n]
        area = (b[0] - a[0]) * (v - a[1]) - (b[1] - a[1]) * (u - a[0])
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
# with c-d. A point is a contact where it is lower than ``contact_distance`` above the reference.
# Where one face lies wholly within the other, the remaining cases add nothing and are left out.
# PhysX: `generatedContacts`.


@kernel
def clip_faces(reference: F64, incident: F64, contact_distance: float) -> F64:
    """Return the points (K, 4) where two flattened faces come closer than ``contact_distance``.

    Parameters
    ----------
    reference, incident : (R, 3), (I, 3)
        Corners in order as (u, v, height) in metres; all of ``reference`` have one height.
    contact_distance : float
        Metres.

    Returns
    -------
    (K, 4)
        u, v, height of the incident face there, and its height above the reference face. At most
        `MAX_POINTS`.
    """
    out = np.zeros((MAX_POINTS, 4))
    used = 0
    height = reference[0, 2]
    m, n = len(incident), len(reference)
    low = np.zeros(m, np.bool_)
    inside = 0
    for i in range(m):
        p = incident[i]
        low[i] = p[2] - height < contact_distance
        if low[i] and _inside(reference, p[0], p[1]) and used < MAX_POINTS:
            inside += 1
            out[used, 0], out[used, 1], out[used, 2], out[used, 3] = p[0], p[1], p[2], p[2] - height
            used += 1
    if inside == m:
        return out[:used]
    nu = nv = nw = 0.0
    for i in range(1, m - 1):
        a0, a1, a2 = incident[i] - incident[0]
        b0, b1, b2 = incident[i + 1] - incident[0]
        nu += a1 * b2 - a2 * b1
        nv += a2 * b0 - a0 * b2
        nw += a0 * b1 - a1 * b0
    inside = 0
    if abs(nw) > EDGE_TOLERANCE:
        for i in range(n):
            u, v = reference[i, 0], reference[i, 1]
            if not _inside(incident, u, v):
                continue
            z = incident[0, 2] - (nu * (u - incident[0, 0]) + nv * (v - incident[0, 1])) / nw
            if z - height < contact_distance and used < MAX_POINTS:
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
            if z - height < contact_distance and used < MAX_POINTS:
                out[used, 0] = a[0] + t * (b[0] - a[0])
                out[used, 1] = a[1] + t * (b[1] - a[1])
                out[used, 2] = z
                out[used, 3] = z - height
                used += 1
    return out[:used]


@kernel
def face_contacts(
    faces: HullFaces, a: HullPose, b: HullPose, normal: F64, options: ManifoldOptions
) -> tuple[F64, F64, F64]:
    """Return the manifold of two hulls whose closest points lie along ``normal``.

    The face that looks more exactly along the normal is the reference face, and gives the manifold
    its normal. Points lie half way between both surfaces.

    Parameters
    ----------
    faces, a, b
        All hulls, and the pair.
    normal : (3,)
        Unit, world, from a to b.
    options : ManifoldOptions
        ``contact_distance`` and ``parallel_cosine`` are used.

    Returns
    -------
    normal : (3,)
        Unit, from a to b.
    points : (K, 3)
        Metres, world. K is 0 where neither face looks along the normal well enough, or the faces do
        not overlap.
    separation : (K,)
        Metres, negative where the hulls overlap.
    """
    face_a, normal_a, cosine_a = facing_face(faces, a, normal)
    face_b, normal_b, cosine_b = facing_face(faces, b, -normal)
    b_is_reference = cosine_b >= cosine_a
    up = normal_b if b_is_reference else normal_a
    if max(cosine_a, cosine_b) < options.parallel_cosine:
        return normal, np.zeros((0, 3)), np.zeros(0)
    # Axes of the reference plane: the world axis least along the normal, made orthogonal to it.
    axes = np.zeros((3, 3))
    axes[2] = up
    least = np.argmin(np.abs(up))
    axes[0, least] = 1.0
    axes[0] -= up * up[least]
    axes[0] /= np.sqrt(_dot(axes[0], axes[0]))
    axes[1, 0] = up[1] * axes[0, 2] - up[2] * axes[0, 1]
    axes[1, 1] = up[2] * axes[0, 0] - up[0] * axes[0, 2]
    axes[1, 2] = up[0] * axes[0, 1] - up[1] * axes[0, 0]
    flat_a = _flatten(faces, face_a, a, axes)
    flat_b = _flatten(faces, face_b, b, axes)
    distance = options.contact_distance
    if b_is_reference:
        clipped = clip_faces(flat_b, flat_a, distance)
    else:
        clipped = clip_faces(flat_a, flat_b, distance)
    points = np.zeros((len(clipped), 3))
    for k in range(len(clipped)):
        middle = clipped[k, 2] - 0.5 * clipped[k, 3]
        for i in range(3):
            points[k, i] = (
                clipped[k, 0] * axes[0, i] + clipped[k, 1] * axes[1, i] + middle * axes[2, i]
            )
    separation = clipped[:, 3].copy()
    if len(clipped) > MANIFOLD_SIZE:
        chosen = spread_points(points, separation)
        points, separation = points[chosen], separation[chosen]
    return (-up if b_is_reference else up), points, separation


# Reduction to four points that span the manifold: a, the deepest; b, the farthest from a; c, the
# farthest from the line a-b; d, the farthest from that line on the side away from c. The part of
# p - a across the line is r(p) = (p - a) - ((p - a) . (b - a)) (b - a) / |b - a|^2. PhysX:
# `reduceBatchContacts`.


@kernel
def spread_points(points: F64, separation: F64) -> I64:
    """Return the rows of up to four points that stand for all: the deepest, then the most spread.

    ``points`` (K, 3) and ``separation`` (K,) are in metres; rows come sorted, each once.
    """
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
    length = max(_dot(along, along), MIN_LENGTH_SQUARED)
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
    best = -np.inf
    for i in range(len(points)):
        p = points[i] - a
        off = p - along * (_dot(p, along) / length)
        d = -_dot(off, reference)
        if d > best:
            best = d
            chosen[3] = i
    return np.unique(chosen)


# All contacts of a step. MuJoCo's contacts of a pair only say how close it is and along which
# normal: the deepest one seeds the manifold above, and they are used themselves only where the
# faces give none (edges and corners). The floor is a plane with normal z, handled apart: the lowest
# corners of every moving hull are its contacts. The material of a pair is the mean of both
# (Unity's default combine mode).


@kernel
def collect_contacts(
    candidates: Candidates,
    geoms: Geoms,
    faces: HullFaces,
    x: F64,
    q: F64,
    options: ManifoldOptions,
) -> tuple[tuple[I64, I64, F64, F64, F64, F64], I64]:
    """Return the contacts between geoms and with the floor, sorted by pair.

    Parameters
    ----------
    candidates : Candidates
        MuJoCo's contacts.
    geoms, faces
        Geoms, and the hull of each. The floor counts as geom G.
    x, q : (A + 1, 3), (A + 1, 4)
        Centres of mass in metres and orientations of all actors; the last is the world.
    options : ManifoldOptions
        Tolerances, height of the floor.

    Returns
    -------
    contacts
        The arrays of `solver_records.ContactSet`, in its order.
    bodies : (C, 2)
        The two bodies of every contact, numbered as in the scene; -1 is the floor.
    """
    pairs, distance = candidates.geoms, candidates.distance
    position, frame = candidates.position, candidates.frame
    reach = options.contact_distance
    total = len(geoms.body)
    world = len(x) - 1
    rot = np.zeros((len(x), 3, 3))
    for i in range(len(x)):
        rot[i] = rotation_matrix(q[i])
    capacity = MANIFOLD_SIZE * (len(pairs) + len(geoms.moving)) + len(pairs)
    pair = np.zeros((capacity, 2), np.int64)
    normal, point = np.zeros((capacity, 3)), np.zeros((capacity, 3))
    separation = np.zeros(capacity)
    used = 0
    start = 0
    while start < len(pairs):
        g, h = pairs[start, 0], pairs[start, 1]
        stop = start
        deepest = start
        while stop < len(pairs) and pairs[stop, 0] == g and pairs[stop, 1] == h:
            if distance[stop] < distance[deepest]:
                deepest = stop
            stop += 1
        sign = 1.0 if g < h else -1.0
        low, high = min(g, h), max(g, h)
        n = sign * frame[deepest, :3]
        half = 0.5 * distance[deepest] * n
        a, b = geoms.actor[geoms.body[low]], geoms.actor[geoms.body[high]]
        if distance[deepest] < reach:
            along, points, gaps = face_contacts(
                faces,
                HullPose(low, rot[a], x[a], position[deepest] - half),
                HullPose(high, rot[b], x[b], position[deepest] + half),
                n,
                options,
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
    for g in geoms.moving:
        a = geoms.actor[geoms.body[g]]
        corners = faces.vertices[faces.first_vertex[g] : faces.first_vertex[g + 1]]
        points = floor_contacts(corners, x[a], rot[a], options)
        for k in range(len(points)):
            pair[used, 0], pair[used, 1] = g, total
            normal[used, 2] = -1.0
            point[used], separation[used] = points[k], points[k, 2] - options.floor
            used += 1
    key = pair[:used, 0] * (total + 1) + pair[:used, 1]
    order = np.argsort(key, kind="mergesort")
    bodies, actor = np.zeros((used, 2), np.int64), np.zeros((used, 2), np.int64)
    material = np.zeros((used, 3))
    for k in range(used):
        for side in range(2):
            g = pair[order[k], side]
            body = geoms.body[g] if g < total else np.int64(-1)
            bodies[k, side] = body
            actor[k, side] = geoms.actor[body] if g < total else world
            for i in range(3):
                material[k, i] += 0.5 * geoms.material[body, i]
    contacts = (key[order], actor, normal[order], point[order], separation[order], material)
    return contacts, bodies


@kernel
def floor_contacts(corners: F64, x: F64, rot: F64, options: ManifoldOptions) -> F64:
    """Return at most four corners (K, 3) of a hull near the floor, in metres, world.

    ``corners`` (V, 3) are in the frame of the hull's body, which is at ``x`` (3,), ``rot`` (3, 3).
    Corners lower than ``contact_distance`` above the floor count.
    """
    low = np.zeros((len(corners), 3))
    used = 0
    for c in range(len(corners)):
        z = x[2]
        for j in range(3):
            z += rot[2, j] * corners[c, j]
        if z < options.floor + options.contact_distance:
            for i in range(3):
                low[used, i] = x[i]
                for j in range(3):
                    low[used, i] += rot[i, j] * corners[c, j]
            used += 1
    if used <= MANIFOLD_SIZE:
        return low[:used]
    return low[spread_points(low[:used], low[:used, 2])]
