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

import numpy as np

from physion.numerics.kernel import kernel
from physion.numerics.rotations import rotation_matrix
from physion.physics.rigid.constraint_rows import apply_impulse, build_constraints, relative_speed
from physion.physics.rigid.patches import (
    drop_patches_without_contact,
    find_patches,
    grow_anchors,
    remember_anchors,
)
from physion.physics.rigid.solver_records import (
    BIAS,
    EFFECTIVE_MASS,
    F64,
    TARGET,
    AnchorMemory,
    Bodies,
    Constraints,
    ContactSet,
    Patches,
    SolverBodies,
    SolverOptions,
    StepResult,
)


@kernel
def _to_world_axes(rot: F64, local: F64, out: F64) -> None:
    """Fill ``out`` (3, 3) with R L R^T: a matrix of the body's frame in world axes."""
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for k in range(3):
                along = rot[i, 0] * local[0, k] + rot[i, 1] * local[1, k] + rot[i, 2] * local[2, k]
                out[i, j] += along * rot[j, k]


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
            change = row[EFFECTIVE_MASS] * (row[TARGET] - bias - relative_speed(row, a, b, v, w))
            change = max(change, -normal_impulse[c])
            normal_impulse[c] += change
            patch_impulse += normal_impulse[c]
            apply_impulse(row, a, b, change, v, w, inv_mass)
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
                    relative_speed(row, a, b, v, w) + bias
                )
                if abs(impulse) > static_limit:
                    slips = True
                    impulse = min(max(impulse, -dynamic_limit), dynamic_limit)
                change = impulse - friction_impulse[p, k, t]
                apply_impulse(row, a, b, change, v, w, inv_mass)
                friction_impulse[p, k, t] = impulse
        slipped[p] = slips


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
