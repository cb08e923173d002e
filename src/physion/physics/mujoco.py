"""A second engine for rigid scenes: contacts and motion by MuJoCo's own solver.

It takes the same hulls, masses, materials and pushes as `physion.physics.rigid`, so that outcomes
on which both engines agree do not depend on how contacts are solved. MuJoCo's contacts are damped
springs with one coefficient of friction; contacts of the official simulator are hard.

The same scene gives the same bytes in every process: MuJoCo runs in one thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadSceneError, MissingExtraError
from physion.numerics.elementary import log_of
from physion.numerics.linear_algebra import apply, dot, inverse, norm, unit
from physion.numerics.rotations import conjugate, multiply_quaternions, rotate_vectors
from physion.physics.engine import settings_tag
from physion.physics.rigid.bodies import FLOOR_MATERIAL, Actors, collision_hulls, find_actors
from physion.physics.rigid.step import MIN_SPIN
from physion.physics.trajectory import ENVIRONMENT, Contacts, State, Trajectory, summarise_contacts
from physion.scenes.scene import FRAME_TIME, GRAVITY, Scene, SurfaceMaterial

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


try:
    import mujoco
except ModuleNotFoundError as error:
    raise MissingExtraError("the engine mujoco", "mujoco") from error

# Contacts, collected step by step and summed up for each pair.


class ContactRows:
    """Touching points of all steps so far."""

    def __init__(self) -> None:
        self._frames: list[I64] = []
        self._pairs: list[I64] = []
        self._values: list[F64] = []

    def add(
        self, frame: int, pairs: I64, points: F64, normals: F64, impulses: F64, gaps: F64
    ) -> None:
        """Add the touching points of a step that leads to ``frame``.

        Parameters
        ----------
        frame
            Index of the frame in the trajectory.
        pairs : (C, 2)
            Scene bodies, or the floor.
        points, normals : (C, 3)
            Metres; unit vectors from the first to the second body. World axes.
        impulses, gaps : (C,)
            Newton seconds along the normal; metres, negative where surfaces overlap.
        """
        if len(pairs) == 0:
            return
        self._frames.append(np.full(len(pairs), frame))
        self._pairs.append(pairs)
        self._values.append(np.column_stack([points, normals, impulses, gaps]))

    def touches(self, frame: int, pair: tuple[int, int]) -> bool:
        """Return whether two bodies touch in ``frame``, the latest one."""
        for at, pairs in zip(reversed(self._frames), reversed(self._pairs), strict=True):
            if at[0] != frame:
                break
            if (np.sort(pairs, axis=1) == sorted(pair)).all(axis=1).any():
                return True
        return False

    def contacts(self) -> Contacts:
        """Return one row for each touching pair and frame: its deepest point, its whole impulse."""
        if not self._frames:
            return Contacts.empty()
        pairs, values = np.concatenate(self._pairs), np.concatenate(self._values)
        return summarise_contacts(np.concatenate(self._frames), pairs, values, ENVIRONMENT)


# Constants of the MuJoCo engine: time step, contact, friction, rest.


@dataclass(frozen=True, slots=True)
class MujocoSettings:
    """Constants of the MuJoCo engine, the same for all scenarios.

    - ``substeps``: steps of MuJoCo for each frame of 0.01 s.
    - ``gravity``: metres per second squared, downwards.
    - ``contact_time``: seconds in which a contact settles, `solref[0]` of MuJoCo: its contacts are
      damped springs. Shorter ones are stiffer. Of .005, .01 and .02, this one agrees best with
      the outcomes of the official scenes.
    - ``friction_factor``: factor of the mean dynamic friction of both materials. MuJoCo has one
      coefficient for sticking and sliding. 2 as in the official simulator, whose flat contacts
      have twice the friction of Coulomb's law; 1.5 agrees less with its outcomes.
    - ``torsion``: friction against rotation about the normal, metres.
    - ``max_angular_velocity``: radians per second, about the centre of mass (Unity: 7).
    - ``rest_energy``: kinetic energy by mass in m²/s² below which a body counts as still;
      ``rest_time``: seconds after which a still body is at rest.
    - ``floor``: friction and restitution of the floor (Unity's default material).
    """

    substeps: int = 4
    gravity: float = GRAVITY
    contact_time: float = 0.01
    friction_factor: float = 2.0
    torsion: float = 0.02
    max_angular_velocity: float = 7.0
    rest_energy: float = 1e-4
    rest_time: float = 0.4
    floor: SurfaceMaterial = FLOOR_MATERIAL

    def tag(self) -> str:
        """Return eight hexadecimal digits that change whenever a setting does."""
        return settings_tag(self)


# MuJoCo's model of a scene: a free body for every actor, a convex mesh for every piece.

LEAST_DAMPING = 0.01
"""Smallest damping ratio of a contact, so that its spring is not infinitely slow to settle."""


def compile_model(
    scene: Scene, actors: Actors, active: tuple[bool, ...], settings: MujocoSettings
) -> tuple[Any, I64]:
    """Return MuJoCo's model, and for each of its geoms the body, or `ENVIRONMENT` for the floor.

    Friction is a property of each pair of geoms, because MuJoCo would take the larger coefficient
    of two materials, and the official simulator takes their mean.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = FRAME_TIME / settings.substeps
    spec.option.gravity = [0.0, 0.0, -settings.gravity]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    places = [_add_actor(spec, actors, actor) for actor in range(actors.count)]
    places.append(spec.worldbody)
    floor = spec.worldbody.add_geom()
    floor.name, floor.type = _geom_name(ENVIRONMENT, 0), mujoco.mjtGeom.mjGEOM_PLANE
    floor.size, floor.pos = [0.0, 0.0, 1.0], [0.0, 0.0, scene.floor]
    pieces: list[list[str]] = []
    for i, body in enumerate(scene.bodies):
        hulls = collision_hulls(body.shape, body.scale) if active[i] and not body.scenery else []
        pieces.append([_geom_name(i, k) for k in range(len(hulls))])
        for name, hull in zip(pieces[-1], hulls, strict=True):
            corners = actors.pivot[i] + rotate_vectors(actors.rotation[i], hull.corners)
            _add_hull(spec, places[actors.actor_of[i]], name, corners)
    for i, body in enumerate(scene.bodies):
        if actors.actor_of[i] == actors.count:
            continue
        _add_pairs(spec, pieces[i], [floor.name], body.contact, settings.floor, settings)
        for j, other in enumerate(scene.bodies):
            # A pair of moving bodies is met twice.
            first = actors.actor_of[j] == actors.count or i < j
            if first and actors.actor_of[i] != actors.actor_of[j]:
                _add_pairs(spec, pieces[i], pieces[j], body.contact, other.contact, settings)
    model = spec.compile()
    names = [model.geom(geom).name for geom in range(model.ngeom)]
    return model, np.array([int(name.partition(" ")[0]) for name in names], np.int64)


def _geom_name(body: int, piece: int) -> str:
    return f"{body} {piece}"


def _add_actor(spec: Any, actors: Actors, actor: int) -> Any:
    """Add the free body of an actor, with its mass and its origin at the centre of mass."""
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.explicitinertial = True
    body.mass, body.ipos = actors.mass[actor], [0.0, 0.0, 0.0]
    inertia = actors.inertia[actor]
    body.fullinertia = [*np.diagonal(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    body.pos, body.quat = actors.x[actor], actors.q[actor]
    return body


def _add_hull(spec: Any, place: Any, name: str, corners: F64) -> None:
    """Add a convex piece with these corners (K, 3) to a body; it collides in pairs only."""
    mesh = spec.add_mesh()
    mesh.name = name
    mesh.uservert = corners.ravel().tolist()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    geom = place.add_geom()
    geom.name, geom.type, geom.meshname = name, mujoco.mjtGeom.mjGEOM_MESH, name
    geom.contype = geom.conaffinity = 0


def _add_pairs(
    spec: Any,
    pieces: list[str],
    others: list[str],
    a: SurfaceMaterial,
    b: SurfaceMaterial,
    settings: MujocoSettings,
) -> None:
    """Let ``pieces`` of a body of material ``a`` collide with ``others`` of material ``b``."""
    sliding = settings.friction_factor * (a.dynamic_friction + b.dynamic_friction) / 2
    solref = contact_spring((a.restitution + b.restitution) / 2, settings.contact_time)
    for piece in pieces:
        for other in others:
            pair = spec.add_pair()
            pair.geomname1, pair.geomname2 = piece, other
            pair.condim = 4
            pair.friction = [sliding, sliding, settings.torsion, 0.0, 0.0]
            pair.solref = solref


def contact_spring(restitution: float, contact_time: float) -> list[float]:
    """Return time constant and damping ratio of a contact, MuJoCo's ``solref``.

    A spring with the damping ratio z throws a body back with exp(-pi z / sqrt(1 - z²)) of its
    speed, so that z = L / sqrt(pi² + L²) with L = -log(restitution). The frequency of the spring,
    1 / (time constant times z), is the same for all materials.
    """
    if restitution <= 0.0:
        return [contact_time, 1.0]
    log = -float(log_of(restitution))
    damping = max(log / math.sqrt(math.pi * math.pi + log * log), LEAST_DAMPING)
    return [contact_time / damping, damping]


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
        """Set poses and velocities of all moving bodies from their actors."""
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
