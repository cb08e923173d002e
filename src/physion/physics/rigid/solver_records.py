"""Arrays that the phases of a step pass to each other; see `solver` and `step`.

All arrays are made once for a run and reused in every step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Flags = NDArray[np.bool_]

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


class Constraints(NamedTuple):
    """All rows of a step and their accumulated impulses: P pairs of geoms, C contact points.

    - ``order`` (P,): pairs in the order of solving. ``partition``, ``taken``, ``free``: work space
      of `physion.physics.rigid.constraint_rows.set_order`.
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
