"""The rigid-body engine: MuJoCo finds contacts, a solver written after PhysX 4 moves the bodies.

MuJoCo is used for collision detection alone; its dynamics is not. One step of 0.01 s is one frame:

1. contacts at the present poses (`find_contacts`, `manifold`);
2. pushes;
3. gravity, drag, cap of the angular velocity (`motion.move_freely`);
4. contact impulses (`solver.solve_step`);
5. poses move (`motion.move_poses`);
6. bodies at rest fall asleep (`sleeping`).

Steps 3 to 6 are one compiled call, `step.advance`.

The same scene gives the same bytes: nothing here is random, parallel or dependent on time.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.golden import version_digest
from physion.numerics.linear_algebra import apply, unit
from physion.numerics.rotations import conjugate, multiply_quaternions, rotate_vectors
from physion.physics.cloth.simulate import ClothSettings, add_cloth, settle_solids
from physion.physics.rigid.contact_record import ContactRecord
from physion.physics.rigid.find_contacts import ContactFinder
from physion.physics.rigid.model import build_model
from physion.physics.rigid.settings import RigidSettings
from physion.physics.rigid.sleeping import SleepOptions, SleepState
from physion.physics.rigid.solver_records import AnchorMemory, Bodies, SolverOptions, no_anchors
from physion.physics.rigid.step import StepOptions, advance
from physion.physics.trajectory import State, Trajectory
from physion.scenes.scene import Scene

F64 = NDArray[np.float64]

VERSION = 2
"""Version of the motion: to be raised, with the golden digests, when scenes move differently."""


class RigidEngine:
    """Simulator of rigid bodies, and of cloth that falls on them.

    Rigid bodies are moved first, by `RigidRun`; cloths then follow in
    `physion.physics.cloth.simulate`, without acting back on them.
    """

    def __init__(
        self, settings: RigidSettings | None = None, cloth: ClothSettings | None = None
    ) -> None:
        self.settings = settings if settings is not None else RigidSettings()
        self.cloth = cloth if cloth is not None else ClothSettings()

    @property
    def name(self) -> str:
        """``physion-<version>.<digest>+mujoco-<version>.<settings>.<cloth settings>``.

        The digest is that of the golden motions: engines of the same name move scenes alike.
        """
        engine = f"physion-{VERSION}.{version_digest('motion')}"
        tags = f"{self.settings.tag()}.{self.cloth.tag()}"
        return f"{engine}+mujoco-{mujoco.__version__}.{tags}"

    def simulate(
        self,
        scene: Scene,
        *,
        start: State | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> Trajectory:
        """Simulate ``scene`` until it ends; see `physion.physics.engine.Engine.simulate`."""
        if frames is not None and frames < 1:
            raise BadInputError(f"frames must be at least 1, not {frames}")
        scene = settle_solids(scene, self.cloth)
        run = RigidRun(scene, self.settings, start)
        limit = scene.ending.max_frames if frames is None else frames
        # Cloth does not sleep: with it a trial takes its whole time.
        least = limit if frames is not None or scene.cloths else scene.ending.min_frames
        asked = {scene.index(scene.roles.agent), scene.index(scene.roles.patient)}
        while len(run.history) < limit and not (len(run.history) >= least and run.all_asleep()):
            run.step()
            if until_contact and run.record.touches(asked):
                break
        rigid = run.trajectory(self.name)
        return add_cloth(scene, rigid, self.cloth, start=start) if scene.cloths else rigid


class RigidRun:
    """One simulation in progress: state of the actors, friction anchors, and the record so far."""

    def __init__(self, scene: Scene, settings: RigidSettings, start: State | None = None) -> None:
        self.scene, self.settings = scene, settings
        self.model = build_model(scene, settings)
        self.finder = ContactFinder(self.model, settings, scene.floor)
        model, actors = self.model, self.model.actors
        self.bodies = Bodies(
            model.start_x.copy(),
            model.start_q.copy(),
            np.zeros((actors + 1, 3)),
            np.zeros((actors + 1, 3)),
            model.inv_mass,
            model.inv_inertia,
        )
        self.frame = 0
        if start is not None:
            self._restore(start)
        self.anchors: AnchorMemory = no_anchors()
        self.sleep = SleepState(
            np.full(actors, settings.wake_time),
            np.zeros((actors, 3)),
            np.zeros((actors, 3)),
            np.zeros(actors, np.bool_),
        )
        self.options = StepOptions(
            _solver_options(settings),
            SleepOptions(settings.sleep_threshold, settings.wake_time, settings.dt),
            settings.gravity,
            settings.max_angular_velocity,
        )
        self.history: list[F64] = [self._state()]
        self.record = ContactRecord()

    def step(self) -> None:
        """Move by one frame."""
        model, bodies, sleep = self.model, self.bodies, self.sleep
        all_asleep = np.count_nonzero(sleep.asleep) == model.actors
        if all_asleep and all(push.frame != self.frame for push in self.scene.pushes):
            self.frame += 1
            self.history.append(self.history[-1])
            return
        contacts, pairs = self.finder.find(bodies.x, bodies.q)
        self._push()
        result = advance(bodies, contacts, self.anchors, sleep, model.drag, self.options)
        self.anchors = result.anchors
        self.frame += 1
        self.record.add(len(self.history), contacts, pairs, result.normal_impulse)
        self.history.append(self._state())

    def all_asleep(self) -> bool:
        """Return whether every body sleeps that has not fallen below the floor of the ending."""
        asleep = self.sleep.asleep
        if asleep.all():
            return True
        actor = self.model.actor_of
        rotated = rotate_vectors(self.bodies.q[actor], self.model.pivot)
        height = (self.bodies.x[actor] + rotated)[:, 2]
        counted = actor[height >= self.scene.ending.floor]
        return bool(np.append(asleep, True)[counted].all())

    def trajectory(self, engine: str) -> Trajectory:
        """Return all frames so far; ``engine`` is the name that is stored with them."""
        model = self.model
        frames = len(self.history)
        of_body = np.asarray(self.history)[:, model.actor_of]
        x, q, v, w = np.split(of_body, [3, 7, 10], axis=2)
        arm = rotate_vectors(q, model.center)
        return Trajectory(
            positions=(x + rotate_vectors(q, model.pivot)).astype(np.float32),
            rotations=multiply_quaternions(q, model.rotation).astype(np.float32),
            velocities=(v + np.cross(w, arm)).astype(np.float32),
            angular_velocities=w.astype(np.float32),
            cloth_vertices=np.zeros((frames, 0, 3), np.float32),
            cloth_distance=np.full(frames, np.nan, np.float32),
            contacts=self.record.contacts(),
            completed=self.all_asleep(),
            engine=engine,
        )

    def _state(self) -> F64:
        """Return position, orientation and velocities of all actors, (A + 1, 13)."""
        bodies = self.bodies
        return np.concatenate([bodies.x, bodies.q, bodies.v, bodies.w], axis=1)

    def _push(self) -> None:
        """Apply the pushes of this frame, J: v += J / m, w += I^-1 (r x J); wake what is pushed."""
        bodies, model = self.bodies, self.model
        for push in self.scene.pushes:
            if push.frame != self.frame:
                continue
            actor = model.actor_of[self.scene.index(push.body)]
            if actor == model.actors:
                continue
            impulse = np.asarray(push.impulse)
            bodies.v[actor] += impulse * model.inv_mass[actor]
            if push.point is not None:
                angular = np.cross(np.asarray(push.point) - bodies.x[actor], impulse)
                local = rotate_vectors(conjugate(bodies.q[actor]), angular)
                spin = apply(model.inv_inertia[actor], local)
                bodies.w[actor] += rotate_vectors(bodies.q[actor], spin)
            self.sleep.asleep[actor] = False
            self.sleep.counter[actor] = self.settings.wake_time

    def _restore(self, start: State) -> None:
        """Set the actors from the state of the first body of each."""
        bodies, model = self.bodies, self.model
        for actor in range(model.actors):
            i = int(np.flatnonzero(model.actor_of == actor)[0])
            rotation = np.asarray(start.rotations[i], np.float64)
            q = multiply_quaternions(unit(rotation), conjugate(model.rotation[i]))
            bodies.q[actor] = q
            bodies.x[actor] = start.positions[i] - rotate_vectors(q, model.pivot[i])
            bodies.w[actor] = start.angular_velocities[i]
            arm = rotate_vectors(q, model.center[i])
            bodies.v[actor] = start.velocities[i] - np.cross(bodies.w[actor], arm)
        self.frame = start.frame


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
