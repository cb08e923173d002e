"""One step of all rigid bodies, from the contacts at the present poses to the next poses."""

from __future__ import annotations

from typing import NamedTuple

from physion.numerics.kernel import kernel
from physion.physics.rigid.motion import move_freely, move_poses
from physion.physics.rigid.sleeping import (
    SleepOptions,
    SleepState,
    find_islands,
    update_sleep,
    wake_touched,
)
from physion.physics.rigid.solver import solve_step
from physion.physics.rigid.solver_records import (
    F64,
    AnchorMemory,
    Bodies,
    ContactSet,
    SolverOptions,
    StepResult,
)


class StepOptions(NamedTuple):
    """Options of a step; ``gravity`` in m/s^2 downwards, ``max_angular_velocity`` in rad/s."""

    solver: SolverOptions
    sleep: SleepOptions
    gravity: float
    max_angular_velocity: float


@kernel
def advance(
    bodies: Bodies,
    contacts: ContactSet,
    anchors: AnchorMemory,
    sleep: SleepState,
    drag: F64,
    options: StepOptions,
) -> StepResult:
    """Move ``bodies`` by one step; poses, velocities and ``sleep`` are changed.

    In one compiled function, since each call from Python costs microseconds. The phases: wake what
    awake bodies touch; gravity and drag; contact impulses; poses move with the velocities of the
    position sweeps; bodies at rest fall asleep.

    Parameters
    ----------
    bodies : Bodies
        Actors, with the world as last row.
    contacts : ContactSet
        Contacts at the present poses.
    anchors : AnchorMemory
        That of the last step.
    sleep : SleepState
        Wake counters.
    drag : (B, 2)
        Linear and angular drag per second.
    options : StepOptions
        Tolerances, thresholds, gravity, length of a step.

    Returns
    -------
    StepResult
        Velocities that moved the poses, normal impulses, anchors for the next step.
    """
    dt, asleep = options.solver.dt, sleep.asleep
    actors = len(asleep)
    island = find_islands(contacts.bodies, actors)
    wake_touched(island, sleep, options.sleep.wake_time)
    move_freely(
        bodies.v, bodies.w, ~asleep, drag, options.gravity, options.max_angular_velocity, dt
    )
    # Sleepers get infinite mass, so that they do not give way.
    inv_mass, inv_inertia = bodies.inv_mass.copy(), bodies.inv_inertia.copy()
    for i in range(actors):
        if asleep[i]:
            inv_mass[i] = 0.0
            inv_inertia[i] = 0.0
    solid = Bodies(bodies.x, bodies.q, bodies.v, bodies.w, inv_mass, inv_inertia)
    result = solve_step(solid, contacts, anchors, options.solver)
    move_poses(bodies.x, bodies.q, result.move_v, result.move_w, dt)
    moved = Bodies(
        bodies.x, bodies.q, result.move_v, result.move_w, bodies.inv_mass, bodies.inv_inertia
    )
    update_sleep(contacts.bodies, island, moved, sleep, options.sleep)
    for i in range(actors):
        if asleep[i]:
            bodies.v[i] = 0.0
            bodies.w[i] = 0.0
    return result
