"""Arrays that the phases of the contact solver pass to each other; see `solver`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
