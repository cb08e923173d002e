"""Constraint rows of contacts and friction anchors, and the order in which they are solved.

Third phase of the contact solver; see `physion.physics.rigid.solver`.
"""

from __future__ import annotations

import numpy as np

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.manifold import Manifolds
from physion.physics.rigid.collision.search import ContactList
from physion.physics.rigid.friction_anchors import to_world
from physion.physics.rigid.solver_records import (
    ANGULAR_A,
    ANGULAR_B,
    BIAS,
    DIRECTION,
    EFFECTIVE_MASS,
    F64,
    MAX_PARTITIONS,
    SPIN_A,
    SPIN_B,
    TARGET,
    Bodies,
    Constraints,
    SolverOptions,
)

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
