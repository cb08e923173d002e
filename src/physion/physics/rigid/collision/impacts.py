"""Bodies that hit something on their way through a step stop there: continuous collision detection.

After the bodies have moved, the fast pairs are swept and the first hit is answered, until there is
none (each actor is stopped at most once in a step):

- an actor that is hit stays where it was at the time of impact t; the rest of the step is lost;
- with n the normal from B to A, u = (v_A - v_B) . n the speed of the bodies' origins, m_A, m_B the
  masses and e the restitution,

      P = -(1 + e) u / (1 / m_A + 1 / m_B),  v_A <- v_A + P n / m_A,  v_B <- v_B - P n / m_B

  if u < 0: the linear velocities change, without friction and without a torque;
- if one of the pair was stopped before, only the other's pose changes;
- hulls that overlap by a depth d at the start of the step are answered with u - 10 d / s in place
  of u, and go on with their new velocities by .15 of the smaller threshold, so that they do not
  stick.

Bodies that do not rotate gain no energy; one that spins may, because u holds the velocity that the
rotation gives its origin.

After PhysX 4 (``PxsCCD.cpp``: ``sweepAdvanceToToi``), with one pass. Deviations: the first hit of
all pairs is looked for anew after each stop, in place of islands with sorted times; the rest of a
way is swept along a straight line in place of the origin's arc; what does not move never counts as
stopped.
"""

from __future__ import annotations

import numpy as np

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.faces import Hulls
from physion.physics.rigid.collision.fast_pairs import (
    ALONG,
    DEPTH,
    Sweeps,
    SweepScene,
    any_fast,
    first_hit,
)
from physion.physics.rigid.collision.pairs import PairSpace
from physion.physics.rigid.collision.search import SearchScene, update_boxes
from physion.physics.rigid.motion import fill_rotations, move_pose
from physion.physics.rigid.sleeping import SleepState
from physion.physics.rigid.solver import F64, Bodies

DEPENETRATION = 10.0
"""Speed in m/s for each metre of overlap at the start of a step (PhysX)."""
ADVANCE = 0.15
"""Part of the smaller threshold by which overlapping bodies go on (PhysX:
``ccdAdvanceCoefficient``)."""
LEAST_SPEED = 1e-6
"""Metres per second: slower approaches are not answered (PhysX)."""


@in_place_kernel
def keep_start(bodies: Bodies, sweeps: Sweeps) -> None:
    """Remember the poses of all actors before they move."""
    for a in range(len(bodies.x)):
        for k in range(3):
            sweeps.start_x[a, k] = bodies.x[a, k]
        for k in range(4):
            sweeps.start_q[a, k] = bodies.q[a, k]


@in_place_kernel
def _origin(swept: SweepScene, i: int, x: F64, rot: F64, k: int) -> float:
    """Return coordinate ``k`` of the origin of body ``i``, whose actor has the pose x, rot."""
    local = swept.origin[i]
    return float(x[k] + rot[k, 0] * local[0] + rot[k, 1] * local[1] + rot[k, 2] * local[2])


@in_place_kernel
def _fill_motion(scene: SearchScene, swept: SweepScene, bodies: Bodies, sweeps: Sweeps) -> None:
    """Fill the ways of all bodies; ``bodies.rot`` becomes that of the poses at the end."""
    actors = len(bodies.x) - 1
    for i in range(len(scene.actor)):
        a = scene.actor[i]
        for k in range(3):
            sweeps.origin[i, k] = 0.0
            if a < actors:
                sweeps.origin[i, k] = _origin(swept, i, sweeps.start_x[a], bodies.rot[a], k)
    fill_rotations(bodies.q, bodies.rot, 0, actors)
    for i in range(len(scene.actor)):
        a = scene.actor[i]
        for k in range(3):
            start = sweeps.origin[i, k]
            sweeps.motion[i, k] = 0.0
            if a < actors:
                sweeps.origin[i, k] = _origin(swept, i, bodies.x[a], bodies.rot[a], k)
                sweeps.motion[i, k] = sweeps.origin[i, k] - start
    for a in range(actors + 1):
        sweeps.stopped[a] = False
        sweeps.stop_time[a] = 0.0


@in_place_kernel
def _speed(i: int, a: int, normal: F64, bodies: Bodies, sweeps: Sweeps) -> float:
    """Return the speed along ``normal`` of the origin of body ``i`` of actor ``a``."""
    speed = 0.0
    v, w, x, origin = bodies.v[a], bodies.w[a], bodies.x[a], sweeps.origin[i]
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        speed += normal[k] * (v[k] + w[m] * (origin[n] - x[n]) - w[n] * (origin[m] - x[m]))
    return speed


@in_place_kernel
def _respond(
    i: int,
    j: int,
    a: int,
    b: int,
    restitution: float,
    bodies: Bodies,
    sleep: SleepState,
    wake_time: float,
    sweeps: Sweeps,
) -> float:
    """Change the velocities of actors ``a`` and ``b`` at the hit; return the impulse in N s."""
    hit = sweeps.hit
    normal = hit[0:3]
    speed = _speed(i, a, normal, bodies, sweeps) - _speed(j, b, normal, bodies, sweeps)
    speed -= DEPENETRATION * hit[DEPTH]
    if speed >= -LEAST_SPEED:
        return 0.0
    impulse: float = -(1.0 + restitution) * speed / (bodies.inv_mass[a] + bodies.inv_mass[b])
    for k in range(3):
        bodies.v[a, k] += impulse * bodies.inv_mass[a] * normal[k]
        bodies.v[b, k] -= impulse * bodies.inv_mass[b] * normal[k]
    for c in (a, b):
        if c < len(sleep.asleep) and sleep.asleep[c]:
            sleep.asleep[c] = False
            sleep.counter[c] = wake_time
    return impulse


@in_place_kernel
def _stop(
    a: int,
    time: float,
    scene: SearchScene,
    swept: SweepScene,
    v: F64,
    w: F64,
    seconds: float,
    bodies: Bodies,
    sweeps: Sweeps,
) -> None:
    """Put actor ``a`` where it gets from its start with ``v``, ``w`` (A + 1, 3) in ``seconds``."""
    for k in range(3):
        bodies.x[a, k] = sweeps.start_x[a, k]
    for k in range(4):
        bodies.q[a, k] = sweeps.start_q[a, k]
    move_pose(bodies.x[a], bodies.q[a], v[a], w[a], seconds)
    fill_rotations(bodies.q, bodies.rot, a, a + 1)
    sweeps.stopped[a] = True
    sweeps.stop_time[a] = time
    for i in range(len(scene.actor)):
        if scene.actor[i] != a:
            continue
        for k in range(3):
            sweeps.origin[i, k] = _origin(swept, i, bodies.x[a], bodies.rot[a], k)
            sweeps.motion[i, k] = 0.0


@in_place_kernel
def stop_at_impacts(
    hulls: Hulls,
    scene: SearchScene,
    swept: SweepScene,
    bodies: Bodies,
    sleep: SleepState,
    move_v: F64,
    move_w: F64,
    dt: float,
    wake_time: float,
    sweeps: Sweeps,
    pair: PairSpace,
) -> int:
    """Stop the actors that hit something on their way through a step.

    Parameters
    ----------
    hulls, scene, swept
        The scene.
    bodies : Bodies
        Poses at the end of the step, ``rot`` at its start; velocities. Changed for what is hit;
        ``rot`` is left at some pose in the step.
    sleep : SleepState
        What is hit awakes, with a counter of ``wake_time`` seconds.
    move_v, move_w : (A + 1, 3)
        Velocities that moved the poses over ``dt`` seconds.
    sweeps : Sweeps
        Has the poses at the start of the step, from `keep_start`. ``contact`` and
        ``contact_bodies`` are filled with the hits; the rest is work space.
    pair : PairSpace
        Work space.

    Returns
    -------
    int
        The number of hits.
    """
    _fill_motion(scene, swept, bodies, sweeps)
    if not any_fast(scene, swept, sweeps):
        return 0
    actors = len(sleep.asleep)
    count = 0
    x, rot, stopped = bodies.x, bodies.rot, sweeps.stopped
    for _ in range(actors):
        update_boxes(hulls, scene, x, rot, 0.0, sweeps.box, sweeps.body_box, True)
        time = first_hit(hulls, scene, swept, x, rot, sweeps, pair)
        if time == np.inf:
            break
        hit = sweeps.hit
        i, j = sweeps.bodies[0], sweeps.bodies[1]
        a, b = scene.actor[i], scene.actor[j]
        impulse = 0.0
        onward = 0.0
        if not (stopped[a] or stopped[b]):
            restitution = 0.5 * (scene.material[i, 2] + scene.material[j, 2])
            impulse = _respond(i, j, a, b, restitution, bodies, sleep, wake_time, sweeps)
            if time == 0.0:
                g, h = sweeps.geoms[0], sweeps.geoms[1]
                onward = ADVANCE * min(swept.threshold[g], swept.threshold[h]) / hit[ALONG]
        for c in (a, b):
            if c == actors or stopped[c]:
                continue
            if onward > 0.0:
                _stop(c, 0.0, scene, swept, bodies.v, bodies.w, onward * dt, bodies, sweeps)
            else:
                _stop(c, time, scene, swept, move_v, move_w, time * dt, bodies, sweeps)
        for k in range(3):
            sweeps.contact[count, k] = hit[3 + k]
            sweeps.contact[count, 3 + k] = -hit[k]
        sweeps.contact[count, 6] = impulse
        sweeps.contact[count, 7] = -hit[DEPTH]
        sweeps.contact_bodies[count, 0], sweeps.contact_bodies[count, 1] = i, j
        count += 1
    return count
