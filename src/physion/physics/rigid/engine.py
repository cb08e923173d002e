"""The rigid-body engine: MuJoCo's geometry and collisions, the official simulator's contact law.

A step of 0.01 s, one a frame: contacts at the present poses; pushes, gravity, drag and the cap of
the angular velocity; contact forces (`contact_solver`); poses move; then the velocities lose the
speed that only corrected penetration. The same scene gives the same bytes: nothing here is random,
parallel or dependent on time.
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
from physion.physics.rigid.settings import Settings
from physion.physics.rigid.sleeping import find_islands, update_sleep, wake_touched
from physion.physics.rigid.solver import (
    AnchorMemory,
    move_freely,
    move_poses,
    no_anchors,
    solve_step,
)
from physion.physics.trajectory import State, Trajectory
from physion.scenes.scene import Scene

Array = NDArray[np.float64]

VERSION = 2
"""Raised whenever a scene may move differently, together with the golden digests."""


class MujocoEngine:
    """Simulates rigid bodies, then what `physion.physics.cloth.simulate` lays over them."""

    def __init__(
        self, settings: Settings | None = None, cloth: ClothSettings | None = None
    ) -> None:
        self.settings = settings if settings is not None else Settings()
        self.cloth = cloth if cloth is not None else ClothSettings()

    @property
    def name(self) -> str:
        """``physion-<version>.<digest>+mujoco-<version>.<settings>.<cloth settings>``.

        The digest is that of the golden motions: engines of one name move scenes alike.
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
        """Move ``scene`` until it ends; see `physion.physics.engine.Engine.simulate`."""
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
    """A scene while it moves: state, memory of the contacts, and what was recorded so far."""

    def __init__(self, scene: Scene, settings: Settings, start: State | None = None) -> None:
        self.scene, self.settings = scene, settings
        self.model = build_model(scene, settings)
        self.finder = ContactFinder(self.model, settings, scene.floor)
        actors = self.model.actors
        self.x, self.q = self.model.start_x.copy(), self.model.start_q.copy()
        self.v, self.w = np.zeros((actors + 1, 3)), np.zeros((actors + 1, 3))
        self.frame = 0
        if start is not None:
            self._take(start)
        self.anchors: AnchorMemory = no_anchors()
        self.counter = np.full(actors, settings.wake_time)
        self.still_v, self.still_w = np.zeros((actors, 3)), np.zeros((actors, 3))
        self.asleep = np.zeros(actors, np.bool_)
        self.history: list[Array] = [self._actors()]
        self.record = ContactRecord()

    def step(self) -> None:
        """Move by one frame."""
        s, model = self.settings, self.model
        if self.asleep.all() and all(push.frame != self.frame for push in self.scene.pushes):
            self.frame += 1
            self.history.append(self.history[-1])
            return
        contacts, pairs = self.finder.find(self.x, self.q)
        self._push()
        island = find_islands(contacts.bodies, model.actors)
        wake_touched(island, self.asleep, self.counter, s.wake_time)
        awake = ~self.asleep
        self._free_motion(awake)
        move_v, move_w, load, *memory = solve_step(
            contacts, self.anchors, self.x, self.q, self.v, self.w,
            np.where(np.append(awake, True), model.inv_mass, 0.0),
            np.where(np.append(awake, True)[:, None, None], model.inv_inertia, 0.0),
            s.dt, s.position_iterations, s.velocity_iterations, s.friction_sweeps,
            not s.friction_doubling, s.bias, s.max_depenetration_speed, s.bounce_threshold,
            s.friction_gain, s.patch_cosine, s.anchor_distance, s.anchor_gap,
        )  # fmt: skip
        self.anchors = AnchorMemory(*memory)
        move_poses(self.x, self.q, move_v, move_w, s.dt)
        update_sleep(
            contacts.bodies, island, move_v, move_w, self.q, model.inv_inertia, model.inv_mass,
            self.counter, self.still_v, self.still_w, self.asleep,
            s.sleep_threshold, s.wake_time, s.dt,
        )  # fmt: skip
        self.v[:-1][self.asleep] = 0.0
        self.w[:-1][self.asleep] = 0.0
        self.frame += 1
        self.record.add(len(self.history), contacts, pairs, load)
        self.history.append(self._actors())

    def all_asleep(self) -> bool:
        """Every body sleeps that has not fallen below the floor of the ending."""
        if self.asleep.all():
            return True
        own = self.model.actor_of
        height = (self.x[own] + rotate_vectors(self.q[own], self.model.pivot))[:, 2]
        counted = np.unique(own[height >= self.scene.ending.floor])
        return bool(np.append(self.asleep, True)[counted].all())

    def trajectory(self, engine: str) -> Trajectory:
        """All frames so far."""
        model = self.model
        frames = len(self.history)
        of_body = np.asarray(self.history)[:, model.actor_of]
        x, q, v, w = np.split(of_body, [3, 7, 10], axis=2)
        arm = rotate_vectors(q, model.center)
        return Trajectory(
            positions=(x + rotate_vectors(q, model.pivot)).astype(np.float32),
            rotations=multiply_quaternions(q, model.turn).astype(np.float32),
            velocities=(v + np.cross(w, arm)).astype(np.float32),
            angular_velocities=w.astype(np.float32),
            cloth_vertices=np.zeros((frames, 0, 3), np.float32),
            cloth_distance=np.full(frames, np.nan, np.float32),
            contacts=self.record.contacts(),
            completed=self.all_asleep(),
            engine=engine,
        )

    def _actors(self) -> Array:
        return np.concatenate([self.x, self.q, self.v, self.w], axis=1)

    def _push(self) -> None:
        for push in self.scene.pushes:
            if push.frame != self.frame:
                continue
            actor = self.model.actor_of[self.scene.index(push.body)]
            if actor == self.model.actors:
                continue
            impulse = np.asarray(push.impulse)
            self.v[actor] += impulse * self.model.inv_mass[actor]
            if push.point is not None:
                turning = np.cross(np.asarray(push.point) - self.x[actor], impulse)
                local = rotate_vectors(conjugate(self.q[actor]), turning)
                spin = apply(self.model.inv_inertia[actor], local)
                self.w[actor] += rotate_vectors(self.q[actor], spin)
            self.asleep[actor] = False
            self.counter[actor] = self.settings.wake_time

    def _free_motion(self, awake: NDArray[np.bool_]) -> None:
        """Gravity, drag, and the cap of the angular velocity, for everything awake."""
        s, drag = self.settings, self.model.drag
        move_freely(self.v, self.w, awake, drag, s.gravity, s.max_angular_velocity, s.dt)

    def _take(self, start: State) -> None:
        """Set the actors from the state of the first body of each."""
        model = self.model
        for actor in range(model.actors):
            i = int(np.flatnonzero(model.actor_of == actor)[0])
            turn = np.asarray(start.rotations[i], np.float64)
            q = multiply_quaternions(unit(turn), conjugate(model.turn[i]))
            self.q[actor] = q
            self.x[actor] = start.positions[i] - rotate_vectors(q, model.pivot[i])
            self.w[actor] = start.angular_velocities[i]
            arm = rotate_vectors(q, model.center[i])
            self.v[actor] = start.velocities[i] - np.cross(self.w[actor], arm)
        self.frame = start.frame
