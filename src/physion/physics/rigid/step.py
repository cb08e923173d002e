"""Steps of all rigid bodies in compiled code: contacts, impulses, poses, sleep, record.

`run_steps` moves a scene by many steps in one call. It neither allocates nor touches Python
objects, so that several runs can share the processor in threads; `RigidRun` holds its arrays and
makes room for more. One step is one frame:

1. boxes of the bodies, candidates, pushes, manifolds (`physion.physics.rigid.collision.search`);
2. islands of touching bodies; what an awake body touches is woken;
3. gravity, drag, cap of the angular velocity (`move_freely`);
4. contact impulses (`physion.physics.rigid.solver`), then the poses (`move_poses`);
5. the contacts are recorded, and bodies at rest fall asleep (`physion.physics.rigid.sleeping`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import cos_of, sin_of
from physion.numerics.kernel import in_place_kernel
from physion.numerics.linear_algebra import cross, unit
from physion.numerics.rotations import (
    conjugate,
    multiply_quaternions,
    rotate_vectors,
    rotation_matrices,
)
from physion.physics.rigid.bodies import RigidSettings, build_model
from physion.physics.rigid.collision.faces import Hulls
from physion.physics.rigid.collision.manifold import Manifolds, grown, new_manifolds
from physion.physics.rigid.collision.pairs import PairSpace, new_pair_space
from physion.physics.rigid.collision.search import (
    FULL,
    ContactList,
    SearchScene,
    SearchSpace,
    find_candidates,
    grown_search_space,
    list_contacts,
    new_contact_list,
    new_search_space,
    update_boxes,
    update_candidates,
)
from physion.physics.rigid.sleeping import (
    SleepOptions,
    SleepState,
    all_awake,
    find_islands,
    free_masses,
    update_sleep,
    wake_touched,
)
from physion.physics.rigid.solver import (
    Bodies,
    Constraints,
    SolverOptions,
    build_constraints,
    correct_positions,
    correct_velocities,
    new_constraints,
    remember_anchors,
)
from physion.physics.trajectory import State, Trajectory, summarise_contacts
from physion.scenes.scene import Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Flags = NDArray[np.bool_]

MIN_SPIN = 1e-12
"""Radians per second: keeps the cap of the angular velocity from dividing by zero."""
DONE, NEEDS_PAIRS, NEEDS_ROWS = 0, 1, 2
"""Results of `run_steps`: as many frames as asked, or no room for further pairs or records."""
RECORD_WIDTH = 8
"""Columns of a recorded contact: point (3), normal (3), impulse, gap."""


# Records that the compiled steps read and change.


class StepOptions(NamedTuple):
    """Options of a step.

    ``gravity`` in m/s^2 downwards, ``max_angular_velocity`` in rad/s, ``reach`` in metres: distance
    of surfaces below which points are contacts. ``floor``: its height in metres. ``persistent``:
    manifolds are kept from step to step.
    """

    solver: SolverOptions
    sleep: SleepOptions
    gravity: float
    max_angular_velocity: float
    reach: float
    floor: float
    persistent: bool


class EndRule(NamedTuple):
    """When a run ends.

    After ``most`` frames; or once all actors sleep and ``least`` frames are there, where actors
    whose first body's pivot is below ``floor`` metres do not count. ``asked`` (2,): two bodies;
    with ``until_touch`` the run also ends after the first frame in which they touch. ``pivot``
    (A, 3): the pivot of each actor's first body in the actor's frame.
    """

    least: int
    most: int
    floor: float
    until_touch: bool
    asked: I64
    pivot: F64


class Pushes(NamedTuple):
    """Q pushes.

    ``frame`` (Q,): the frame whose step starts with it. ``actor`` (Q,); A is none. ``impulse``
    (Q, 3): J in N s. ``point`` (Q, 3): where it acts, metres, world; NaN: at the centre of mass.
    """

    frame: I64
    actor: I64
    impulse: F64
    point: F64


class Work(NamedTuple):
    """Work space of a step: reused arrays without meaning between steps.

    ``touching`` (S, 2): actors of touching pairs. ``move_v``, ``move_w`` (A + 1, 3): velocities
    that move the poses.
    """

    pair: PairSpace
    contacts: ContactList
    rows: Constraints
    touching: I64
    move_v: F64
    move_w: F64


class History(NamedTuple):
    """What a run has recorded.

    - ``state`` (F, A + 1, 13): position, orientation, velocity, angular velocity of every actor.
    - ``frame``, ``bodies`` (R,), (R, 2), ``contact`` (R, RECORD_WIDTH): touching contacts; the
      floor is body N.
    - ``counters`` (3,): frames, contacts, and 1 once the run has ended.
    """

    state: F64
    frame: I64
    bodies: I64
    contact: F64
    counters: I64


# Free motion and integration: semi-implicit Euler, velocities first, then poses with the velocities
# at the end of the step. PhysX: `bodyCoreComputeUnconstrainedVelocity` and `integrateCore`.


@in_place_kernel
def move_freely(
    v: F64,
    w: F64,
    asleep: Flags,
    drag: F64,
    gravity: float,
    max_angular_velocity: float,
    dt: float,
) -> None:
    """Change velocities by a step of gravity and drag, and cap the angular velocity.

    Parameters
    ----------
    v, w : (B + 1, 3)
        Velocities in m/s and rad/s, world axes; changed, but for the last row and sleepers.
    asleep : (B,)
        Bodies that are not simulated.
    drag : (B, 2)
        Linear and angular drag c, d per second.
    gravity, max_angular_velocity, dt : float
        g in m/s^2 downwards, rad/s, seconds.

    Notes
    -----
    v <- (v - g dt z) max(1 - c dt, 0), w <- w max(1 - d dt, 0), then w <- w min(1, cap / |w|).
    """
    for i in range(len(asleep)):
        if asleep[i]:
            continue
        v[i, 2] -= gravity * dt
        keep_v, keep_w = max(1.0 - drag[i, 0] * dt, 0.0), max(1.0 - drag[i, 1] * dt, 0.0)
        for j in range(3):
            v[i, j] *= keep_v
            w[i, j] *= keep_w
        speed = np.sqrt(w[i, 0] * w[i, 0] + w[i, 1] * w[i, 1] + w[i, 2] * w[i, 2])
        factor = min(1.0, max_angular_velocity / max(speed, MIN_SPIN))
        for j in range(3):
            w[i, j] *= factor


@in_place_kernel
def move_poses(x: F64, q: F64, v: F64, w: F64, asleep: Flags, dt: float) -> None:
    """Move centres of mass ``x`` and orientations ``q`` by constant velocities over ``dt`` seconds.

    Parameters
    ----------
    x, q : (B + 1, 3), (B + 1, 4)
        Changed, but for the last row, which stands for the world.
    v, w : (B + 1, 3)
        Velocities in m/s and rad/s, world axes.
    asleep : (B,)
        Bodies that do not move.
    dt : float
        Seconds.

    Notes
    -----
    x <- x + v dt; q <- (cos(|w| dt / 2), sin(|w| dt / 2) w / |w|) q, then q <- q / |q|.
    """
    for i in range(len(x) - 1):
        if asleep[i]:
            continue
        for j in range(3):
            x[i, j] += v[i, j] * dt
        speed = np.sqrt(w[i, 0] ** 2 + w[i, 1] ** 2 + w[i, 2] ** 2)
        if speed == 0.0:
            continue
        half = 0.5 * speed * dt
        c, s = cos_of(half), sin_of(half) / speed
        dx, dy, dz = w[i, 0] * s, w[i, 1] * s, w[i, 2] * s
        qw, qx, qy, qz = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
        q[i, 0] = c * qw - dx * qx - dy * qy - dz * qz
        q[i, 1] = c * qx + dx * qw + dy * qz - dz * qy
        q[i, 2] = c * qy - dx * qz + dy * qw + dz * qx
        q[i, 3] = c * qz + dx * qy - dy * qx + dz * qw
        length = np.sqrt(q[i, 0] ** 2 + q[i, 1] ** 2 + q[i, 2] ** 2 + q[i, 3] ** 2)
        for j in range(4):
            q[i, j] /= length


@in_place_kernel
def fill_rotations(q: F64, rot: F64, start: int, stop: int) -> None:
    """Fill rows ``start`` to ``stop`` of ``rot`` (B, 3, 3) with the matrices of ``q`` (B, 4)."""
    for i in range(start, stop):
        w, x, y, z = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
        rot[i, 0, 0] = 1 - 2 * (y * y + z * z)
        rot[i, 0, 1] = 2 * (x * y - w * z)
        rot[i, 0, 2] = 2 * (x * z + w * y)
        rot[i, 1, 0] = 2 * (x * y + w * z)
        rot[i, 1, 1] = 1 - 2 * (x * x + z * z)
        rot[i, 1, 2] = 2 * (y * z - w * x)
        rot[i, 2, 0] = 2 * (x * z - w * y)
        rot[i, 2, 1] = 2 * (y * z + w * x)
        rot[i, 2, 2] = 1 - 2 * (x * x + y * y)


# Parts of a step, in the order of `run_steps`.


@in_place_kernel
def _push(
    bodies: Bodies,
    sleep: SleepState,
    pushes: Pushes,
    frame: int,
    wake_time: float,
    space: F64,
) -> None:
    """Apply the pushes of ``frame``: v += J / m, w += R I^-1 R^T (r x J); wake what is pushed.

    ``space`` (2, 3) is work space.
    """
    actors = len(sleep.asleep)
    rot, inverse = bodies.rot, bodies.inv_inertia
    torque, local = space[0], space[1]
    for k in range(len(pushes.frame)):
        a = pushes.actor[k]
        if pushes.frame[k] != frame or a == actors:
            continue
        impulse, point = pushes.impulse[k], pushes.point[k]
        for i in range(3):
            bodies.v[a, i] += impulse[i] * bodies.inv_mass[a]
        sleep.asleep[a] = False
        sleep.counter[a] = wake_time
        if np.isnan(point[0]):
            continue
        for i in range(3):
            m, n = (i + 1) % 3, (i + 2) % 3
            torque[i] = (point[m] - bodies.x[a, m]) * impulse[n] - (
                point[n] - bodies.x[a, n]
            ) * impulse[m]
        for i in range(3):
            local[i] = (
                rot[a, 0, i] * torque[0] + rot[a, 1, i] * torque[1] + rot[a, 2, i] * torque[2]
            )
        for i in range(3):
            spin = 0.0
            for j in range(3):
                along = 0.0
                for m in range(3):
                    along += inverse[a, j, m] * local[m]
                spin += rot[a, i, j] * along
            bodies.w[a, i] += spin


@in_place_kernel
def _list_touching(
    scene: SearchScene,
    manifolds: Manifolds,
    space: SearchSpace,
    candidates: int,
    actors: int,
    out: I64,
) -> int:
    """Fill ``out`` with the actors of touching pairs, sleeping ones too; return how many."""
    count = 0
    for c in range(candidates):
        s = space.candidate[c]
        if manifolds.touching[s] == 0:
            continue
        j = space.bodies[s, 1]
        out[count, 0] = scene.actor[space.bodies[s, 0]]
        out[count, 1] = scene.actor[j] if j < len(scene.actor) else actors
        count += 1
    return count


@in_place_kernel
def _record(
    contacts: ContactList, pairs: int, rows: Constraints, frame: int, asked: I64, history: History
) -> bool:
    """Record the contacts of a step that touch; return whether the asked bodies do.

    A contact touches where it has an impulse, or no gap.
    """
    used = history.counters[1]
    found = False
    for p in range(pairs):
        i, j = contacts.bodies[p, 0], contacts.bodies[p, 1]
        for c in range(contacts.first[p], contacts.first[p + 1]):
            if not (rows.normal_impulse[c] > 0.0 or contacts.gap[c] <= 0.0):
                continue
            history.frame[used] = frame
            history.bodies[used, 0], history.bodies[used, 1] = i, j
            for k in range(3):
                history.contact[used, k] = contacts.point[c, k]
                history.contact[used, 3 + k] = contacts.normal[p, k]
            history.contact[used, 6] = rows.normal_impulse[c]
            history.contact[used, 7] = contacts.gap[c]
            used += 1
            if (i == asked[0] and j == asked[1]) or (i == asked[1] and j == asked[0]):
                found = True
    history.counters[1] = used
    return found


@in_place_kernel
def record_state(bodies: Bodies, history: History) -> None:
    """Add the present state of all actors as the next frame."""
    frame = history.counters[0]
    for a in range(len(bodies.x)):
        for i in range(3):
            history.state[frame, a, i] = bodies.x[a, i]
            history.state[frame, a, 7 + i] = bodies.v[a, i]
            history.state[frame, a, 10 + i] = bodies.w[a, i]
        for i in range(4):
            history.state[frame, a, 3 + i] = bodies.q[a, i]
    history.counters[0] = frame + 1


@in_place_kernel
def _at_rest(bodies: Bodies, sleep: SleepState, rule: EndRule) -> bool:
    """Return whether every actor sleeps that has not fallen below the floor of the ending."""
    for a in range(len(sleep.asleep)):
        if sleep.asleep[a]:
            continue
        height = bodies.x[a, 2]
        fill_rotations(bodies.q, bodies.rot, a, a + 1)
        for j in range(3):
            height += bodies.rot[a, 2, j] * rule.pivot[a, j]
        if height >= rule.floor:
            return False
    return True


@in_place_kernel
def run_steps(
    hulls: Hulls,
    scene: SearchScene,
    bodies: Bodies,
    sleep: SleepState,
    drag: F64,
    pushes: Pushes,
    manifolds: Manifolds,
    space: SearchSpace,
    work: Work,
    options: StepOptions,
    rule: EndRule,
    first_frame: int,
    stop: int,
    history: History,
) -> int:
    """Move the scene until it ends, or until ``stop`` frames are recorded.

    Parameters
    ----------
    hulls, scene, drag, pushes
        What does not change; ``drag`` (A, 2) is linear and angular drag per second.
    bodies, sleep, manifolds, space, history
        State of the run; all are changed.
    work : Work
        Work space.
    options, rule
        Settings, and when the run ends.
    first_frame : int
        Number of the first recorded frame in the trial, for pushes.
    stop : int
        Frames; at most the room in ``history.state``.

    Returns
    -------
    int
        `DONE`; or what has no room. Nothing of the step at hand has happened then: the call can be
        repeated with more.
    """
    actors = len(sleep.asleep)
    dt = options.solver.dt
    contacts, rows = work.contacts, work.rows
    while history.counters[0] < stop and history.counters[2] == 0:
        frames = history.counters[0]
        if frames >= rule.most or (frames >= rule.least and _at_rest(bodies, sleep, rule)):
            history.counters[2] = 1
            break
        now = first_frame + frames
        idle = True
        for a in range(actors):
            idle = idle and sleep.asleep[a]
        for k in range(len(pushes.frame)):
            idle = idle and pushes.frame[k] != now
        if idle:
            record_state(bodies, history)
            continue
        fill_rotations(bodies.q, bodies.rot, 0, actors)
        space.counters[1] += 1
        update_boxes(
            hulls, scene, bodies.x, bodies.rot, options.reach, space.box,
            space.body_box, space.counters[1] == 1,
        )  # fmt: skip
        candidates = find_candidates(scene, manifolds, space, actors, options.floor, options.reach)
        room = len(history.frame) - history.counters[1]
        if candidates == FULL or 4 * candidates > room:
            space.counters[1] -= 1
            return NEEDS_PAIRS if candidates == FULL else NEEDS_ROWS
        _push(bodies, sleep, pushes, now, options.sleep.wake_time, rows.arm)
        update_candidates(
            hulls, scene, manifolds, space, candidates, bodies.x, bodies.q, bodies.rot,
            sleep.asleep, options.reach, options.floor, options.persistent, work.pair, False,
        )  # fmt: skip
        touching = _list_touching(scene, manifolds, space, candidates, actors, work.touching)
        find_islands(work.touching, touching, sleep.island)
        if wake_touched(sleep, options.sleep.wake_time):
            update_candidates(
                hulls, scene, manifolds, space, candidates, bodies.x, bodies.q, bodies.rot,
                sleep.asleep, options.reach, options.floor, options.persistent, work.pair, True,
            )  # fmt: skip
        pairs = list_contacts(
            scene, manifolds, space, candidates, bodies.x, bodies.rot, options.reach, contacts
        )
        move_freely(
            bodies.v, bodies.w, sleep.asleep, drag, options.gravity,
            options.max_angular_velocity, dt,
        )  # fmt: skip
        free_masses(bodies, sleep)
        build_constraints(contacts, pairs, manifolds, bodies, options.solver, rows)
        correct_positions(rows, contacts, pairs, manifolds, bodies, options.solver)
        for a in range(actors):
            for i in range(3):
                work.move_v[a, i] = bodies.v[a, i]
                work.move_w[a, i] = bodies.w[a, i]
        correct_velocities(rows, contacts, pairs, manifolds, bodies, options.solver)
        remember_anchors(contacts, pairs, rows.slipped, manifolds, bodies)
        move_poses(bodies.x, bodies.q, work.move_v, work.move_w, sleep.asleep, dt)
        touched = _record(contacts, pairs, rows, frames, rule.asked, history)
        update_sleep(
            work.touching, touching, bodies, work.move_v, work.move_w, sleep, options.sleep
        )
        record_state(bodies, history)
        if touched and rule.until_touch:
            history.counters[2] = 1
    return DONE


# Simulations of rigid bodies: make room for arrays, call the compiled steps, collect results.

PAIRS, ROWS, FRAMES = 64, 2048, 128
"""Room at the start for pairs of geoms, recorded contacts and frames; each is doubled when full."""


class RigidRun:
    """One simulation in progress: state of the actors, manifolds, and the record so far.

    ``start`` is the instant from which to continue: it becomes frame 0. Without it the scene's
    initial poses are at rest, and frame 0 follows the first step, as in the official recordings.
    ``present`` tells which bodies are in the scene, by default all.
    """

    def __init__(
        self,
        scene: Scene,
        settings: RigidSettings,
        start: State | None = None,
        present: Sequence[bool] | None = None,
    ) -> None:
        self.scene, self.settings = scene, settings
        self.model = model = build_model(scene, settings, present)
        actors, bodies = model.actors.count, len(scene.bodies)
        self.bodies = Bodies(
            x=model.actors.x.copy(),
            q=model.actors.q.copy(),
            rot=rotation_matrices(model.actors.q),
            v=np.zeros((actors + 1, 3)),
            w=np.zeros((actors + 1, 3)),
            inertia=model.inertia,
            inv_mass=model.inv_mass,
            inv_inertia=model.inv_inertia,
            free_mass=np.zeros(actors + 1),
            free_inertia=np.zeros((actors + 1, 3, 3)),
        )
        self.first_frame = 0
        self.sleep = all_awake(actors, settings.wake_time)
        self.search_scene = SearchScene(model.first_geom, model.actors.actor_of, model.material)
        geoms = len(model.hulls.margin)
        self.manifolds = new_manifolds(PAIRS)
        self.space = new_search_space(geoms, bodies, PAIRS)
        self.work = self._new_work(PAIRS)
        self.pushes = self._pushes()
        self.options = StepOptions(
            _solver_options(settings),
            SleepOptions(settings.sleep_threshold, settings.wake_time, settings.dt),
            settings.gravity,
            settings.max_angular_velocity,
            # Both surfaces have the offset.
            2.0 * settings.contact_offset,
            scene.floor,
            settings.persistent_manifolds,
        )
        self.history = History(
            np.zeros((FRAMES, actors + 1, 13)),
            np.zeros(ROWS, np.int64),
            np.zeros((ROWS, 2), np.int64),
            np.zeros((ROWS, RECORD_WIDTH)),
            np.zeros(3, np.int64),
        )
        if start is not None:
            self.restore(start)
            record_state(self.bodies, self.history)

    def run(self, least: int, most: int, until_touch: bool = False) -> None:
        """Simulate until the scene ends: see `physion.physics.rigid.step.EndRule`."""
        scene, model = self.scene, self.model
        asked = [scene.index(scene.roles.agent), scene.index(scene.roles.patient)]
        pivot = model.actors.pivot[model.actors.leader].reshape(-1, 3)
        rule = EndRule(
            least, most, scene.ending.floor, until_touch, np.array(asked, np.int64), pivot
        )
        self._run_to(most, rule)

    @property
    def touched(self) -> bool:
        """Return whether the last frame has a contact of agent and patient."""
        frames, rows, _ = self.history.counters
        asked = {
            self.scene.index(self.scene.roles.agent),
            self.scene.index(self.scene.roles.patient),
        }
        last = self.history.bodies[:rows][self.history.frame[:rows] == frames - 1]
        return any(set(pair) == asked for pair in last.tolist())

    def _run_to(self, stop: int, rule: EndRule) -> None:
        """Simulate until ``stop`` frames or the end, with as much room as is needed."""
        while True:
            result = run_steps(
                self.model.hulls,
                self.search_scene,
                self.bodies,
                self.sleep,
                self.model.actors.drag,
                self.pushes,
                self.manifolds,
                self.space,
                self.work,
                self.options,
                rule,
                self.first_frame,
                min(stop, len(self.history.state)),
                self.history,
            )
            if result == DONE:
                frames, _, ended = self.history.counters
                if ended or frames >= stop:
                    return
                self.history = self.history._replace(state=_doubled(self.history.state))
            elif result == NEEDS_PAIRS:
                capacity = 2 * len(self.manifolds.size)
                self.manifolds = grown(self.manifolds, capacity)
                self.space = grown_search_space(self.space, capacity)
                self.work = self._new_work(capacity)
            else:
                history = self.history
                self.history = history._replace(
                    frame=_doubled(history.frame),
                    bodies=_doubled(history.bodies),
                    contact=_doubled(history.contact),
                )

    def trajectory(self, engine: str) -> Trajectory:
        """Return all frames so far; ``engine`` is the name that is stored with them."""
        model = self.model
        frames, rows, _ = self.history.counters
        of_body = self.history.state[:frames, model.actors.actor_of]
        x, q, v, w = np.split(of_body, [3, 7, 10], axis=2)
        arm = rotate_vectors(q, model.actors.center)
        return Trajectory(
            positions=(x + rotate_vectors(q, model.actors.pivot)).astype(np.float32),
            rotations=multiply_quaternions(q, model.actors.rotation).astype(np.float32),
            velocities=(v + cross(w, arm)).astype(np.float32),
            angular_velocities=w.astype(np.float32),
            cloth_vertices=np.zeros((frames, 0, 3), np.float32),
            cloth_distance=np.full(frames, np.nan, np.float32),
            contacts=summarise_contacts(
                self.history.frame[:rows],
                self.history.bodies[:rows],
                self.history.contact[:rows],
                len(self.scene.bodies),
            ),
            completed=self.all_asleep(),
            engine=engine,
        )

    def all_asleep(self) -> bool:
        """Return whether every body sleeps that has not fallen below the floor of the ending."""
        asleep = self.sleep.asleep
        if asleep.all():
            return True
        actor = self.model.actors.actor_of
        rotated = rotate_vectors(self.bodies.q[actor], self.model.actors.pivot)
        height = (self.bodies.x[actor] + rotated)[:, 2]
        counted = actor[height >= self.scene.ending.floor]
        return bool(np.append(asleep, True)[counted].all())

    def _new_work(self, capacity: int) -> Work:
        """Return the work space for ``capacity`` pairs."""
        actors = self.model.actors.count
        return Work(
            new_pair_space(),
            new_contact_list(capacity),
            new_constraints(capacity, actors),
            np.zeros((capacity, 2), np.int64),
            np.zeros((actors + 1, 3)),
            np.zeros((actors + 1, 3)),
        )

    def _pushes(self) -> Pushes:
        """Return the pushes of the scene as arrays."""
        pushes, actor_of = self.scene.pushes, self.model.actors.actor_of
        nowhere = (np.nan, np.nan, np.nan)
        return Pushes(
            np.array([push.frame for push in pushes], np.int64),
            np.array([actor_of[self.scene.index(p.body)] for p in pushes], np.int64),
            np.array([push.impulse for push in pushes], np.float64).reshape(-1, 3),
            np.array([p.point or nowhere for p in pushes], np.float64).reshape(-1, 3),
        )

    def restore(self, start: State) -> None:
        """Set the actors from the state of the first body of each.

        The start itself is not recorded. If the caller records it, as frame 0, the first step leads
        to the frame after ``start.frame``; otherwise to ``start.frame`` itself.
        """
        bodies, model = self.bodies, self.model
        for actor, i in enumerate(model.actors.leader):
            rotation = np.asarray(start.rotations[i], np.float64)
            q = multiply_quaternions(unit(rotation), conjugate(model.actors.rotation[i]))
            bodies.q[actor] = q
            bodies.x[actor] = start.positions[i] - rotate_vectors(q, model.actors.pivot[i])
            bodies.w[actor] = start.angular_velocities[i]
            arm = rotate_vectors(q, model.actors.center[i])
            bodies.v[actor] = start.velocities[i] - cross(bodies.w[actor], arm)
        self.first_frame = start.frame


def _doubled(array: NDArray[np.generic]) -> NDArray:  # type: ignore[type-arg]
    """Return an array with twice the rows."""
    return np.concatenate([array, np.zeros_like(array)])


def _solver_options(settings: RigidSettings) -> SolverOptions:
    """Return the settings that the contact solver needs."""
    return SolverOptions(
        dt=settings.dt,
        position_iterations=settings.position_iterations,
        velocity_iterations=settings.velocity_iterations,
        friction_sweeps=settings.friction_sweeps,
        divide_friction=not settings.friction_doubling,
        bias=settings.bias,
        max_depenetration_speed=settings.max_depenetration_speed,
        bounce_threshold=settings.bounce_threshold,
        friction_gain=settings.friction_gain,
        patch_cosine=settings.patch_cosine,
        anchor_distance=settings.anchor_distance,
        anchor_gap=settings.anchor_gap,
    )
