"""Contact forces as the official simulator finds them: patches, anchors, Gauss-Seidel sweeps.

MuJoCo finds the contacts; this module turns them into velocities. The scheme is that of PhysX 4
with patch friction, the engine of Unity 2019 (its published source, ``lowleveldynamics``, says
how; everything here is written anew):

- a normal constraint for every contact point, with a bias that closes a share of the gap;
- contacts of one pair of geoms with the same normal form a patch; a patch rubs at one or two
  anchors, each with two tangents, bounded by the patch's whole normal impulse;
- anchors that did not slip stay where they were on both bodies, so that resting bodies do not
  creep;
- accumulated impulses are projected, pair after pair, in a fixed number of sweeps.

All arrays are float64 or int64. Bodies are numbered 0..B-1; row B stands for everything that does
not move (infinite mass).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import cos_of, sin_of
from physion.numerics.kernel import kernel
from physion.numerics.rotations import rotation_matrix

Array = NDArray[np.float64]
Index = NDArray[np.int64]

DIRECTION, ARM_A, ARM_B, TURN_A, TURN_B = 0, 3, 6, 9, 12
GAIN, BIAS, TARGET, SEPARATION = 15, 16, 17, 18
ROW_WIDTH = 19
"""Columns of a constraint row: direction from body a to b, lever arms crossed with it (what spin
adds to the speed), those times inverse inertia (what an impulse adds to the spin), impulse per
speed, speed of correction, target speed, separation."""


class ContactSet(NamedTuple):
    """Contacts of one step, sorted by ``key``.

    ``key`` (C,) names the pair of geoms; ``bodies`` (C, 2); ``normal`` (C, 3) from the first to
    the second body; ``point`` (C, 3) metres, world; ``separation`` (C,) metres, negative inside;
    ``material`` (C, 3): static friction, dynamic friction, restitution of the pair.
    """

    key: Index
    bodies: Index
    normal: Array
    point: Array
    separation: Array
    material: Array


class AnchorMemory(NamedTuple):
    """Friction anchors that held in the last step.

    ``key`` (A,) and number of ``anchors`` (A,) of every patch; ``normals`` (A, 2, 3) and ``points``
    (A, 2, 2, 3) in the frames of both bodies: [patch, body, anchor, axis].
    """

    key: Index
    anchors: Index
    normals: Array
    points: Array


def no_anchors() -> AnchorMemory:
    """The memory before the first step."""
    return AnchorMemory(
        np.zeros(0, np.int64),
        np.zeros(0, np.int64),
        np.zeros((0, 2, 3)),
        np.zeros((0, 2, 2, 3)),
    )


@kernel
def _to_world(rot: Any, x: Any, local: Any, out: Any) -> None:
    for i in range(3):
        out[i] = x[i] + rot[i, 0] * local[0] + rot[i, 1] * local[1] + rot[i, 2] * local[2]


@kernel
def _to_local(rot: Any, x: Any, world: Any, out: Any) -> None:
    a, b, c = world[0] - x[0], world[1] - x[1], world[2] - x[2]
    for i in range(3):
        out[i] = rot[0, i] * a + rot[1, i] * b + rot[2, i] * c


@kernel
def _to_world_axes(rot: Any, local: Any, out: Any) -> None:
    """Fill ``out`` with R L R^T: a matrix (3, 3) of the body's frame in the axes of the world."""
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for k in range(3):
                along = rot[i, 0] * local[0, k] + rot[i, 1] * local[1, k] + rot[i, 2] * local[2, k]
                out[i, j] += along * rot[j, k]


@kernel
def _squared_distance(a: Any, b: Any) -> Any:
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@kernel
def _fill_row(
    row: Any, a: int, b: int, ra: Any, rb: Any, d: Any, inv_mass: Any, inv_inertia: Any
) -> Any:
    """Write direction, arms and turns of a row; return the speed that a unit impulse makes."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        row[DIRECTION + i] = d[i]
        row[ARM_A + i] = ra[j] * d[k] - ra[k] * d[j]
        row[ARM_B + i] = rb[j] * d[k] - rb[k] * d[j]
    response = inv_mass[a] + inv_mass[b]
    for i in range(3):
        ta = 0.0
        tb = 0.0
        for j in range(3):
            ta += inv_inertia[a, i, j] * row[ARM_A + j]
            tb += inv_inertia[b, i, j] * row[ARM_B + j]
        row[TURN_A + i] = ta
        row[TURN_B + i] = tb
    for i in range(3):
        response += row[ARM_A + i] * row[TURN_A + i] + row[ARM_B + i] * row[TURN_B + i]
    return response


@kernel
def _speed(row: Any, a: int, b: int, v: Any, w: Any) -> Any:
    s = 0.0
    for i in range(3):
        s += row[DIRECTION + i] * (v[b, i] - v[a, i])
        s += row[ARM_B + i] * w[b, i] - row[ARM_A + i] * w[a, i]
    return s


@kernel
def _push(row: Any, a: int, b: int, impulse: float, v: Any, w: Any, inv_mass: Any) -> None:
    for i in range(3):
        v[a, i] -= row[DIRECTION + i] * impulse * inv_mass[a]
        v[b, i] += row[DIRECTION + i] * impulse * inv_mass[b]
        w[a, i] -= row[TURN_A + i] * impulse
        w[b, i] += row[TURN_B + i] * impulse


@kernel
def _tangent(normal: Any, relative: Any, out: Any) -> None:
    """First friction direction: along the slip of the centres, or an axis when there is little."""
    along = normal[0] * relative[0] + normal[1] * relative[1] + normal[2] * relative[2]
    size = 0.0
    for i in range(3):
        out[i] = relative[i] - along * normal[i]
        size += out[i] ** 2
    if size <= 0.1:
        if abs(normal[0]) < 0.70710678:
            out[0], out[1], out[2] = 0.0, -normal[2], normal[1]
        else:
            out[0], out[1], out[2] = -normal[1], normal[0], 0.0
        size = out[0] ** 2 + out[1] ** 2 + out[2] ** 2
    scale = 1.0 / np.sqrt(size)
    for i in range(3):
        out[i] *= scale


@kernel
def find_patches(
    contacts: Any, memory: Any, x: Any, rot: Any, patch_cosine: float, anchor_distance: float
) -> Any:
    """Group contacts into patches and take over the anchors that still fit.

    Returns, for every patch: key, bodies, normal, number of anchors, anchors in body frames, and
    for every contact its patch.
    """
    total = len(contacts.key)
    room = total + len(memory.key)
    patch_of = np.full(total, -1, np.int64)
    first = np.zeros(room, np.int64)
    bodies = np.zeros((room, 2), np.int64)
    normals = np.zeros((room, 3))
    count = np.zeros(room, np.int64)
    anchors = np.zeros((room, 2, 2, 3))
    used = 0
    start = 0
    na, nb, pa, pb = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    zero = np.zeros(3)
    while start < total:
        stop = start
        key = contacts.key[start]
        while stop < total and contacts.key[stop] == key:
            stop += 1
        a, b = contacts.bodies[start, 0], contacts.bodies[start, 1]
        base = used
        for m in range(len(memory.key)):
            if memory.key[m] != key:
                continue
            _to_world(rot[a], zero, memory.normals[m, 0], na)
            _to_world(rot[b], zero, memory.normals[m, 1], nb)
            if na[0] * nb[0] + na[1] * nb[1] + na[2] * nb[2] <= patch_cosine:
                continue
            keep = True
            for k in range(memory.anchors[m]):
                _to_world(rot[a], x[a], memory.points[m, 0, k], pa)
                _to_world(rot[b], x[b], memory.points[m, 1, k], pb)
                gap = 0.0
                for i in range(3):
                    gap += (pa[i] - pb[i]) * na[i]
                keep = keep and abs(gap) < anchor_distance
            if keep:
                first[used] = -1
                bodies[used, 0], bodies[used, 1] = a, b
                normals[used] = na
                count[used] = memory.anchors[m]
                anchors[used] = memory.points[m]
                used += 1
        for c in range(start, stop):
            n = contacts.normal[c]
            found = -1
            for p in range(base, used):
                q = normals[p]
                if n[0] * q[0] + n[1] * q[1] + n[2] * q[2] >= patch_cosine:
                    found = p
                    break
            if found < 0:
                found = used
                first[used] = -1
                bodies[used, 0], bodies[used, 1] = a, b
                normals[used] = n
                used += 1
            if first[found] < 0:
                first[found] = c
            patch_of[c] = found
        start = stop
    return first[:used], bodies[:used], normals[:used], count[:used], anchors[:used], patch_of


@kernel
def place_anchors(
    contacts: Any,
    patch_of: Any,
    patch: int,
    a: int,
    b: int,
    count: Any,
    anchors: Any,
    x: Any,
    rot: Any,
    anchor_distance: float,
    anchor_gap: float,
) -> None:
    """Give a patch up to two anchors: contact points that lie far apart; old ones stay."""
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for c in range(len(patch_of)):
        if patch_of[c] == patch:
            for i in range(3):
                low[i] = min(low[i], contacts.point[c, i])
                high[i] = max(high[i], contacts.point[c, i])
    if count[patch] == 2:
        spread = _squared_distance(anchors[patch, 0, 0], anchors[patch, 0, 1])
        if 4.0 * spread >= _squared_distance(low, high):
            return
        # Anchors huddled in a corner of the patch hold it badly: choose again.
        count[patch] = 0
    world = np.zeros((2, 3))
    old = count[patch]
    have = old
    if old == 1:
        _to_world(rot[a], x[a], anchors[patch, 0, 0], world[0])
    between = 0.0
    for c in range(len(patch_of)):
        if patch_of[c] != patch or contacts.separation[c] >= anchor_gap:
            continue
        point = contacts.point[c]
        if have == 0:
            world[0] = point
            have = 1
        elif have == 1:
            between = _squared_distance(point, world[0])
            if between > anchor_distance**2:
                world[1] = point
                have = 2
        else:
            d0 = _squared_distance(point, world[0])
            d1 = _squared_distance(point, world[1])
            if d0 > d1:
                if d0 > between:
                    world[1] = point
                    between = d0
            elif d1 > between:
                world[0] = point
                between = d1
    for k in range(old, have):
        _to_local(rot[a], x[a], world[k], anchors[patch, 0, k])
        _to_local(rot[b], x[b], world[k], anchors[patch, 1, k])
    count[patch] = have


@kernel
def normal_rows(
    contacts: Any,
    x: Any,
    v: Any,
    w: Any,
    inv_mass: Any,
    inv_inertia: Any,
    dt: float,
    bias: float,
    max_depenetration: float,
    bounce_threshold: float,
) -> Any:
    """One row for each contact: biased correction speed, target speed of a bounce."""
    total = len(contacts.key)
    rows = np.zeros((total, ROW_WIDTH))
    for c in range(total):
        a, b = contacts.bodies[c, 0], contacts.bodies[c, 1]
        ra = contacts.point[c] - x[a]
        rb = contacts.point[c] - x[b]
        row = rows[c]
        response = _fill_row(row, a, b, ra, rb, contacts.normal[c], inv_mass, inv_inertia)
        row[GAIN] = 1.0 / response if response > 0 else 0.0
        separation = contacts.separation[c]
        row[SEPARATION] = separation
        speed = _speed(row, a, b, v, w)
        restitution = contacts.material[c, 2]
        # A bounce needs a fast approach that meets the surface within this step.
        bounces = restitution > 0 and speed < -bounce_threshold and -speed > separation / dt
        if bounces:
            row[TARGET] = -restitution * speed
        else:
            row[BIAS] = max(-max_depenetration, separation * bias / dt)
    return rows


@kernel
def friction_rows(
    bodies: Any,
    normals: Any,
    count: Any,
    anchors: Any,
    x: Any,
    rot: Any,
    v: Any,
    inv_mass: Any,
    inv_inertia: Any,
    dt: float,
    friction_gain: float,
) -> Any:
    """Two rows for each anchor: [patch, anchor, tangent, column]."""
    patches = len(count)
    rows = np.zeros((patches, 2, 2, ROW_WIDTH))
    tangents = np.zeros((2, 3))
    pa, pb = np.zeros(3), np.zeros(3)
    for p in range(patches):
        a, b = bodies[p, 0], bodies[p, 1]
        n = normals[p]
        _tangent(n, v[b] - v[a], tangents[0])
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            tangents[1, i] = n[j] * tangents[0, k] - n[k] * tangents[0, j]
        for k in range(count[p]):
            _to_world(rot[a], x[a], anchors[p, 0, k], pa)
            _to_world(rot[b], x[b], anchors[p, 1, k], pb)
            for t in range(2):
                row = rows[p, k, t]
                d = tangents[t]
                response = _fill_row(row, a, b, pa - x[a], pb - x[b], d, inv_mass, inv_inertia)
                row[GAIN] = friction_gain / response if response > 0 else 0.0
                slip = 0.0
                for i in range(3):
                    slip += (pb[i] - pa[i]) * d[i]
                row[BIAS] = slip / dt
    return rows


@kernel
def solving_order(key: Any, bodies: Any, still: int) -> Any:
    """The order of patches: pairs of moving bodies first, what rests on still things last.

    Pairs of moving bodies are dealt into rounds in which no body comes twice; a pair with a still
    body gets a round after all others of its moving body.
    """
    patches = len(key)
    rounds = np.zeros(patches, np.int64)
    taken = np.zeros((still + 1, 64), np.bool_)
    last = np.zeros(still + 1, np.int64)
    p = 0
    while p < patches:
        q = p
        while q < patches and key[q] == key[p]:
            q += 1
        a, b = bodies[p, 0], bodies[p, 1]
        if a != still and b != still:
            r = 0
            while r < 63 and (taken[a, r] or taken[b, r]):
                r += 1
            taken[a, r] = True
            taken[b, r] = True
            last[a] = max(last[a], r + 1)
            last[b] = max(last[b], r + 1)
            rounds[p:q] = r
        p = q
    p = 0
    while p < patches:
        q = p
        while q < patches and key[q] == key[p]:
            q += 1
        a, b = bodies[p, 0], bodies[p, 1]
        if a == still or b == still:
            moving = b if a == still else a
            rounds[p:q] = last[moving]
            last[moving] += 1
        p = q
    return np.argsort(rounds, kind="mergesort")


@kernel
def _sweep(
    order: Any,
    starts: Any,
    members: Any,
    bodies: Any,
    material: Any,
    count: Any,
    normal: Any,
    friction: Any,
    load: Any,
    rub: Any,
    slipped: Any,
    rubs: bool,
    biased: bool,
    share: bool,
    v: Any,
    w: Any,
    inv_mass: Any,
) -> None:
    """One Gauss-Seidel sweep over all patches: first a patch's normals, then its friction."""
    for p in order:
        a, b = bodies[p, 0], bodies[p, 1]
        pressed = 0.0
        for m in range(starts[p], starts[p + 1]):
            c = members[m]
            row = normal[c]
            correction = row[BIAS] if biased else max(row[BIAS], 0.0)
            change = row[GAIN] * (row[TARGET] - correction - _speed(row, a, b, v, w))
            change = max(change, -load[c])
            load[c] += change
            pressed += load[c]
            _push(row, a, b, change, v, w, inv_mass)
        if not rubs or count[p] == 0:
            continue
        fraction = 1.0 / count[p] if share else 1.0
        hold = material[p, 0] * pressed * fraction
        slide = material[p, 1] * pressed * fraction
        broken = False
        for k in range(count[p]):
            for t in range(2):
                row = friction[p, k, t]
                correction = row[BIAS] if biased else 0.0
                want = rub[p, k, t] - row[GAIN] * (_speed(row, a, b, v, w) + correction)
                if abs(want) > hold:
                    broken = True
                    want = min(max(want, -slide), slide)
                _push(row, a, b, want - rub[p, k, t], v, w, inv_mass)
                rub[p, k, t] = want
        slipped[p] = broken


@kernel
def solve_step(
    contacts: Any,
    memory: Any,
    x: Any,
    q: Any,
    v: Any,
    w: Any,
    inv_mass: Any,
    inv_inertia_body: Any,
    dt: float,
    position_iterations: int,
    velocity_iterations: int,
    friction_sweeps: int,
    share: bool,
    bias: float,
    max_depenetration: float,
    bounce_threshold: float,
    friction_gain: float,
    patch_cosine: float,
    anchor_distance: float,
    anchor_gap: float,
) -> Any:
    """Change ``v`` and ``w`` by the contact forces of a step.

    Returns the velocities that move the poses (before bias-free sweeps), the normal impulse of
    every contact, and the anchors to remember: key, count, normals, points.
    """
    still = len(inv_mass) - 1
    rot = np.zeros((still + 1, 3, 3))
    inv_inertia = np.zeros((still + 1, 3, 3))
    for i in range(still + 1):
        rot[i] = rotation_matrix(q[i])
        _to_world_axes(rot[i], inv_inertia_body[i], inv_inertia[i])
    first, bodies, normals, count, anchors, patch_of = find_patches(
        contacts, memory, x, rot, patch_cosine, anchor_distance
    )
    # Anchors without a contact in this step are forgotten.
    keep = np.flatnonzero(first >= 0)
    renamed = np.full(len(first), -1, np.int64)
    for i in range(len(keep)):
        renamed[keep[i]] = i
    for c in range(len(patch_of)):
        patch_of[c] = renamed[patch_of[c]]
    first, bodies, normals = first[keep], bodies[keep], normals[keep]
    count, anchors = count[keep], anchors[keep]
    patches = len(first)
    for p in range(patches):
        a, b = bodies[p, 0], bodies[p, 1]
        # Rows use the normal of this step's contacts, also when the anchors are older.
        normals[p] = contacts.normal[first[p]]
        place_anchors(
            contacts, patch_of, p, a, b, count, anchors, x, rot, anchor_distance, anchor_gap
        )
    normal = normal_rows(
        contacts, x, v, w, inv_mass, inv_inertia, dt, bias, max_depenetration, bounce_threshold
    )
    friction = friction_rows(
        bodies, normals, count, anchors, x, rot, v, inv_mass, inv_inertia, dt, friction_gain
    )
    members = np.argsort(patch_of, kind="mergesort")
    starts = np.zeros(patches + 1, np.int64)
    for c in range(len(patch_of)):
        starts[patch_of[c] + 1] += 1
    starts = np.cumsum(starts)
    key = contacts.key[first]
    material = contacts.material[first]
    order = solving_order(key, bodies, still)
    load = np.zeros(len(patch_of))
    rub = np.zeros((patches, 2, 2))
    slipped = np.zeros(patches, np.bool_)
    for i in range(position_iterations):
        left = position_iterations - i
        rubs = friction_sweeps == 0 or left <= friction_sweeps
        _sweep(
            order, starts, members, bodies, material, count, normal, friction, load, rub,
            slipped, rubs, True, share, v, w, inv_mass,
        )  # fmt: skip
    move_v, move_w = v.copy(), w.copy()
    for _ in range(velocity_iterations):
        _sweep(
            order, starts, members, bodies, material, count, normal, friction, load, rub,
            slipped, True, False, share, v, w, inv_mass,
        )  # fmt: skip
    holds = np.flatnonzero(~slipped & (count > 0))
    local = np.zeros((len(holds), 2, 3))
    for i in range(len(holds)):
        p = holds[i]
        for side in range(2):
            r = rot[bodies[p, side]]
            for j in range(3):
                for k in range(3):
                    local[i, side, j] += r[k, j] * normals[p, k]
    return move_v, move_w, load, key[holds], count[holds], local, anchors[holds]


@kernel
def move_freely(
    v: Any, w: Any, awake: Any, drag: Any, gravity: float, max_angular_velocity: float, dt: float
) -> None:
    """Change ``v`` and ``w`` (A + 1, 3) by a step of gravity and drag, and cap the spin.

    v <- (v - g dt z) max(1 - c dt, 0), w <- w max(1 - d dt, 0) with the linear and angular drag
    ``drag`` (A, 2) per second; gravity acts where ``awake`` (A,).
    """
    for i in range(len(awake)):
        if awake[i]:
            v[i, 2] -= gravity * dt
        keep_v, keep_w = max(1.0 - drag[i, 0] * dt, 0.0), max(1.0 - drag[i, 1] * dt, 0.0)
        for j in range(3):
            v[i, j] *= keep_v
            w[i, j] *= keep_w
        speed = np.sqrt(w[i, 0] * w[i, 0] + w[i, 1] * w[i, 1] + w[i, 2] * w[i, 2])
        factor = min(1.0, max_angular_velocity / max(speed, 1e-12))
        for j in range(3):
            w[i, j] *= factor


@kernel
def move_poses(x: Any, q: Any, v: Any, w: Any, dt: float) -> None:
    """Move centres of mass and turn orientations by constant velocities over a step."""
    for i in range(len(x) - 1):
        for j in range(3):
            x[i, j] += v[i, j] * dt
        speed = np.sqrt(w[i, 0] ** 2 + w[i, 1] ** 2 + w[i, 2] ** 2)
        if speed == 0.0:
            continue
        half = 0.5 * speed * dt
        c, s = cos_of(half), sin_of(half) / speed
        dx, dy, dz = w[i, 0] * s, w[i, 1] * s, w[i, 2] * s
        qw, qx, qy, qz = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
        q[i, 0] = c * qw - dx * qx - dy * qy - dz * qz
        q[i, 1] = c * qx + dx * qw + dy * qz - dz * qy
        q[i, 2] = c * qy - dx * qz + dy * qw + dz * qx
        q[i, 3] = c * qz + dx * qy - dy * qx + dz * qw
        q[i] /= np.sqrt(q[i, 0] ** 2 + q[i, 1] ** 2 + q[i, 2] ** 2 + q[i, 3] ** 2)
