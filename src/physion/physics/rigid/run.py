"""Simulations of rigid bodies: make room for arrays, call the compiled steps, collect results."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from physion.numerics.linear_algebra import cross, unit
from physion.numerics.rotations import (
    conjugate,
    multiply_quaternions,
    rotate_vectors,
    rotation_matrices,
)
from physion.physics.contact_record import summarise_contacts
from physion.physics.rigid.collision.fast_pairs import new_sweeps
from physion.physics.rigid.collision.manifold import grown, new_manifolds
from physion.physics.rigid.collision.pair_distance import new_pair_space
from physion.physics.rigid.collision.search import (
    SearchScene,
    grown_search_space,
    new_contact_list,
    new_search_space,
)
from physion.physics.rigid.model import build_model
from physion.physics.rigid.settings import RigidSettings
from physion.physics.rigid.sleeping import SleepOptions, all_awake
from physion.physics.rigid.solver_records import Bodies, SolverOptions, new_constraints
from physion.physics.rigid.step import (
    DONE,
    NEEDS_PAIRS,
    RECORD_WIDTH,
    EndRule,
    History,
    Pushes,
    StepOptions,
    Work,
    record_state,
    run_steps,
)
from physion.physics.trajectory import State, Trajectory
from physion.scenes.scene import Scene

F64 = NDArray[np.float64]

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
            settings.continuous,
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
                self.model.swept,
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
            new_sweeps(len(self.model.hulls.margin), len(self.scene.bodies), actors),
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
