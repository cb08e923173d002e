"""Sleep: when resting bodies stop being simulated, and what wakes them, after PhysX 4.

Bodies that touch form an island. An island falls asleep as a whole when the wake counter of each of
its bodies has run down, and wakes as a whole when one of them is awake.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.solver import Bodies

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Flags = NDArray[np.bool_]

COUNTING_FRACTION = 0.5
"""Part of the wake time, its last, in which the motion of a body is added up (PhysX)."""
MAX_RESET = 2.0
"""Most halves of the wake time that a motion above the limit sets the counter to (PhysX)."""


class SleepState(NamedTuple):
    """Wake counters of A actors; all arrays are changed in place.

    - ``counter`` (A,): seconds until an actor may sleep.
    - ``sum_v``, ``sum_w`` (A, 3): velocities in m/s (world axes) and angular velocities in rad/s
      (body axes), summed over the steps of the counter's last part.
    - ``asleep`` (A,): actors that are not simulated.
    - ``island`` (A,): from `find_islands`. ``touching`` (A, A + 1): work space.
    """

    counter: F64
    sum_v: F64
    sum_w: F64
    asleep: Flags
    island: I64
    touching: Flags


def all_awake(actors: int, wake_time: float) -> SleepState:
    """Return the state of ``actors`` that have just been put into the scene."""
    return SleepState(
        np.full(actors, wake_time),
        np.zeros((actors, 3)),
        np.zeros((actors, 3)),
        np.zeros(actors, np.bool_),
        np.zeros(actors, np.int64),
        np.zeros((actors, actors + 1), np.bool_),
    )


class SleepOptions(NamedTuple):
    """``threshold``: energy by mass in m^2/s^2. ``wake_time``, ``dt``: seconds."""

    threshold: float
    wake_time: float
    dt: float


@in_place_kernel
def find_islands(pairs: I64, count: int, island: I64) -> None:
    """Fill ``island`` (A,) with the lowest actor that each actor touches, also through others.

    The first ``count`` rows of ``pairs`` (S, 2) are the actors that touch; numbers from A on stand
    for what does not move, and join nothing.
    """
    actors = len(island)
    for i in range(actors):
        island[i] = i
    for c in range(count):
        a, b = pairs[c, 0], pairs[c, 1]
        if a < actors and b < actors and island[a] != island[b]:
            low, high = min(island[a], island[b]), max(island[a], island[b])
            for i in range(actors):
                if island[i] == high:
                    island[i] = low


@in_place_kernel
def wake_touched(state: SleepState, wake_time: float) -> bool:
    """Wake every sleeping actor whose island holds an actor that is awake; return whether any was.

    Its counter is set to ``wake_time`` seconds.
    """
    island = state.island
    woken = False
    for i in range(len(island)):
        if state.asleep[i]:
            continue
        for j in range(len(island)):
            if state.asleep[j] and island[j] == island[i]:
                state.asleep[j] = False
                state.counter[j] = wake_time
                woken = True
    return woken


@in_place_kernel
def free_masses(bodies: Bodies, state: SleepState) -> None:
    """Fill inverse masses and inertias (world axes, R I^-1 R^T) of this step; sleepers get 0."""
    rot, inverse, free = bodies.rot, bodies.inv_inertia, bodies.free_inertia
    for a in range(len(state.asleep)):
        if state.asleep[a]:
            bodies.free_mass[a] = 0.0
            for i in range(3):
                for j in range(3):
                    free[a, i, j] = 0.0
            continue
        bodies.free_mass[a] = bodies.inv_mass[a]
        for i in range(3):
            r0 = r1 = r2 = 0.0
            for k in range(3):
                r0 += rot[a, i, k] * inverse[a, k, 0]
                r1 += rot[a, i, k] * inverse[a, k, 1]
                r2 += rot[a, i, k] * inverse[a, k, 2]
            for j in range(3):
                free[a, i, j] = r0 * rot[a, j, 0] + r1 * rot[a, j, 1] + r2 * rot[a, j, 2]


# The wake counter runs down from wake_time. In its last half, velocities are summed up, so that a
# shake to and fro cancels and a drift does not: with sums V and W over those steps,
#     E = (V . V + (W . I W) / m) / 2                (m^2/s^2, energy by mass of the summed motion)
# is compared with L = (1 + neighbours) threshold. Where E >= L, the sums are cleared and the
# counter becomes min(E / L, 2) wake_time / 2 + neighbours dt; otherwise it loses dt. W is summed in
# body axes, so that a steady roll is not taken for rest.
# PhysX: `updateWakeCounter` (``lowleveldynamics``), whose cluster factor is 1 + neighbours, and the
# island manager's deactivation. No deviation is known.


@in_place_kernel
def update_sleep(
    pairs: I64,
    count: int,
    bodies: Bodies,
    move_v: F64,
    move_w: F64,
    state: SleepState,
    options: SleepOptions,
) -> None:
    """Advance the wake counters of all actors by a step, and let islands at rest fall asleep.

    Parameters
    ----------
    pairs, count
        As in `find_islands`, whose result is in ``state.island``.
    bodies : Bodies
        Orientations and masses.
    move_v, move_w : (A + 1, 3)
        Velocities that moved the poses.
    state : SleepState
        Is changed.
    options : SleepOptions
        Threshold, wake time, length of a step.
    """
    counter, sum_v, sum_w, asleep = state.counter, state.sum_v, state.sum_w, state.asleep
    threshold, wake_time, dt = options.threshold, options.wake_time, options.dt
    actors = len(counter)
    touching, island, rot, inertia = state.touching, state.island, bodies.rot, bodies.inertia
    for i in range(actors):
        for j in range(actors + 1):
            touching[i, j] = False
    for c in range(count):
        a, b = pairs[c, 0], pairs[c, 1]
        if a < actors:
            touching[a, b] = True
        if b < actors:
            touching[b, a] = True
    for i in range(actors):
        if asleep[i]:
            continue
        if counter[i] < COUNTING_FRACTION * wake_time or counter[i] < dt:
            energy = 0.0
            for j in range(3):
                sum_v[i, j] += move_v[i, j]
                energy += sum_v[i, j] ** 2
            for j in range(3):
                for k in range(3):
                    sum_w[i, j] += rot[i, k, j] * move_w[i, k]
            spin = 0.0
            for j in range(3):
                for k in range(3):
                    spin += sum_w[i, j] * inertia[i, j, k] * sum_w[i, k]
            energy += bodies.inv_mass[i] * spin
            neighbours = 0
            for j in range(actors + 1):
                neighbours += touching[i, j]
            limit = (1.0 + neighbours) * threshold
            if 0.5 * energy >= limit:
                for j in range(3):
                    sum_v[i, j] = 0.0
                    sum_w[i, j] = 0.0
                factor = min(0.5 * energy / limit, MAX_RESET) if limit > 0 else MAX_RESET
                counter[i] = factor * COUNTING_FRACTION * wake_time + dt * neighbours
                continue
        counter[i] = max(counter[i] - dt, 0.0)
    for i in range(actors):
        if island[i] != i:
            continue
        ready = True
        for j in range(actors):
            if island[j] == i and counter[j] > 0.0:
                ready = False
        if not ready:
            continue
        for j in range(actors):
            if island[j] == i and not asleep[j]:
                asleep[j] = True
                for k in range(3):
                    sum_v[j, k] = 0.0
                    sum_w[j, k] = 0.0
                    bodies.v[j, k] = 0.0
                    bodies.w[j, k] = 0.0
