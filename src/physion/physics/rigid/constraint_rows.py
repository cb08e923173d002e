"""Constraint rows of contacts and friction anchors, and the order in which they are solved.

Third phase of the contact solver; see `physion.physics.rigid.solver`.
"""

from __future__ import annotations

import numpy as np

from physion.numerics.kernel import kernel
from physion.physics.rigid.patches import to_world
from physion.physics.rigid.solver_records import (
    ANGULAR_A,
    ANGULAR_B,
    BIAS,
    DIRECTION,
    EFFECTIVE_MASS,
    F64,
    I64,
    ROW_WIDTH,
    SEPARATION,
    SPIN_A,
    SPIN_B,
    TARGET,
    Constraints,
    ContactSet,
    Patches,
    SolverBodies,
    SolverOptions,
)

MIN_SQUARED_SLIP = 0.1
"""Squared speed (m/s)^2 of sliding above which the first tangent follows it; below, the direction
would be noise (constant ``p1`` of PhysX's ``setupFinalizeSolverConstraints4``)."""
ORTHOGONAL_COSINE = 0.70710678
"""cos 45 degrees (PhysX's ``orthoThreshold``): a normal farther than that from the x axis is
crossed with x to get a tangent, any other with z, so that the product is never short."""
MAX_PARTITIONS = 64
"""Partitions of the solving order that pairs of moving bodies are spread over."""


@kernel
def fill_row(
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
def relative_speed(row: F64, a: int, b: int, v: F64, w: F64) -> float:
    """Return J v of a row in m/s: positive where the bodies part."""
    speed = 0.0
    for i in range(3):
        speed += row[DIRECTION + i] * (v[b, i] - v[a, i])
        speed += row[ANGULAR_B + i] * w[b, i] - row[ANGULAR_A + i] * w[a, i]
    return speed


@kernel
def apply_impulse(row: F64, a: int, b: int, impulse: float, v: F64, w: F64, inv_mass: F64) -> None:
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
        inverse_mass = fill_row(row, a, b, arm_a, arm_b, contacts.normal[c], bodies)
        row[EFFECTIVE_MASS] = 1.0 / inverse_mass if inverse_mass > 0 else 0.0
        separation = contacts.separation[c]
        row[SEPARATION] = separation
        speed = relative_speed(row, a, b, v, w)
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
            to_world(rot[a], x[a], patches.anchor[p, 0, k], pa)
            to_world(rot[b], x[b], patches.anchor[p, 1, k], pb)
            for t in range(2):
                row = rows[p, k, t]
                d = tangents[t]
                inverse_mass = fill_row(row, a, b, pa - x[a], pb - x[b], d, bodies)
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
