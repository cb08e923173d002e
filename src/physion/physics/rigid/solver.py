"""Contact solver: projected Gauss-Seidel on impulses with friction patches, after PhysX 4.

MuJoCo finds the contacts; this module turns them into changes of velocity. The scheme is that of
PhysX 4, the engine of Unity 2019, with patch friction. Its published source (``lowleveldynamics``)
says what it does; everything here is written anew, and functions of that source are named where a
phase follows them.

A constraint row with Jacobian J acts on the velocities of a pair of bodies a and b. Along a
direction d, at a point with lever arms r_a and r_b,

    J v = d . (v_b - v_a) + (r_b x d) . w_b - (r_a x d) . w_a        (relative speed, m/s)
    m   = 1 / (J M^-1 J^T)                                           (effective mass, kg)

and an impulse lambda (N s) changes the velocities by M^-1 J^T lambda. A step has five phases:

1. `find_patches`: contacts of a pair of geoms with one normal form a patch; patches keep the
   friction anchors of the step before.
2. `grow_anchors`: a patch gets up to two friction anchors, points held by friction.
3. `normal_rows`, `friction_rows`: one row for each contact, two for each anchor.
4. `sweep`: accumulated impulses are improved row after row, a fixed number of times.
5. `remember_anchors`: anchors that did not slip are kept for the next step, so that resting bodies
   do not creep.

Bodies are numbered 0..B-1; row B stands for everything that does not move (infinite mass). The
order of all operations is fixed, so equal input gives equal bytes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import cos_of, sin_of
from physion.numerics.kernel import kernel
from physion.numerics.rotations import rotation_matrix

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Flags = NDArray[np.bool_]

DIRECTION, ANGULAR_A, ANGULAR_B, SPIN_A, SPIN_B = 0, 3, 6, 9, 12
EFFECTIVE_MASS, BIAS, TARGET, SEPARATION = 15, 16, 17, 18
ROW_WIDTH = 19
"""Columns of a constraint row.

``DIRECTION`` (3): d, from body a to b. ``ANGULAR_A``, ``ANGULAR_B`` (3 each): r x d, the angular
part of J. ``SPIN_A``, ``SPIN_B`` (3 each): I^-1 (r x d), the angular velocity per impulse.
``EFFECTIVE_MASS``: m in kg (of friction rows times ``friction_gain``). ``BIAS``: speed in m/s that
corrects the position. ``TARGET``: relative speed in m/s after a bounce. ``SEPARATION``: metres.
"""

MAX_ANCHORS = 2
"""Friction anchors of a patch (PhysX's ``FrictionPatch`` has room for two)."""
MIN_SQUARED_SLIP = 0.1
"""Squared speed (m/s)^2 of sliding above which the first tangent follows it; below, the direction
would be noise (constant ``p1`` of PhysX's ``setupFinalizeSolverConstraints4``)."""
ORTHOGONAL_COSINE = 0.70710678
"""cos 45 degrees (PhysX's ``orthoThreshold``): a normal farther than that from the x axis is
crossed with x to get a tangent, any other with z, so that the product is never short."""
MIN_ANCHOR_SPREAD = 4.0
"""Two anchors are kept while the diagonal of the patch is at most twice their distance: its square
is at most this many times theirs."""
MAX_PARTITIONS = 64
"""Partitions of the solving order that pairs of moving bodies are spread over."""
MIN_SPIN = 1e-12
"""Radians per second: keeps the cap of the angular velocity from dividing by zero."""


class Bodies(NamedTuple):
    """Bodies that move, and as last row the world.

    - ``x`` (B + 1, 3): centres of mass in metres; ``q`` (B + 1, 4): orientations (w, x, y, z).
    - ``v``, ``w`` (B + 1, 3): velocities in m/s, angular velocities in rad/s, world axes.
    - ``inv_mass`` (B + 1,) in 1/kg and ``inv_inertia`` (B + 1, 3, 3) in 1/(kg m^2), the latter in
      body axes; 0 for what does not give way.
    """

    x: F64
    q: F64
    v: F64
    w: F64
    inv_mass: F64
    inv_inertia: F64


class ContactSet(NamedTuple):
    """Contacts of one step, sorted by ``key``.

    - ``key`` (C,): names the pair of geoms. ``bodies`` (C, 2): rows of `Bodies`.
    - ``normal`` (C, 3): unit, from the first to the second body. ``point`` (C, 3): metres, world.
    - ``separation`` (C,): metres, negative where the surfaces overlap.
    - ``material`` (C, 3): static friction, dynamic friction and restitution of the pair.
    """

    key: I64
    bodies: I64
    normal: F64
    point: F64
    separation: F64
    material: F64


class AnchorMemory(NamedTuple):
    """Friction anchors that held in the last step.

    - ``key`` (A,): pair of geoms of every patch. ``anchor_count`` (A,): 1 or 2.
    - ``normal`` (A, 2, 3), ``point`` (A, 2, 2, 3): normal and anchors in the frames of both bodies:
      [patch, body, axis] and [patch, body, anchor, axis].
    """

    key: I64
    anchor_count: I64
    normal: F64
    point: F64


class SolverOptions(NamedTuple):
    """Numbers of the solver; see `physion.physics.rigid.settings.RigidSettings` for each.

    ``divide_friction``: the anchors of a patch share its friction limit (Coulomb's law); otherwise
    each of them may use the whole of it.
    """

    dt: float
    position_iterations: int
    velocity_iterations: int
    friction_sweeps: int
    divide_friction: bool
    bias: float
    max_depenetration_speed: float
    bounce_threshold: float
    friction_gain: float
    patch_cosine: float
    anchor_distance: float
    anchor_gap: float


class StepResult(NamedTuple):
    """What a step of the solver gives besides the changed velocities.

    ``move_v``, ``move_w`` (B + 1, 3): velocities that move the poses, with the speed that corrects
    penetration. ``normal_impulse`` (C,): N s of every contact. ``anchors``: for the next step.
    """

    move_v: F64
    move_w: F64
    normal_impulse: F64
    anchors: AnchorMemory


class SolverBodies(NamedTuple):
    """`Bodies` with rotation matrices ``rot`` (B + 1, 3, 3) and ``inv_inertia`` in world axes."""

    x: F64
    rot: F64
    v: F64
    w: F64
    inv_mass: F64
    inv_inertia: F64


class Patches(NamedTuple):
    """Friction patches of one step, P of them.

    - ``first`` (P,): first contact of each, -1 without any. ``bodies`` (P, 2): rows of `Bodies`.
    - ``normal`` (P, 3): unit, world. ``anchor_count`` (P,): 0 to 2.
    - ``anchor`` (P, 2, 2, 3): anchors in the frames of both bodies: [patch, body, anchor, axis].
    """

    first: I64
    bodies: I64
    normal: F64
    anchor_count: I64
    anchor: F64


class Constraints(NamedTuple):
    """All rows of one step and their accumulated impulses.

    - ``order`` (P,): patches in the order of solving.
    - ``contact`` (C,): contacts sorted by patch; those of patch p are ``contact[start[p] :
      start[p + 1]]`` with ``start`` (P + 1,).
    - ``material`` (P, 3): static and dynamic friction, restitution.
    - ``normal`` (C, ROW_WIDTH), ``friction`` (P, 2, 2, ROW_WIDTH): rows; the latter are
      [patch, anchor, tangent].
    - ``normal_impulse`` (C,), ``friction_impulse`` (P, 2, 2): N s, accumulated.
    - ``slipped`` (P,): the static friction limit was passed in the last sweep.
    """

    order: I64
    start: I64
    contact: I64
    material: F64
    normal: F64
    friction: F64
    normal_impulse: F64
    friction_impulse: F64
    slipped: Flags


def no_anchors() -> AnchorMemory:
    """Return the anchor memory before the first step."""
    return AnchorMemory(
        np.zeros(0, np.int64),
        np.zeros(0, np.int64),
        np.zeros((0, 2, 3)),
        np.zeros((0, 2, 2, 3)),
    )


@kernel
def _to_world(rot: F64, x: F64, local: F64, out: F64) -> None:
    """Fill ``out`` (3,) with x + R local."""
    for i in range(3):
        out[i] = x[i] + rot[i, 0] * local[0] + rot[i, 1] * local[1] + rot[i, 2] * local[2]


@kernel
def _to_local(rot: F64, x: F64, world: F64, out: F64) -> None:
    """Fill ``out`` (3,) with R^T (world - x)."""
    a, b, c = world[0] - x[0], world[1] - x[1], world[2] - x[2]
    for i in range(3):
        out[i] = rot[0, i] * a + rot[1, i] * b + rot[2, i] * c


@kernel
def _to_world_axes(rot: F64, local: F64, out: F64) -> None:
    """Fill ``out`` (3, 3) with R L R^T: a matrix of the body's frame in world axes."""
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for k in range(3):
                along = rot[i, 0] * local[0, k] + rot[i, 1] * local[1, k] + rot[i, 2] * local[2, k]
                out[i, j] += along * rot[j, k]


@kernel
def _squared_distance(a: F64, b: F64) -> float:
    """Return |a - b|^2 of points (3,)."""
    return float((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@kernel
def _fill_row(
    row: F64, a: int, b: int, arm_a: F64, arm_b: F64, d: F64, bodies: SolverBodies
) -> float:
    """Write direction and angular columns of a row; return J M^-1 J^T, 1 / effective mass.

    J M^-1 J^T = 1/m_a + 1/m_b + (r_a x d) . I_a^-1 (r_a x d) + (r_b x d) . I_b^-1 (r_b x d),
    with ``arm_a``, ``arm_b`` (3,) the lever arms r in metres and ``d`` (3,) the direction.
    """
    inv_inertia = bodies.inv_inertia
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        row[DIRECTION + i] = d[i]
        row[ANGULAR_A + i] = arm_a[j] * d[k] - arm_a[k] * d[j]
        row[ANGULAR_B + i] = arm_b[j] * d[k] - arm_b[k] * d[j]
    inverse_mass = bodies.inv_mass[a] + bodies.inv_mass[b]
    for i in range(3):
        spin_a = 0.0
        spin_b = 0.0
        for j in range(3):
            spin_a += inv_inertia[a, i, j] * row[ANGULAR_A + j]
            spin_b += inv_inertia[b, i, j] * row[ANGULAR_B + j]
        row[SPIN_A + i] = spin_a
        row[SPIN_B + i] = spin_b
    for i in range(3):
        inverse_mass += row[ANGULAR_A + i] * row[SPIN_A + i] + row[ANGULAR_B + i] * row[SPIN_B + i]
    return float(inverse_mass)


@kernel
def _relative_speed(row: F64, a: int, b: int, v: F64, w: F64) -> float:
    """Return J v of a row in m/s: positive where the bodies part."""
    speed = 0.0
    for i in range(3):
        speed += row[DIRECTION + i] * (v[b, i] - v[a, i])
        speed += row[ANGULAR_B + i] * w[b, i] - row[ANGULAR_A + i] * w[a, i]
    return speed


@kernel
def _apply_impulse(row: F64, a: int, b: int, impulse: float, v: F64, w: F64, inv_mass: F64) -> None:
    """Add M^-1 J^T ``impulse`` (N s) to the velocities of a row's bodies."""
    for i in range(3):
        v[a, i] -= row[DIRECTION + i] * impulse * inv_mass[a]
        v[b, i] += row[DIRECTION + i] * impulse * inv_mass[b]
        w[a, i] -= row[SPIN_A + i] * impulse
        w[b, i] += row[SPIN_B + i] * impulse


@kernel
def first_tangent(normal: F64, relative: F64, out: F64) -> None:
    """Fill ``out`` (3,) with the first friction direction, a unit vector across ``normal`` (3,).

    It lies along the sliding part of ``relative`` (3,), the velocity in m/s of the second centre of
    mass against the first; where that is slow (`MIN_SQUARED_SLIP`), along a fixed axis.
    """
    along = normal[0] * relative[0] + normal[1] * relative[1] + normal[2] * relative[2]
    size = 0.0
    for i in range(3):
        out[i] = relative[i] - along * normal[i]
        size += out[i] ** 2
    if size <= MIN_SQUARED_SLIP:
        if abs(normal[0]) < ORTHOGONAL_COSINE:
            out[0], out[1], out[2] = 0.0, -normal[2], normal[1]
        else:
            out[0], out[1], out[2] = -normal[1], normal[0], 0.0
        size = out[0] ** 2 + out[1] ** 2 + out[2] ** 2
    scale = 1.0 / np.sqrt(size)
    for i in range(3):
        out[i] *= scale


# Phase 1: patches.
#
# A remembered patch of the same pair of geoms is taken over while both bodies still agree about it:
#     (R_a n_a) . (R_b n_b) > patch_cosine   and   |(p_a - p_b) . n| < anchor_distance per anchor,
# where n_a, n_b and p_a, p_b are its normal and anchors as each body carries them along. Each
# contact then joins the first patch of its pair whose normal agrees with its own, or opens one.
# PhysX: `getFrictionPatches` (what is kept), `createContactPatches` and `correlatePatches` (which
# contact joins which patch; its PXC_SAME_NORMAL is our patch_cosine). Deviations: contacts are
# grouped by pair of convex pieces, as MuJoCo reports them, not by pair of bodies; materials are not
# compared, since a pair of geoms has one; contacts of a patch need not follow one another.


@kernel
def find_patches(
    contacts: ContactSet, memory: AnchorMemory, bodies: SolverBodies, options: SolverOptions
) -> tuple[Patches, I64]:
    """Group contacts into patches and take over the anchors that still fit.

    Parameters
    ----------
    contacts, memory, bodies, options
        Contacts of this step, anchors of the last one, poses (world axes), thresholds.

    Returns
    -------
    patches : Patches
        Those of the memory come before new ones of the same pair; some have no contact.
    patch_of : (C,)
        The patch of every contact.
    """
    x, rot = bodies.x, bodies.rot
    total = len(contacts.key)
    capacity = total + len(memory.key)
    patch_of = np.full(total, -1, np.int64)
    first = np.zeros(capacity, np.int64)
    pair = np.zeros((capacity, 2), np.int64)
    normal = np.zeros((capacity, 3))
    count = np.zeros(capacity, np.int64)
    anchor = np.zeros((capacity, 2, 2, 3))
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
            _to_world(rot[a], zero, memory.normal[m, 0], na)
            _to_world(rot[b], zero, memory.normal[m, 1], nb)
            if na[0] * nb[0] + na[1] * nb[1] + na[2] * nb[2] <= options.patch_cosine:
                continue
            keep = True
            for k in range(memory.anchor_count[m]):
                _to_world(rot[a], x[a], memory.point[m, 0, k], pa)
                _to_world(rot[b], x[b], memory.point[m, 1, k], pb)
                gap = 0.0
                for i in range(3):
                    gap += (pa[i] - pb[i]) * na[i]
                keep = keep and abs(gap) < options.anchor_distance
            if keep:
                first[used] = -1
                pair[used, 0], pair[used, 1] = a, b
                normal[used] = na
                count[used] = memory.anchor_count[m]
                anchor[used] = memory.point[m]
                used += 1
        for c in range(start, stop):
            n = contacts.normal[c]
            patch = -1
            for p in range(base, used):
                q = normal[p]
                if n[0] * q[0] + n[1] * q[1] + n[2] * q[2] >= options.patch_cosine:
                    patch = p
                    break
            if patch < 0:
                patch = used
                first[used] = -1
                pair[used, 0], pair[used, 1] = a, b
                normal[used] = n
                used += 1
            if first[patch] < 0:
                first[patch] = c
            patch_of[c] = patch
        start = stop
    patches = Patches(first[:used], pair[:used], normal[:used], count[:used], anchor[:used])
    return patches, patch_of


@kernel
def drop_patches_without_contact(patches: Patches, patch_of: I64) -> Patches:
    """Return the patches that have a contact, and renumber ``patch_of`` (C,) to match.

    Anchors of a patch without contact in this step are forgotten.
    """
    keep = np.flatnonzero(patches.first >= 0)
    renumbered = np.full(len(patches.first), -1, np.int64)
    for i in range(len(keep)):
        renumbered[keep[i]] = i
    for c in range(len(patch_of)):
        patch_of[c] = renumbered[patch_of[c]]
    return Patches(
        patches.first[keep],
        patches.bodies[keep],
        patches.normal[keep],
        patches.anchor_count[keep],
        patches.anchor[keep],
    )


# Phase 2: anchors.
#
# A patch is held at up to two contact points that lie far apart: the first candidate, then whatever
# lies farther than anchor_distance from it, then each further point replaces the nearer of the two
# where that lengthens their distance. Two old anchors stay, unless the patch has grown to more than
# twice their distance: huddled in a corner they would hold it badly, so both are chosen anew.
# PhysX: `growPatches`, with frictionOffsetThreshold as our anchor_gap. No deviation is known.


@kernel
def grow_anchors(
    contacts: ContactSet,
    patch_of: I64,
    patches: Patches,
    patch: int,
    bodies: SolverBodies,
    options: SolverOptions,
) -> None:
    """Give one patch up to two anchors, chosen from its contact points; old ones stay if they fit.

    Parameters
    ----------
    contacts, patch_of : ContactSet, (C,)
        Contacts, and the patch of each. Those farther apart than ``options.anchor_gap`` metres
        hold no anchor.
    patches, patch : Patches, int
        ``patches.anchor_count[patch]`` and ``patches.anchor[patch]`` are changed.
    bodies, options
        Poses and thresholds.
    """
    x, rot = bodies.x, bodies.rot
    a, b = patches.bodies[patch, 0], patches.bodies[patch, 1]
    count, anchor = patches.anchor_count, patches.anchor
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for c in range(len(patch_of)):
        if patch_of[c] == patch:
            for i in range(3):
                low[i] = min(low[i], contacts.point[c, i])
                high[i] = max(high[i], contacts.point[c, i])
    if count[patch] == MAX_ANCHORS:
        spread = _squared_distance(anchor[patch, 0, 0], anchor[patch, 0, 1])
        if MIN_ANCHOR_SPREAD * spread >= _squared_distance(low, high):
            return
        count[patch] = 0
    world = np.zeros((2, 3))
    old = count[patch]
    have = old
    if old == 1:
        _to_world(rot[a], x[a], anchor[patch, 0, 0], world[0])
    between = 0.0
    for c in range(len(patch_of)):
        if patch_of[c] != patch or contacts.separation[c] >= options.anchor_gap:
            continue
        point = contacts.point[c]
        if have == 0:
            world[0] = point
            have = 1
        elif have == 1:
            between = _squared_distance(point, world[0])
            if between > options.anchor_distance**2:
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
        _to_local(rot[a], x[a], world[k], anchor[patch, 0, k])
        _to_local(rot[b], x[b], world[k], anchor[patch, 1, k])
    count[patch] = have


# Phase 3a: normal rows.
#
# Non-penetration asks for J v + b >= 0 with b = BIAS - TARGET. With separation s and restitution e:
#     BIAS   = max(-max_depenetration_speed, bias * s / dt)   where the contact does not bounce:
#              overlap is pushed out, a gap may be closed within the step;
#     TARGET = -e J v                                         where it does: e > 0, an approach
#              faster than bounce_threshold, and fast enough to meet the surface (-J v > s / dt).
# PhysX: `setupFinalizeSolverConstraints` and its `constructContactConstraint` (0.8 / dt there is
# our bias / dt; maxPenetrationBias; bounceThreshold). No deviation is known.


@kernel
def normal_rows(contacts: ContactSet, bodies: SolverBodies, options: SolverOptions) -> F64:
    """Return the rows (C, ROW_WIDTH) of non-penetration, one for each contact.

    Parameters
    ----------
    contacts, bodies
        Contacts in world axes; velocities are those before any impulse of this step.
    options
        ``dt``, ``bias``, ``max_depenetration_speed`` and ``bounce_threshold`` are used.
    """
    x, v, w = bodies.x, bodies.v, bodies.w
    total = len(contacts.key)
    rows = np.zeros((total, ROW_WIDTH))
    for c in range(total):
        a, b = contacts.bodies[c, 0], contacts.bodies[c, 1]
        arm_a = contacts.point[c] - x[a]
        arm_b = contacts.point[c] - x[b]
        row = rows[c]
        inverse_mass = _fill_row(row, a, b, arm_a, arm_b, contacts.normal[c], bodies)
        row[EFFECTIVE_MASS] = 1.0 / inverse_mass if inverse_mass > 0 else 0.0
        separation = contacts.separation[c]
        row[SEPARATION] = separation
        speed = _relative_speed(row, a, b, v, w)
        restitution = contacts.material[c, 2]
        bounces = (
            restitution > 0
            and speed < -options.bounce_threshold
            and -speed > separation / options.dt
        )
        if bounces:
            row[TARGET] = -restitution * speed
        else:
            row[BIAS] = max(
                -options.max_depenetration_speed, separation * options.bias / options.dt
            )
    return rows


# Phase 3b: friction rows.
#
# Each anchor is a point p_a of body a and p_b of body b that should coincide. Along two tangents t1
# and t2 = n x t1, friction asks for J v + BIAS = 0 with BIAS = (p_b - p_a) . t / dt, which also
# takes back what the anchor has slipped since it was placed; the effective mass is multiplied by
# friction_gain < 1, which damps the coupling of several anchors.
# PhysX: the friction part of `setupFinalizeSolverConstraints`. No deviation is known.


@kernel
def friction_rows(patches: Patches, bodies: SolverBodies, options: SolverOptions) -> F64:
    """Return the rows (P, 2, 2, ROW_WIDTH) of friction: [patch, anchor, tangent, column].

    Rows of anchors that a patch does not have are 0. ``dt`` and ``friction_gain`` of ``options``
    are used.
    """
    x, rot, v = bodies.x, bodies.rot, bodies.v
    total = len(patches.anchor_count)
    rows = np.zeros((total, 2, 2, ROW_WIDTH))
    tangents = np.zeros((2, 3))
    pa, pb = np.zeros(3), np.zeros(3)
    for p in range(total):
        a, b = patches.bodies[p, 0], patches.bodies[p, 1]
        n = patches.normal[p]
        first_tangent(n, v[b] - v[a], tangents[0])
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            tangents[1, i] = n[j] * tangents[0, k] - n[k] * tangents[0, j]
        for k in range(patches.anchor_count[p]):
            _to_world(rot[a], x[a], patches.anchor[p, 0, k], pa)
            _to_world(rot[b], x[b], patches.anchor[p, 1, k], pb)
            for t in range(2):
                row = rows[p, k, t]
                d = tangents[t]
                inverse_mass = _fill_row(row, a, b, pa - x[a], pb - x[b], d, bodies)
                row[EFFECTIVE_MASS] = (
                    options.friction_gain / inverse_mass if inverse_mass > 0 else 0.0
                )
                slip = 0.0
                for i in range(3):
                    slip += (pb[i] - pa[i]) * d[i]
                row[BIAS] = slip / options.dt
    return rows


# Phase 3c: order.
#
# Gauss-Seidel depends on the order of rows. Pairs of moving bodies are spread over partitions in
# which no body comes twice; a pair with the world gets a partition after all others of its moving
# body, so that what must not be penetrated has the last word in a sweep.
# PhysX: `partitionContactConstraints`. Deviations: a partition is a position in the order, not a
# batch for threads; and at most MAX_PARTITIONS are told apart. All pairs of a body beyond that many
# share the last partition without a warning. The sweep is sequential, so the result stays valid:
# only the order within that partition is then the order of the keys.


@kernel
def solving_order(key: I64, bodies: I64, world: int) -> I64:
    """Return the order (P,) in which patches are solved: what rests on the world comes last.

    Parameters
    ----------
    key : (P,)
        Pair of geoms of every patch, sorted; patches of one pair get one partition.
    bodies : (P, 2)
        Rows of `Bodies`.
    world : int
        The row that stands for what does not move.
    """
    patches = len(key)
    partition = np.zeros(patches, np.int64)
    taken = np.zeros((world + 1, MAX_PARTITIONS), np.bool_)
    free = np.zeros(world + 1, np.int64)
    p = 0
    while p < patches:
        q = p
        while q < patches and key[q] == key[p]:
            q += 1
        a, b = bodies[p, 0], bodies[p, 1]
        if a != world and b != world:
            r = 0
            while r < MAX_PARTITIONS - 1 and (taken[a, r] or taken[b, r]):
                r += 1
            taken[a, r] = True
            taken[b, r] = True
            free[a] = max(free[a], r + 1)
            free[b] = max(free[b], r + 1)
            partition[p:q] = r
        p = q
    p = 0
    while p < patches:
        q = p
        while q < patches and key[q] == key[p]:
            q += 1
        a, b = bodies[p, 0], bodies[p, 1]
        if a == world or b == world:
            moving = b if a == world else a
            partition[p:q] = free[moving]
            free[moving] += 1
        p = q
    return np.argsort(partition, kind="mergesort")


@kernel
def build_constraints(
    contacts: ContactSet,
    patches: Patches,
    patch_of: I64,
    bodies: SolverBodies,
    options: SolverOptions,
) -> Constraints:
    """Return all rows of a step with accumulated impulses of 0 (no warm start, as in PhysX).

    ``patch_of`` (C,) is the patch of every contact; every patch has one at least.
    """
    total = len(patches.first)
    start = np.zeros(total + 1, np.int64)
    for c in range(len(patch_of)):
        start[patch_of[c] + 1] += 1
    return Constraints(
        solving_order(contacts.key[patches.first], patches.bodies, len(bodies.inv_mass) - 1),
        np.cumsum(start),
        np.argsort(patch_of, kind="mergesort"),
        contacts.material[patches.first],
        normal_rows(contacts, bodies, options),
        friction_rows(patches, bodies, options),
        np.zeros(len(patch_of)),
        np.zeros((total, 2, 2)),
        np.zeros(total, np.bool_),
    )


# Phase 4: sweeps.
#
# Projected Gauss-Seidel on the accumulated impulses: patch after patch, first every contact,
#     lambda_n <- max(0, lambda_n - (J v + b) / (J M^-1 J^T)),         b = BIAS - TARGET,
# then every tangent of every anchor; N is the sum of lambda_n over the patch, g = friction_gain:
#     lambda_t <- lambda_t - g (J v + BIAS) / (J M^-1 J^T),
#     and, where |lambda_t| > mu_s N, lambda_t <- clip(lambda_t, -mu_d N, mu_d N): the patch slips.
# Velocities follow every change at once. Sweeps over positions use BIAS as it is; those over
# velocities, after the poses have moved, use max(BIAS, 0) and no friction bias: a gap may still be
# closed, but no speed is left that only corrected an overlap or a slip.
# PhysX: `solveContact`, and `solveContactConcludeBlock` for the end of the position sweeps. As
# there, N is that of the whole patch for each anchor, so that two anchors bear twice Coulomb's
# force (divide_friction gives each its part), and the limits hold for each tangent apart.


@kernel
def sweep(
    constraints: Constraints,
    patches: Patches,
    bodies: SolverBodies,
    with_friction: bool,
    with_bias: bool,
    divide_friction: bool,
) -> None:
    """Improve all accumulated impulses once, and change the velocities of ``bodies`` with them.

    Parameters
    ----------
    constraints, patches, bodies
        ``normal_impulse``, ``friction_impulse`` and ``slipped`` of ``constraints`` and ``v``, ``w``
        of ``bodies`` are changed.
    with_friction : bool
        Solve the friction rows too.
    with_bias : bool
        Correct positions: True in sweeps before the poses move.
    divide_friction : bool
        See `SolverOptions`.
    """
    v, w, inv_mass = bodies.v, bodies.w, bodies.inv_mass
    start, contact, material = constraints.start, constraints.contact, constraints.material
    normal, friction = constraints.normal, constraints.friction
    normal_impulse = constraints.normal_impulse
    friction_impulse = constraints.friction_impulse
    count, pair, slipped = patches.anchor_count, patches.bodies, constraints.slipped
    for p in constraints.order:
        a, b = pair[p, 0], pair[p, 1]
        patch_impulse = 0.0
        for m in range(start[p], start[p + 1]):
            c = contact[m]
            row = normal[c]
            bias = row[BIAS] if with_bias else max(row[BIAS], 0.0)
            change = row[EFFECTIVE_MASS] * (row[TARGET] - bias - _relative_speed(row, a, b, v, w))
            change = max(change, -normal_impulse[c])
            normal_impulse[c] += change
            patch_impulse += normal_impulse[c]
            _apply_impulse(row, a, b, change, v, w, inv_mass)
        if not with_friction or count[p] == 0:
            continue
        fraction = 1.0 / count[p] if divide_friction else 1.0
        static_limit = material[p, 0] * patch_impulse * fraction
        dynamic_limit = material[p, 1] * patch_impulse * fraction
        slips = False
        for k in range(count[p]):
            for t in range(2):
                row = friction[p, k, t]
                bias = row[BIAS] if with_bias else 0.0
                impulse = friction_impulse[p, k, t] - row[EFFECTIVE_MASS] * (
                    _relative_speed(row, a, b, v, w) + bias
                )
                if abs(impulse) > static_limit:
                    slips = True
                    impulse = min(max(impulse, -dynamic_limit), dynamic_limit)
                change = impulse - friction_impulse[p, k, t]
                _apply_impulse(row, a, b, change, v, w, inv_mass)
                friction_impulse[p, k, t] = impulse
        slipped[p] = slips


# Phase 5: memory.
#
# Patches that did not slip in the last sweep keep their anchors and normal in the frames of both
# bodies; the next step's BIAS then pulls the two images of an anchor together again, which is what
# makes static friction hold a position and not only a velocity.
# PhysX: the ``broken`` flag that `solveContact` sets and `writeBackContact` stores with the patch.


@kernel
def remember_anchors(
    key: I64, patches: Patches, slipped: Flags, bodies: SolverBodies
) -> AnchorMemory:
    """Return the anchors of all patches that did not slip.

    ``key`` (P,) names each patch's pair of geoms; ``slipped`` (P,) is that of `Constraints`.
    """
    holds = np.flatnonzero(~slipped & (patches.anchor_count > 0))
    local = np.zeros((len(holds), 2, 3))
    for i in range(len(holds)):
        p = holds[i]
        for side in range(2):
            rot = bodies.rot[patches.bodies[p, side]]
            for j in range(3):
                for k in range(3):
                    local[i, side, j] += rot[k, j] * patches.normal[p, k]
    return AnchorMemory(key[holds], patches.anchor_count[holds], local, patches.anchor[holds])


@kernel
def solve_step(
    bodies: Bodies, contacts: ContactSet, anchors: AnchorMemory, options: SolverOptions
) -> StepResult:
    """Change the velocities of ``bodies`` by the contact impulses of one step.

    Parameters
    ----------
    bodies : Bodies
        ``v`` and ``w`` already hold gravity, drag and pushes of the step; they are changed.
    contacts : ContactSet
        Contacts at the present poses.
    anchors : AnchorMemory
        That of the last step, or `no_anchors`.
    options : SolverOptions
        Iterations, tolerances, step length.

    Returns
    -------
    StepResult
        Velocities that move the poses, normal impulses, anchors for the next step.

    References
    ----------
    NVIDIA PhysX 4.1, ``lowleveldynamics``: ``createFinalizeSolverContacts``, ``solveContact``.
    E. Catto, Iterative Dynamics with Temporal Coherence, Game Developers Conference, 2005.
    """
    total = len(bodies.inv_mass)
    rot = np.zeros((total, 3, 3))
    inv_inertia = np.zeros((total, 3, 3))
    for i in range(total):
        rot[i] = rotation_matrix(bodies.q[i])
        _to_world_axes(rot[i], bodies.inv_inertia[i], inv_inertia[i])
    v, w = bodies.v, bodies.w
    in_world = SolverBodies(bodies.x, rot, v, w, bodies.inv_mass, inv_inertia)
    candidates, patch_of = find_patches(contacts, anchors, in_world, options)
    patches = drop_patches_without_contact(candidates, patch_of)
    for p in range(len(patches.first)):
        # Rows use the normal of this step's contacts, also where the anchors are older.
        patches.normal[p] = contacts.normal[patches.first[p]]
        grow_anchors(contacts, patch_of, patches, p, in_world, options)
    constraints = build_constraints(contacts, patches, patch_of, in_world, options)
    divide = options.divide_friction
    for i in range(options.position_iterations):
        remaining = options.position_iterations - i
        with_friction = options.friction_sweeps == 0 or remaining <= options.friction_sweeps
        sweep(constraints, patches, in_world, with_friction, True, divide)
    move_v, move_w = v.copy(), w.copy()
    for _ in range(options.velocity_iterations):
        sweep(constraints, patches, in_world, True, False, divide)
    memory = remember_anchors(contacts.key[patches.first], patches, constraints.slipped, in_world)
    return StepResult(move_v, move_w, constraints.normal_impulse, memory)


# Free motion and integration: semi-implicit Euler, velocities first, then poses with the velocities
# at the end of the step. PhysX: `bodyCoreComputeUnconstrainedVelocity` and `integrateCore`.


@kernel
def move_freely(
    v: F64,
    w: F64,
    awake: Flags,
    drag: F64,
    gravity: float,
    max_angular_velocity: float,
    dt: float,
) -> None:
    """Change velocities by a step of gravity and drag, and cap the angular velocity.

    Parameters
    ----------
    v, w : (B + 1, 3)
        Velocities in m/s and rad/s, world axes; changed, but for the last row.
    awake : (B,)
        Where gravity acts.
    drag : (B, 2)
        Linear and angular drag c, d per second.
    gravity, max_angular_velocity, dt : float
        g in m/s^2 downwards, rad/s, seconds.

    Notes
    -----
    v <- (v - g dt z) max(1 - c dt, 0), w <- w max(1 - d dt, 0), then w <- w min(1, cap / |w|).
    """
    for i in range(len(awake)):
        if awake[i]:
            v[i, 2] -= gravity * dt
        keep_v, keep_w = max(1.0 - drag[i, 0] * dt, 0.0), max(1.0 - drag[i, 1] * dt, 0.0)
        for j in range(3):
            v[i, j] *= keep_v
            w[i, j] *= keep_w
        speed = np.sqrt(w[i, 0] * w[i, 0] + w[i, 1] * w[i, 1] + w[i, 2] * w[i, 2])
        factor = min(1.0, max_angular_velocity / max(speed, MIN_SPIN))
        for j in range(3):
            w[i, j] *= factor


@kernel
def move_poses(x: F64, q: F64, v: F64, w: F64, dt: float) -> None:
    """Move centres of mass ``x`` and orientations ``q`` by constant velocities over ``dt`` seconds.

    Parameters
    ----------
    x, q : (B + 1, 3), (B + 1, 4)
        Changed, but for the last row, which stands for the world.
    v, w : (B + 1, 3)
        Velocities in m/s and rad/s, world axes.
    dt : float
        Seconds.

    Notes
    -----
    x <- x + v dt; q <- (cos(|w| dt / 2), sin(|w| dt / 2) w / |w|) q, then q <- q / |q|.
    """
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
