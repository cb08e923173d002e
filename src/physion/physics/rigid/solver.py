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

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.manifold import Manifolds
from physion.physics.rigid.collision.search import ContactList
from physion.physics.rigid.constraint_rows import (
    apply_impulse,
    relative_speed,
    set_friction_rows,
    set_normal_rows,
    set_order,
)
from physion.physics.rigid.friction_anchors import grow_anchors, keep_anchors
from physion.physics.rigid.solver_records import (
    BIAS,
    EFFECTIVE_MASS,
    TARGET,
    Bodies,
    Constraints,
    SolverOptions,
)


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
