"""A second engine for rigid scenes: contacts and motion by MuJoCo's own solver.

It takes the same hulls, masses, materials and pushes as `physion.physics.rigid`, so that outcomes
on which both engines agree do not depend on how contacts are solved. MuJoCo's contacts are damped
springs with one coefficient of friction; those of the official simulator are hard.

The same scene gives the same bytes in every process: MuJoCo runs in one thread.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from physion.errors import BadSceneError
from physion.numerics.linear_algebra import apply, dot, inverse, norm, unit
from physion.numerics.rotations import conjugate, multiply_quaternions, rotate_vectors
from physion.physics.mujoco.contacts import ContactRows
from physion.physics.mujoco.model import compile_model
from physion.physics.mujoco.settings import MujocoSettings
from physion.physics.rigid.actors import find_actors
from physion.physics.rigid.motion import MIN_SPIN
from physion.physics.trajectory import State, Trajectory
from physion.scenes.scene import FRAME_TIME, Scene

F64 = NDArray[np.float64]

VERSION = 1
"""Version of the engine: to be raised when scenes move differently under the same settings."""


class MujocoEngine:
    """Simulator of rigid bodies by MuJoCo; `BadSceneError` for scenes with cloth."""

    simulates_cloth = False

    def __init__(self, settings: MujocoSettings | None = None) -> None:
        self.settings = settings if settings is not None else MujocoSettings()

    @property
    def name(self) -> str:
        """``mujoco-<version of MuJoCo>.<version of this engine>.<settings>``."""
        return f"mujoco-{mujoco.__version__}.{VERSION}.{self.settings.tag()}"

    def simulate(
        self,
        scene: Scene,
        *,
        start: State | None = None,
        frames: int | None = None,
        until_contact: bool = False,
    ) -> Trajectory:
        """Simulate ``scene`` until it ends; see `physion.physics.engine.Engine.simulate`."""
        least, most = scene.ending.frame_limits(frames)
        if scene.cloths:
            raise BadSceneError(
                f"scene {scene.name!r} has cloth, which the engine 'mujoco' does not simulate; "
                "use the engine 'physion'"
            )
        run = MujocoRun(scene, self.settings, start)
        asked = (scene.index(scene.roles.agent), scene.index(scene.roles.patient))
        pair = (min(asked), max(asked))
        while len(run.history) < most and not (len(run.history) >= least and run.is_over()):
            run.step()
            if until_contact and run.rows.touches(len(run.history) - 1, pair):
                break
        return run.trajectory(self.name)


class MujocoRun:
    """One simulation in progress: MuJoCo's model and state, and the record so far.

    ``start`` is the instant from which to continue: it becomes frame 0. Without it the bodies start
    at rest at the scene's poses, and frame 0 follows the first step, as in official recordings.

    Poses and velocities of all bodies stand in ``positions``, ``rotations``, ``velocities`` (of
    their centres of mass) and ``spins``; MuJoCo's model is built from them, again at every event.
    """

    def __init__(self, scene: Scene, settings: MujocoSettings, start: State | None = None) -> None:
        self.scene, self.settings = scene, settings
        count = len(scene.bodies)
        self.positions = np.array([b.position for b in scene.bodies], np.float64).reshape(-1, 3)
        self.rotations = unit(np.array([b.rotation for b in scene.bodies]).reshape(-1, 4))
        self.velocities, self.spins = np.zeros((count, 3)), np.zeros((count, 3))
        self.frame = -1
        if start is not None:
            self.frame = start.frame
            self.positions, self.rotations = start.positions.copy(), unit(start.rotations)
            self.velocities, self.spins = start.velocities.copy(), start.angular_velocities.copy()
        self.rows = ContactRows()
        self.history: list[tuple[F64, F64, F64, F64]] = []
        self.still = np.zeros(count)
        self._build(scene.present(max(self.frame, 0)))
        if start is not None:
            self._record()

    def step(self) -> None:
        """Move by one frame."""
        self.frame += 1
        if any(event.frame == self.frame for event in self.scene.events):
            self._take_events()
        self._push()
        speeds = self.data.qvel.reshape(-1, 6)
        speeds *= np.maximum(1.0 - np.repeat(self.actors.drag, 3, axis=1) * FRAME_TIME, 0.0)
        for _ in range(self.settings.substeps):
            self._cap_spins()
            mujoco.mj_step(self.model, self.data)
            self._note_contacts()
        self._read_bodies()
        self._record()

    def is_over(self) -> bool:
        """Return whether all bodies are at rest and no event is to come."""
        later = any(event.frame > self.frame for event in self.scene.events)
        return not later and self.all_at_rest()

    def all_at_rest(self) -> bool:
        """Return whether every body rests that has not fallen below the floor of the ending."""
        counted = self.positions[:, 2] >= self.scene.ending.floor
        counted &= self.actors.actor_of < self.actors.count
        return bool((self.still >= self.settings.rest_time)[counted].all())

    def trajectory(self, engine: str) -> Trajectory:
        """Return all frames so far; ``engine`` is the name that is stored with them."""
        frames = len(self.history)
        x, q, v, w = (np.asarray(part, np.float32) for part in zip(*self.history, strict=True))
        return Trajectory(
            positions=x,
            rotations=q,
            velocities=v,
            angular_velocities=w,
            cloth_vertices=np.zeros((frames, 0, 3), np.float32),
            cloth_distance=np.full(frames, np.nan, np.float32),
            contacts=self.rows.contacts(),
            completed=self.all_at_rest(),
            engine=engine,
        )

    def _build(self, present: tuple[bool, ...]) -> None:
        """Build MuJoCo's model of the bodies that are there, at their poses and velocities."""
        self.actors = find_actors(self.scene, present, self.positions, self.rotations)
        self.model, self.geom_body = compile_model(self.scene, self.actors, present, self.settings)
        self.data = mujoco.MjData(self.model)
        actors, speeds = self.actors, self.data.qvel.reshape(-1, 6)
        for actor in range(actors.count):
            i = actors.leader[actor]
            arm = rotate_vectors(actors.q[actor], actors.center[i])
            # MuJoCo's free bodies have their velocity in world axes and their spin in body axes.
            speeds[actor, :3] = self.velocities[i] - np.cross(self.spins[i], arm)
            speeds[actor, 3:] = rotate_vectors(conjugate(actors.q[actor]), self.spins[i])

    def _take_events(self) -> None:
        """Let bodies appear, vanish and move, and build the model again."""
        for event in self.scene.events:
            if event.frame != self.frame:
                continue
            i = self.scene.index(event.body)
            self.velocities[i] = self.spins[i] = self.still[i] = 0.0
            if event.position is not None:
                self.positions[i] = event.position
            if event.rotation is not None:
                self.rotations[i] = unit(event.rotation)
        self._build(self.scene.present(self.frame))

    def _push(self) -> None:
        """Apply the pushes of this frame, J: v += J / m, w += I^-1 (r x J)."""
        actors, speeds = self.actors, self.data.qvel.reshape(-1, 6)
        poses = self.data.qpos.reshape(-1, 7)
        for push in self.scene.pushes:
            actor = actors.actor_of[self.scene.index(push.body)]
            if push.frame != self.frame or actor == actors.count:
                continue
            impulse = np.asarray(push.impulse)
            speeds[actor, :3] += impulse / actors.mass[actor]
            if push.point is not None:
                angular = np.cross(np.asarray(push.point) - poses[actor, :3], impulse)
                local = rotate_vectors(conjugate(poses[actor, 3:]), angular)
                speeds[actor, 3:] += apply(inverse(actors.inertia[actor]), local)

    def _cap_spins(self) -> None:
        """Limit the angular velocities."""
        spins = self.data.qvel.reshape(-1, 6)[:, 3:]
        speed = np.maximum(norm(spins), MIN_SPIN)
        spins *= np.minimum(1.0, self.settings.max_angular_velocity / speed)[:, None]

    def _note_contacts(self) -> None:
        """Record the contacts of a step of MuJoCo."""
        contact = self.data.contact
        # Points that MuJoCo reports and leaves out of its equations do not touch.
        used = contact.efc_address >= 0
        self.rows.add(
            len(self.history),
            self.geom_body[contact.geom[used]],
            contact.pos[used],
            contact.frame[used, :3],
            self.data.efc_force[contact.efc_address[used]] * self.model.opt.timestep,
            contact.dist[used],
        )

    def _read_bodies(self) -> None:
        """Set poses and velocities of all bodies that move from those of their actors."""
        actors = self.actors
        poses, speeds = self.data.qpos.reshape(-1, 7), self.data.qvel.reshape(-1, 6)
        moving = np.flatnonzero(actors.actor_of < actors.count)
        of = actors.actor_of[moving]
        q = unit(poses[of, 3:])
        spins = rotate_vectors(q, speeds[of, 3:])
        arms = rotate_vectors(q, actors.center[moving])
        self.positions[moving] = poses[of, :3] + rotate_vectors(q, actors.pivot[moving])
        self.rotations[moving] = multiply_quaternions(q, actors.rotation[moving])
        self.velocities[moving] = speeds[of, :3] + np.cross(spins, arms)
        self.spins[moving] = spins
        local = speeds[:, 3:]
        spin_energy = dot(local, apply(actors.inertia, local)) / actors.mass
        energy = 0.5 * (dot(speeds[:, :3], speeds[:, :3]) + spin_energy)
        calm = (energy < self.settings.rest_energy)[of]
        self.still[moving] = np.where(calm, self.still[moving] + FRAME_TIME, 0.0)

    def _record(self) -> None:
        """Add the present state of all bodies as the next frame."""
        state = (self.positions, self.rotations, self.velocities, self.spins)
        x, q, v, w = (part.copy() for part in state)
        self.history.append((x, q, v, w))
