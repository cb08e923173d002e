"""Contact solver: projected Gauss-Seidel on impulses with friction patches, after PhysX 4.

This module turns contacts into changes of velocity. The scheme is that of PhysX 4, the engine of
Unity 2019, with patch friction. Its published source (``lowleveldynamics``) says what it does;
everything here is written anew, and functions of that source are named where a phase follows them.

A constraint row with Jacobian J acts on the velocities of a pair of bodies a and b. Along a
direction d, at a point with lever arms r_a and r_b,

    J v = d . (v_b - v_a) + (r_b x d) . w_b - (r_a x d) . w_a        (relative speed, m/s)
    m   = 1 / (J M^-1 J^T)                                           (effective mass, kg)

and an impulse lambda (N s) changes the velocities by M^-1 J^T lambda. A step has four phases:

1. `keep_anchors`, `grow_anchors`: each pair of hulls in contact gets up to two friction anchors,
   points held by friction; those of the step before are kept where they fit.
2. `set_normal_rows`, `set_friction_rows`, `set_order`: one row for each contact, two for each
   anchor, and the order of the pairs.
3. `sweep`: accumulated impulses are improved row after row, a fixed number of times.
4. `remember_anchors`: anchors that did not slip are kept for the next step, so that resting bodies
   do not creep.

Actors are numbered 0..A-1; row A stands for everything that does not move (infinite mass). The
order of all operations is fixed, so equal input gives equal bytes.

References
----------
NVIDIA PhysX 4.1, ``lowleveldynamics``: ``createFinalizeSolverContacts``, ``solveContact``.
E. Catto, Iterative Dynamics with Temporal Coherence, Game Developers Conference, 2005.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.manifold import Manifolds
from physion.physics.rigid.collision.search import ContactList

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Flags = NDArray[np.bool_]


# Arrays that the phases of a step pass to each other, made once for a run and reused in every step.

DIRECTION, ANGULAR_A, ANGULAR_B, SPIN_A, SPIN_B = 0, 3, 6, 9, 12
EFFECTIVE_MASS, BIAS, TARGET = 15, 16, 17
ROW_WIDTH = 18
"""Columns of a constraint row.

``DIRECTION`` (3): d, from body a to b. ``ANGULAR_A``, ``ANGULAR_B`` (3 each): r x d, the angular
part of J. ``SPIN_A``, ``SPIN_B`` (3 each): I^-1 (r x d), the angular velocity per impulse.
``EFFECTIVE_MASS``: m in kg (of friction rows times ``friction_gain``). ``BIAS``: speed in m/s that
corrects the position. ``TARGET``: relative speed in m/s after a bounce.
"""
MAX_PARTITIONS = 64
"""Partitions of the solving order that pairs of moving bodies are spread over."""


class Bodies(NamedTuple):
    """Actors that move, and as last row the world.

    - ``x`` (A + 1, 3): centres of mass in metres; ``q`` (A + 1, 4): orientations (w, x, y, z);
      ``rot`` (A + 1, 3, 3): the same as matrices.
    - ``v``, ``w`` (A + 1, 3): velocities in m/s, angular velocities in rad/s, world axes.
    - ``inertia`` (A + 1, 3, 3): kg m^2, body axes. ``inv_mass`` (A + 1,) in 1/kg and
      ``inv_inertia`` (A + 1, 3, 3): inverses, 0 for the world.
    - ``free_mass`` (A + 1,), ``free_inertia`` (A + 1, 3, 3): inverses for this step, the latter in
      world axes; 0 for what sleeps, so that it does not give way.
    """

    x: F64
    q: F64
    rot: F64
    v: F64
    w: F64
    inertia: F64
    inv_mass: F64
    inv_inertia: F64
    free_mass: F64
    free_inertia: F64


class SolverOptions(NamedTuple):
    """Numbers of the solver; see `physion.physics.rigid.bodies.RigidSettings` for each.

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


class Constraints(NamedTuple):
    """All rows of a step and their accumulated impulses: P pairs of geoms, C contact points.

    - ``order`` (P,): pairs in the order of solving. ``partition``, ``taken``, ``free``: work space
      of `physion.physics.rigid.solver.set_order`.
    - ``normal`` (C, ROW_WIDTH), ``friction`` (4 P, ROW_WIDTH): rows; those of friction are
      [pair, anchor, tangent].
    - ``normal_impulse`` (C,), ``friction_impulse`` (4 P,): N s, accumulated.
    - ``slipped`` (P,): the static friction limit was passed in the last sweep.
    - ``tangents`` (2, 3), ``arm`` (2, 3), ``relative`` (3,): work space.
    """

    order: I64
    partition: I64
    taken: Flags
    free: I64
    normal: F64
    friction: F64
    normal_impulse: F64
    friction_impulse: F64
    slipped: Flags
    tangents: F64
    arm: F64
    relative: F64


def new_constraints(capacity: int, actors: int) -> Constraints:
    """Return room for the rows of ``capacity`` pairs."""
    return Constraints(
        np.zeros(capacity, np.int64),
        np.zeros(capacity, np.int64),
        np.zeros((actors + 1, MAX_PARTITIONS), np.bool_),
        np.zeros(actors + 1, np.int64),
        np.zeros((4 * capacity, ROW_WIDTH)),
        np.zeros((4 * capacity, ROW_WIDTH)),
        np.zeros(4 * capacity),
        np.zeros(4 * capacity),
        np.zeros(capacity, np.bool_),
        np.zeros((2, 3)),
        np.zeros((2, 3)),
        np.zeros(3),
    )


# Friction anchors: the points at which a pair of hulls is held by friction.
#
# The contacts of a pair of hulls form a patch: they have one normal. A patch is held at up to two
# anchors, which are kept from step to step in the manifold of the pair; second and last phase of
# the contact solver (`physion.physics.rigid.solver`).

MAX_ANCHORS = 2
"""Friction anchors of a patch (PhysX's ``FrictionPatch`` has room for two)."""
MIN_ANCHOR_SPREAD = 4.0
"""Two anchors are kept while the diagonal of the patch is at most twice their distance: its square
is at most this many times theirs."""


@in_place_kernel
def to_world(bodies: Bodies, a: int, local: F64, out: F64) -> None:
    """Fill ``out`` (3,) with x + R local of actor ``a``."""
    rot, x = bodies.rot, bodies.x
    for i in range(3):
        out[i] = (
            x[a, i] + rot[a, i, 0] * local[0] + rot[a, i, 1] * local[1] + rot[a, i, 2] * local[2]
        )


@in_place_kernel
def _to_local(bodies: Bodies, a: int, world: F64, out: F64) -> None:
    """Fill ``out`` (3,) with R^T (world - x) of actor ``a``."""
    rot, x = bodies.rot, bodies.x
    dx, dy, dz = world[0] - x[a, 0], world[1] - x[a, 1], world[2] - x[a, 2]
    for i in range(3):
        out[i] = rot[a, 0, i] * dx + rot[a, 1, i] * dy + rot[a, 2, i] * dz


@in_place_kernel
def _copy(point: F64, out: F64) -> None:
    """Fill ``out`` (3,) with a point (3,)."""
    for i in range(3):
        out[i] = point[i]


@in_place_kernel
def _squared_distance(a: F64, b: F64) -> float:
    """Return |a - b|^2 of points (3,)."""
    return float((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


# Old anchors are kept while both bodies still agree about the patch, and it is that of the present
# contacts:
#     (R_a n_a) . (R_b n_b) > patch_cosine,   |(p_a - p_b) . n| < anchor_distance for each anchor,
#     (R_a n_a) . n >= patch_cosine,
# where n_a, n_b and p_a, p_b are its normal and anchors as each body carries them along, and n is
# the normal of the present contacts.
# PhysX: `getFrictionPatches` (what is kept) and `correlatePatches` (PXC_SAME_NORMAL is our
# patch_cosine). Deviation: PhysX merges the contacts of all hulls of two bodies where normals
# agree; here a pair of hulls is a patch.


@in_place_kernel
def keep_anchors(
    contacts: ContactList, p: int, manifolds: Manifolds, bodies: Bodies, options: SolverOptions
) -> None:
    """Forget the anchors of pair ``p`` where the bodies no longer agree about them."""
    s = contacts.manifold[p]
    a, b = contacts.actors[p, 0], contacts.actors[p, 1]
    count = manifolds.anchor_count[s]
    if count == 0:
        return
    rot, x = bodies.rot, bodies.x
    local = manifolds.anchor_normal
    between = along = 0.0
    n0 = n1 = n2 = 0.0
    for i in range(3):
        na = nb = 0.0
        for j in range(3):
            na += rot[a, i, j] * local[s, 0, j]
            nb += rot[b, i, j] * local[s, 1, j]
        between += na * nb
        along += na * contacts.normal[p, i]
        if i == 0:
            n0 = na
        elif i == 1:
            n1 = na
        else:
            n2 = na
    keep = between > options.patch_cosine and along >= options.patch_cosine
    for k in range(count):
        gap = 0.0
        for i in range(3):
            pa, pb = x[a, i], x[b, i]
            for j in range(3):
                pa += rot[a, i, j] * manifolds.anchor[s, 0, k, j]
                pb += rot[b, i, j] * manifolds.anchor[s, 1, k, j]
            gap += (pa - pb) * (n0 if i == 0 else (n1 if i == 1 else n2))
        keep = keep and abs(gap) < options.anchor_distance
    if not keep:
        manifolds.anchor_count[s] = 0


# A patch is held at up to two contact points that lie far apart: the first candidate, then whatever
# lies farther than anchor_distance from it, then each further point replaces the nearer of the two
# where that lengthens their distance. Two old anchors stay, unless the patch has grown to more than
# twice their distance: huddled in a corner they would hold it badly, so both are chosen anew.
# PhysX: `growPatches`, with frictionOffsetThreshold as our anchor_gap. No deviation is known.


@in_place_kernel
def grow_anchors(
    contacts: ContactList,
    p: int,
    manifolds: Manifolds,
    bodies: Bodies,
    options: SolverOptions,
    world: F64,
) -> None:
    """Give pair ``p`` up to two anchors, chosen from its contact points; old ones stay if they fit.

    Contacts farther apart than ``options.anchor_gap`` metres hold no anchor. ``world`` (2, 3) is
    work space.
    """
    s = contacts.manifold[p]
    a, b = contacts.actors[p, 0], contacts.actors[p, 1]
    start, stop = contacts.first[p], contacts.first[p + 1]
    count, anchor = manifolds.anchor_count, manifolds.anchor
    if count[s] == MAX_ANCHORS:
        diagonal = 0.0
        for i in range(3):
            low, high = np.inf, -np.inf
            for c in range(start, stop):
                low = min(low, contacts.point[c, i])
                high = max(high, contacts.point[c, i])
            diagonal += (high - low) ** 2
        spread = _squared_distance(anchor[s, 0, 0], anchor[s, 0, 1])
        if MIN_ANCHOR_SPREAD * spread >= diagonal:
            return
        count[s] = 0
    old = count[s]
    have = old
    if old == 1:
        to_world(bodies, a, anchor[s, 0, 0], world[0])
    between = 0.0
    for c in range(start, stop):
        if contacts.gap[c] >= options.anchor_gap:
            continue
        point = contacts.point[c]
        if have == 0:
            _copy(point, world[0])
            have = 1
        elif have == 1:
            between = _squared_distance(point, world[0])
            if between > options.anchor_distance**2:
                _copy(point, world[1])
                have = 2
        else:
            d0 = _squared_distance(point, world[0])
            d1 = _squared_distance(point, world[1])
            if d0 > d1:
                if d0 > between:
                    _copy(point, world[1])
                    between = d0
            elif d1 > between:
                _copy(point, world[0])
                between = d1
    for k in range(old, have):
        _to_local(bodies, a, world[k], anchor[s, 0, k])
        _to_local(bodies, b, world[k], anchor[s, 1, k])
    count[s] = have


# Patches that did not slip in the last sweep keep their anchors and normal in the frames of both
# bodies; the next step's BIAS then pulls the two images of an anchor together again, which is what
# makes static friction hold a position and not only a velocity.
# PhysX: the ``broken`` flag that `solveContact` sets and `writeBackContact` stores with the patch.


@in_place_kernel
def remember_anchors(
    contacts: ContactList, pairs: int, slipped: Flags, manifolds: Manifolds, bodies: Bodies
) -> None:
    """Keep the anchors of the pairs that did not slip, and forget those of the others.

    ``slipped`` (P,) is that of `Constraints`; ``bodies`` have the poses at which contacts were
    found.
    """
    for p in range(pairs):
        s = contacts.manifold[p]
        if slipped[p]:
            manifolds.anchor_count[s] = 0
            continue
        for side in range(2):
            a = contacts.actors[p, side]
            for j in range(3):
                total = 0.0
                for k in range(3):
                    total += bodies.rot[a, k, j] * contacts.normal[p, k]
                manifolds.anchor_normal[s, side, j] = total


# Constraint rows of contacts and friction anchors, and the order in which they are solved.
#
# Third phase of the contact solver; see `physion.physics.rigid.solver`.

MIN_SQUARED_SLIP = 1e-4
"""Squared speed (m/s)^2 of sliding above which the first tangent follows it; below, the direction
would be noise (constant ``p1`` of PhysX's ``setupFinalizeSolverConstraints4``)."""
ORTHOGONAL_COSINE = 0.70710678
"""cos 45 degrees (PhysX's ``orthoThreshold``): a normal farther than that from the x axis is
crossed with x to get a tangent, any other with z, so that the product is never short."""


@in_place_kernel
def fill_row(
    rows: F64, r: int, a: int, b: int, point_a: F64, point_b: F64, d: F64, bodies: Bodies
) -> float:
    """Write direction and angular columns of row ``r``; return J M^-1 J^T, 1 / effective mass.

    J M^-1 J^T = 1/m_a + 1/m_b + (r_a x d) . I_a^-1 (r_a x d) + (r_b x d) . I_b^-1 (r_b x d),
    with r = point - x the lever arms in metres, from ``point_a``, ``point_b`` (3,) in world axes,
    and ``d`` (3,) the direction.
    """
    inv_inertia, x = bodies.free_inertia, bodies.x
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows[r, DIRECTION + i] = d[i]
        rows[r, ANGULAR_A + i] = (point_a[j] - x[a, j]) * d[k] - (point_a[k] - x[a, k]) * d[j]
        rows[r, ANGULAR_B + i] = (point_b[j] - x[b, j]) * d[k] - (point_b[k] - x[b, k]) * d[j]
    inverse_mass = bodies.free_mass[a] + bodies.free_mass[b]
    for i in range(3):
        spin_a = 0.0
        spin_b = 0.0
        for j in range(3):
            spin_a += inv_inertia[a, i, j] * rows[r, ANGULAR_A + j]
            spin_b += inv_inertia[b, i, j] * rows[r, ANGULAR_B + j]
        rows[r, SPIN_A + i] = spin_a
        rows[r, SPIN_B + i] = spin_b
    for i in range(3):
        inverse_mass += rows[r, ANGULAR_A + i] * rows[r, SPIN_A + i]
        inverse_mass += rows[r, ANGULAR_B + i] * rows[r, SPIN_B + i]
    return float(inverse_mass)


@in_place_kernel
def relative_speed(rows: F64, r: int, a: int, b: int, v: F64, w: F64) -> float:
    """Return J v of row ``r`` in m/s: positive where the bodies part."""
    linear = turning_a = turning_b = 0.0
    for i in range(3):
        linear += rows[r, DIRECTION + i] * (v[b, i] - v[a, i])
        turning_a += rows[r, ANGULAR_A + i] * w[a, i]
        turning_b += rows[r, ANGULAR_B + i] * w[b, i]
    return float(linear + turning_b - turning_a)


@in_place_kernel
def apply_impulse(
    rows: F64, r: int, a: int, b: int, impulse: float, v: F64, w: F64, inv_mass: F64
) -> None:
    """Add M^-1 J^T ``impulse`` (N s) to the velocities of the bodies of row ``r``."""
    of_a, of_b = impulse * inv_mass[a], impulse * inv_mass[b]
    for i in range(3):
        v[a, i] -= rows[r, DIRECTION + i] * of_a
        v[b, i] += rows[r, DIRECTION + i] * of_b
        w[a, i] -= rows[r, SPIN_A + i] * impulse
        w[b, i] += rows[r, SPIN_B + i] * impulse


@in_place_kernel
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


# Phase 2a: normal rows.
#
# Non-penetration asks for J v + b >= 0 with b = BIAS - TARGET. With separation s and restitution e:
#     BIAS   = max(-max_depenetration_speed, bias * s / dt)   where the contact does not bounce:
#              overlap is pushed out, a gap may be closed within the step;
#     TARGET = -e J v                                         where it does: e > 0, an approach
#              faster than bounce_threshold, and fast enough to meet the surface (-J v > s / dt).
# PhysX: `setupFinalizeSolverConstraints` and its `constructContactConstraint` (0.8 / dt there is
# our bias / dt; maxPenetrationBias; bounceThreshold). No deviation is known.


@in_place_kernel
def set_normal_rows(
    contacts: ContactList, pairs: int, bodies: Bodies, options: SolverOptions, rows: Constraints
) -> None:
    """Fill the rows of non-penetration, one for each contact; impulses start from 0.

    Velocities of ``bodies`` are those before any impulse of this step. ``dt``, ``bias``,
    ``max_depenetration_speed`` and ``bounce_threshold`` of ``options`` are used.
    """
    v, w = bodies.v, bodies.w
    normal = rows.normal
    for p in range(pairs):
        a, b = contacts.actors[p, 0], contacts.actors[p, 1]
        restitution = contacts.material[p, 2]
        for c in range(contacts.first[p], contacts.first[p + 1]):
            point = contacts.point[c]
            inverse_mass = fill_row(normal, c, a, b, point, point, contacts.normal[p], bodies)
            normal[c, EFFECTIVE_MASS] = 1.0 / inverse_mass if inverse_mass > 0 else 0.0
            gap = contacts.gap[c]
            normal[c, BIAS] = 0.0
            normal[c, TARGET] = 0.0
            speed = relative_speed(normal, c, a, b, v, w)
            bounces = (
                restitution > 0 and speed < -options.bounce_threshold and -speed > gap / options.dt
            )
            if bounces:
                normal[c, TARGET] = -restitution * speed
            else:
                normal[c, BIAS] = max(
                    -options.max_depenetration_speed, gap * options.bias / options.dt
                )
            rows.normal_impulse[c] = 0.0


# Phase 2b: friction rows.
#
# Each anchor is a point p_a of body a and p_b of body b that should coincide. Along two tangents t1
# and t2 = n x t1, friction asks for J v + BIAS = 0 with BIAS = (p_b - p_a) . t / dt, which also
# takes back what the anchor has slipped since it was placed; the effective mass is multiplied by
# friction_gain < 1, which damps the coupling of several anchors.
# PhysX: the friction part of `setupFinalizeSolverConstraints`. No deviation is known.


@in_place_kernel
def set_friction_rows(
    contacts: ContactList,
    pairs: int,
    manifolds: Manifolds,
    bodies: Bodies,
    options: SolverOptions,
    rows: Constraints,
) -> None:
    """Fill the friction rows of all anchors; impulses start from 0.

    ``dt`` and ``friction_gain`` of ``options`` are used.
    """
    v, friction, tangents = bodies.v, rows.friction, rows.tangents
    pa, pb = rows.arm[0], rows.arm[1]
    relative = rows.relative
    for p in range(pairs):
        s = contacts.manifold[p]
        a, b = contacts.actors[p, 0], contacts.actors[p, 1]
        n = contacts.normal[p]
        for i in range(3):
            relative[i] = v[b, i] - v[a, i]
        first_tangent(n, relative, tangents[0])
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            tangents[1, i] = n[j] * tangents[0, k] - n[k] * tangents[0, j]
        rows.slipped[p] = False
        for k in range(manifolds.anchor_count[s]):
            to_world(bodies, a, manifolds.anchor[s, 0, k], pa)
            to_world(bodies, b, manifolds.anchor[s, 1, k], pb)
            for t in range(2):
                r = 4 * p + 2 * k + t
                d = tangents[t]
                inverse_mass = fill_row(friction, r, a, b, pa, pb, d, bodies)
                friction[r, EFFECTIVE_MASS] = (
                    options.friction_gain / inverse_mass if inverse_mass > 0 else 0.0
                )
                slip = 0.0
                for i in range(3):
                    slip += (pb[i] - pa[i]) * d[i]
                friction[r, BIAS] = slip / options.dt
                rows.friction_impulse[r] = 0.0


# Phase 2c: order.
#
# Gauss-Seidel depends on the order of rows. Pairs of moving bodies are spread over partitions in
# which no body comes twice; a pair with the world gets a partition after all others of its moving
# body, so that what must not be penetrated has the last word in a sweep.
# PhysX: `partitionContactConstraints`. Deviations: a partition is a position in the order, not a
# batch for threads; and at most MAX_PARTITIONS are told apart. All pairs of a body beyond that many
# share the last partition without a warning. The sweep is sequential, so the result stays valid:
# only the order within that partition is then the order of the pairs.


@in_place_kernel
def set_order(contacts: ContactList, pairs: int, world: int, rows: Constraints) -> None:
    """Fill ``rows.order`` with the order of solving: what rests on the world comes last.

    ``world`` is the row of `Bodies` that stands for what does not move.
    """
    partition, taken, free = rows.partition, rows.taken, rows.free
    for a in range(world + 1):
        free[a] = 0
        for r in range(MAX_PARTITIONS):
            taken[a, r] = False
    most = 0
    for p in range(pairs):
        a, b = contacts.actors[p, 0], contacts.actors[p, 1]
        if a == world or b == world:
            continue
        r = 0
        while r < MAX_PARTITIONS - 1 and (taken[a, r] or taken[b, r]):
            r += 1
        taken[a, r] = True
        taken[b, r] = True
        free[a] = max(free[a], r + 1)
        free[b] = max(free[b], r + 1)
        partition[p] = r
        most = max(most, r)
    for p in range(pairs):
        a, b = contacts.actors[p, 0], contacts.actors[p, 1]
        if a == world or b == world:
            moving = b if a == world else a
            partition[p] = free[moving]
            most = max(most, free[moving])
            free[moving] += 1
    used = 0
    for r in range(most + 1):
        for p in range(pairs):
            if partition[p] == r:
                rows.order[used] = p
                used += 1


@in_place_kernel
def build_constraints(
    contacts: ContactList,
    pairs: int,
    manifolds: Manifolds,
    bodies: Bodies,
    options: SolverOptions,
    rows: Constraints,
) -> None:
    """Fill all rows of a step with accumulated impulses of 0 (no warm start, as in PhysX)."""
    for p in range(pairs):
        keep_anchors(contacts, p, manifolds, bodies, options)
        grow_anchors(contacts, p, manifolds, bodies, options, rows.arm)
    set_normal_rows(contacts, pairs, bodies, options, rows)
    set_friction_rows(contacts, pairs, manifolds, bodies, options, rows)
    set_order(contacts, pairs, len(bodies.x) - 1, rows)


# Projected Gauss-Seidel on the accumulated impulses: pair after pair, first every contact,
#     lambda_n <- max(0, lambda_n - (J v + b) / (J M^-1 J^T)),         b = BIAS - TARGET,
# then every tangent of every anchor; N is the sum of lambda_n over the pair, g = friction_gain:
#     lambda_t <- lambda_t - g (J v + BIAS) / (J M^-1 J^T),
#     and, where |lambda_t| > mu_s N, lambda_t <- clip(lambda_t, -mu_d N, mu_d N): the pair slips.
# Velocities follow every change at once. Sweeps over positions use BIAS as it is; those over
# velocities, after the poses have moved, use max(BIAS, 0) and no friction bias: a gap may still be
# closed, but no speed is left that only corrected an overlap or a slip.
# PhysX: `solveContact`, and `solveContactConcludeBlock` for the end of the position sweeps. As
# there, N is that of the whole pair for each anchor, so that two anchors bear twice Coulomb's
# force (divide_friction gives each its part), and the limits hold for each tangent apart.


@in_place_kernel
def sweep(
    rows: Constraints,
    contacts: ContactList,
    pairs: int,
    manifolds: Manifolds,
    bodies: Bodies,
    with_friction: bool,
    with_bias: bool,
    divide_friction: bool,
) -> None:
    """Improve all accumulated impulses once, and change the velocities of ``bodies`` with them.

    Parameters
    ----------
    rows, contacts, pairs, manifolds, bodies
        ``normal_impulse``, ``friction_impulse`` and ``slipped`` of ``rows`` and ``v``, ``w`` of
        ``bodies`` are changed.
    with_friction : bool
        Solve the friction rows too.
    with_bias : bool
        Correct positions: True in sweeps before the poses move.
    divide_friction : bool
        See `SolverOptions`.
    """
    v, w, inv_mass = bodies.v, bodies.w, bodies.free_mass
    normal, friction = rows.normal, rows.friction
    normal_impulse, friction_impulse = rows.normal_impulse, rows.friction_impulse
    for index in range(pairs):
        p = rows.order[index]
        a, b = contacts.actors[p, 0], contacts.actors[p, 1]
        patch_impulse = 0.0
        for c in range(contacts.first[p], contacts.first[p + 1]):
            bias = normal[c, BIAS] if with_bias else max(normal[c, BIAS], 0.0)
            speed = relative_speed(normal, c, a, b, v, w)
            change = normal[c, EFFECTIVE_MASS] * (normal[c, TARGET] - bias - speed)
            change = max(change, -normal_impulse[c])
            normal_impulse[c] += change
            patch_impulse += normal_impulse[c]
            apply_impulse(normal, c, a, b, change, v, w, inv_mass)
        if not with_friction:
            continue
        count = manifolds.anchor_count[contacts.manifold[p]]
        if count == 0:
            continue
        fraction = 1.0 / count if divide_friction else 1.0
        static_limit = contacts.material[p, 0] * patch_impulse * fraction
        dynamic_limit = contacts.material[p, 1] * patch_impulse * fraction
        slips = False
        for r in range(4 * p, 4 * p + 2 * count):
            bias = friction[r, BIAS] if with_bias else 0.0
            speed = relative_speed(friction, r, a, b, v, w)
            impulse = friction_impulse[r] - friction[r, EFFECTIVE_MASS] * (speed + bias)
            if abs(impulse) > static_limit:
                slips = True
                impulse = min(max(impulse, -dynamic_limit), dynamic_limit)
            apply_impulse(friction, r, a, b, impulse - friction_impulse[r], v, w, inv_mass)
            friction_impulse[r] = impulse
        rows.slipped[p] = slips


@in_place_kernel
def correct_positions(
    rows: Constraints,
    contacts: ContactList,
    pairs: int,
    manifolds: Manifolds,
    bodies: Bodies,
    options: SolverOptions,
) -> None:
    """Run the sweeps whose velocities move the poses; friction acts in the last of them."""
    for i in range(options.position_iterations):
        left = options.position_iterations - i
        with_friction = options.friction_sweeps == 0 or left <= options.friction_sweeps
        sweep(
            rows,
            contacts,
            pairs,
            manifolds,
            bodies,
            with_friction,
            True,
            options.divide_friction,
        )


@in_place_kernel
def correct_velocities(
    rows: Constraints,
    contacts: ContactList,
    pairs: int,
    manifolds: Manifolds,
    bodies: Bodies,
    options: SolverOptions,
) -> None:
    """Run the sweeps after the poses have moved: no speed is left that only corrected a pose."""
    for _ in range(options.velocity_iterations):
        sweep(rows, contacts, pairs, manifolds, bodies, True, False, options.divide_friction)
