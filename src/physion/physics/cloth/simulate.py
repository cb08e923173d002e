"""Simulate cloth: sheets of particles that fall on rigid bodies whose motion is given.

The method is that of the official simulator, NVIDIA Flex (Macklin et al. 2014, see `solver`):
particles move freely, then passes over all constraints correct them, each particle by the mean of
its corrections. Bodies are filled with particles too, and a cloth particle keeps ``rest_distance``
from each of them, so that cloth lies at about that distance from a body, and closer under load.
With few passes on a fine sheet, springs and contacts stay soft. In the official trials both decide
whether a sheet that hangs between other bodies still presses on the patient, so that a stiffer
solver would agree less with them.

Before the cloth falls, bodies that may not move by themselves settle on the floor, as in Flex
(`settle_solids`). Bodies are not moved by cloth: the official solids weigh 25 to 500 kg, the sheet
half a kilogram.
Cloth does not touch itself or other cloth (official: self-collision off).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError, BadSceneError
from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import unit
from physion.numerics.rotations import rotate_vectors
from physion.physics.cloth.contacts import (
    MAX_NEIGHBOURS,
    BodyPoses,
    ClothOptions,
    Neighbours,
    Solids,
    find_neighbours,
    new_neighbours,
    new_poses,
    world_bounds,
)
from physion.physics.cloth.solids import (
    SolidBody,
    SolidParticles,
    SolidState,
    correct_solids,
    fill_bodies,
    fill_lattices,
    place_bodies,
    place_particles,
    rotate_by,
    solid_particles,
    spin_between,
    surface_particles,
)
from physion.physics.cloth.solver import CLOTH_CONTACT_GAP, ClothRecord, MovingSolids, run_cloth
from physion.physics.cloth.springs import sheet_springs, sheet_vertices
from physion.physics.engine import settings_tag
from physion.physics.trajectory import ENVIRONMENT, Contacts, Floats, State, Trajectory
from physion.scenes.scene import FRAME_TIME, GRAVITY, Quat, Scene, Vec3

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

REST_SPEED = 0.001
"""Metres per second: while all particles are slower, solids count as settled."""


@dataclass(frozen=True, slots=True)
class ClothSettings:
    """Constants of the cloth simulation. The defaults are those of the official cloth trials.

    "official" means that the command logs set it, "default" a default of TDW's Flex container
    (docs/official-system.md, section 3.8).

    - ``substeps`` of a frame and ``iterations`` of each: passes over the constraints (default).
    - ``rest_distance``: metres that cloth particles keep from solid particles: the effective
      thickness of the cloth (default: solid rest distance).
    - ``particle_spacing``: metres between the particles that fill a body (official).
    - ``floor_gap``: metres that cloth keeps from the floor (official: collision distance).
    - ``particle_friction``: friction coefficient with solid particles. The default was read as 0.5;
      1, which is sent for shapes, explains held-out official trials better
      (benchmarks/results/calibration_cloth.md).
    - ``floor_friction``: the same for the floor (official: static and dynamic friction).
    - ``damping``: drag per second (default; confirmed by the first contact frames of the official
      trials: without it cloth would land three frames earlier).
    - ``gravity``: metres per second squared, downwards (official).
    - ``search_margin``: metres beyond the rest distance in which solid particles are searched: how
      far a particle may move in the passes of one substep.
    """

    substeps: int = 3
    iterations: int = 8
    rest_distance: float = 0.125
    particle_spacing: float = 0.035
    floor_gap: float = 0.025
    particle_friction: float = 1.0
    floor_friction: float = 1.0
    damping: float = 1.0
    gravity: float = GRAVITY
    search_margin: float = 0.02

    def tag(self) -> str:
        """Return eight hexadecimal digits that change whenever a setting does."""
        return settings_tag(self)


@dataclass(frozen=True)
class ClothMotion:
    """Motion of the cloths of a scene: F frames, V vertices of all cloths.

    - ``vertices`` (F, V, 3): metres; one cloth after the other, each row by row along x then y.
    - ``distance`` (F,): gap in metres between agent and patient: the smallest distance of their
      particles less the rest distance, negative where they press on each other. NaN unless one is a
      cloth and the other a body.
    - ``contacts``: a row for each cloth and body (or floor) in each frame in which they touch: the
      point on the cloth's underside, the normal from the body to the cloth, and the impulse on the
      cloth.
    """

    vertices: Floats
    distance: Floats
    contacts: Contacts


def simulate_cloth(
    scene: Scene,
    rigid_positions: NDArray[np.floating],
    rigid_rotations: NDArray[np.floating],
    settings: ClothSettings | None = None,
    *,
    vertices: NDArray[np.floating] | None = None,
    velocities: NDArray[np.floating] | None = None,
    until_gap: float | None = None,
) -> ClothMotion:
    """Simulate the cloths of ``scene`` on its bodies, whose motion is given.

    A cloth that starts inside a body is pushed out at once.

    Parameters
    ----------
    scene : Scene
        Bodies, cloths, floor, agent and patient.
    rigid_positions, rigid_rotations : (F, N, 3), (F, N, 4)
        Pivots in metres and quaternions (w, x, y, z) of ``scene.bodies`` in every frame.
    settings : ClothSettings, optional
        By default those of the official trials.
    vertices, velocities : (V, 3), optional
        State from which the cloths start, in metres and m/s: that of frame 0. By default they are
        flat and at rest, and frame 0 follows the first step.
    until_gap : float, optional
        Gap in metres between agent and patient below which the motion ends with that frame; without
        effect if there are several cloths.

    Raises
    ------
    BadInputError
        If arrays have other shapes.
    BadSceneError
        If bodies appear or vanish.
    """
    if any(event.kind != "move" for event in scene.events):
        raise BadSceneError(
            f"scene {scene.name!r}: bodies may not appear or vanish beside cloth; leave out these "
            "events or the cloth"
        )
    rules = settings if settings is not None else ClothSettings()
    positions = np.ascontiguousarray(rigid_positions, np.float64)
    rotations = np.ascontiguousarray(rigid_rotations, np.float64)
    frames, bodies = len(positions), len(scene.bodies)
    if not frames or positions.shape != (frames, bodies, 3):
        raise BadInputError(
            f"cloth: positions have the shape {positions.shape}, not (frames, {bodies}, 3)"
        )
    if rotations.shape != (frames, bodies, 4):
        raise BadInputError(
            f"cloth: rotations have the shape {rotations.shape}, not {(frames, bodies, 4)}"
        )
    if vertices is None:
        # Frame 0 follows the first step, in which the bodies count as standing where it ends.
        positions = np.concatenate([positions[:1], positions])
        rotations = np.concatenate([rotations[:1], rotations])
    solids = fill_bodies(scene.bodies, rules.particle_spacing)
    flat = [sheet_vertices(cloth) for cloth in scene.cloths]
    at = _start(vertices, flat, "vertices")
    speed = _start(velocities, [np.zeros_like(sheet) for sheet in flat], "velocities")
    records = [
        _run(scene, n, at[n], speed[n], solids, positions, rotations, rules, until_gap)
        for n in range(len(scene.cloths))
    ]
    if vertices is None:
        records = [ClothRecord(*(part[1:] for part in record)) for record in records]
    frames = min((len(record.vertices) for record in records), default=frames)
    asked = [record.distance for record in records if not np.isnan(record.distance).all()]
    return ClothMotion(
        np.concatenate(
            [record.vertices for record in records] or [np.zeros((frames, 0, 3))], axis=1
        ).astype(np.float32),
        (asked[0] if asked else np.full(frames, np.nan)).astype(np.float32),
        _contacts(scene, records, rules),
    )


def _options(scene: Scene, settings: ClothSettings) -> ClothOptions:
    """Return the numbers that the compiled loops need."""
    return ClothOptions(
        FRAME_TIME,
        settings.substeps,
        settings.iterations,
        settings.rest_distance,
        settings.search_margin,
        scene.floor,
        settings.floor_gap,
        settings.particle_friction,
        settings.floor_friction,
        settings.damping,
        settings.gravity,
    )


def add_cloth(
    scene: Scene,
    rigid: Trajectory,
    settings: ClothSettings | None = None,
    *,
    start: State | None = None,
    until_contact: bool = False,
) -> Trajectory:
    """Return the trajectory of the scene's bodies with the motion of its cloths added.

    Contacts of both are merged in the order of frames. The result is never ``completed``, because
    cloth does not sleep. `BadInputError` if the bodies are not those of the scene.

    Parameters
    ----------
    scene, rigid
        The scene, and the trajectory of its bodies.
    settings : ClothSettings, optional
        By default those of the official trials.
    start : State, optional
        The state from which ``rigid`` started, if it was not the scene's.
    until_contact : bool
        End with the first frame in which cloth and patient touch, if nothing appears or vanishes:
        the label is then known.
    """
    with_state = start is not None and len(start.cloth_vertices) > 0
    motion = simulate_cloth(
        scene,
        rigid.positions,
        rigid.rotations,
        settings,
        vertices=start.cloth_vertices if start is not None and with_state else None,
        velocities=start.cloth_velocities if start is not None and with_state else None,
        until_gap=CLOTH_CONTACT_GAP if until_contact and not scene.events else None,
    )
    frames = len(motion.vertices)
    both = (rigid.contacts, motion.contacts)
    frame = np.concatenate([c.frame for c in both])
    order = np.argsort(frame, kind="stable")
    order = order[frame[order] < frames]
    return replace(
        rigid,
        positions=rigid.positions[:frames],
        rotations=rigid.rotations[:frames],
        velocities=rigid.velocities[:frames],
        angular_velocities=rigid.angular_velocities[:frames],
        cloth_vertices=motion.vertices,
        cloth_distance=motion.distance,
        contacts=Contacts(
            *(
                np.concatenate([getattr(c, name) for c in both])[order]
                for name in ("frame", "bodies", "point", "normal", "impulse")
            )
        ),
        completed=False,
    )


def _start(given: NDArray[np.floating] | None, default: list[F64], what: str) -> list[F64]:
    """Return a given state (V, 3) split by cloth, or the default; always as new arrays."""
    count = sum(len(sheet) for sheet in default)
    if given is None:
        return [sheet.copy() for sheet in default]
    if np.shape(given) != (count, 3):
        raise BadInputError(f"cloth: {what} have the shape {np.shape(given)}, not {(count, 3)}")
    ends = np.cumsum([len(sheet) for sheet in default])[:-1]
    return [part.astype(np.float64).copy() for part in np.split(np.asarray(given), ends)]


def _run(
    scene: Scene,
    number: int,
    points: F64,
    velocities: F64,
    solids: Solids,
    positions: F64,
    rotations: F64,
    settings: ClothSettings,
    until_gap: float | None,
) -> ClothRecord:
    """Simulate one cloth of the scene, to the end or until its gap is below ``until_gap``."""
    cloth, frames, bodies = scene.cloths[number], len(positions), len(scene.bodies)
    watched = _other_body(scene, cloth.name)
    record = ClothRecord(
        np.zeros((frames, len(points), 3)),
        np.full(frames, np.nan),
        np.full((frames, bodies + 1), np.inf),
        np.zeros((frames, bodies + 1, 2, 3)),
        np.zeros((frames, bodies + 1)),
    )
    particles = (
        surface_particles(scene.bodies[watched], settings.particle_spacing)
        if watched >= 0
        else np.zeros((0, 3))
    )
    scenery = MovingSolids(solids, positions, rotations, watched, particles)
    stop_below = -np.inf
    if until_gap is not None and len(scene.cloths) == 1:
        stop_below = until_gap + settings.rest_distance
    frames = run_cloth(
        np.ascontiguousarray(points.T),
        np.ascontiguousarray(velocities.T),
        sheet_springs(cloth),
        scenery,
        _options(scene, settings),
        stop_below,
        record,
    )
    record.distance[:] -= settings.rest_distance
    return ClothRecord(*(part[:frames] for part in record))


def _other_body(scene: Scene, cloth: str) -> int:
    """Return the body that is agent or patient where ``cloth`` is the other one; -1 if none is."""
    roles = (scene.roles.agent, scene.roles.patient)
    if cloth not in roles:
        return -1
    other = scene.index(roles[1] if roles[0] == cloth else roles[0])
    return other if other < len(scene.bodies) else -1


def _contacts(scene: Scene, records: list[ClothRecord], settings: ClothSettings) -> Contacts:
    """Return the contacts of all cloths, sorted by frame, then by pair."""
    rows = []
    for number, (cloth, record) in enumerate(zip(scene.cloths, records, strict=True)):
        # A correction by d metres within one step is a change of velocity by d / step.
        mass = cloth.mass / cloth.resolution**2
        impulse = record.normal_correction * mass * settings.substeps / FRAME_TIME
        touching = (record.gap <= 0) | (record.normal_correction > 0)
        for frame, body in np.argwhere(touching & np.isfinite(record.gap)):
            floor = body == len(scene.bodies)
            point, normal = record.contact[frame, body]
            pair = (ENVIRONMENT if floor else body, len(scene.bodies) + number)
            rows.append((frame, pair, point, normal, impulse[frame, body]))
    rows.sort(key=lambda row: (row[0], row[1]))
    if not rows:
        return Contacts.empty()
    frame, pair, point, normal, push = zip(*rows, strict=True)
    return Contacts(
        np.array(frame, np.int32),
        np.array(pair, np.int32),
        np.array(point, np.float32),
        np.array(normal, np.float32),
        np.array(push, np.float32),
    )


# Settling of solids filled with particles: fall on the floor, and push each other apart.
#
# The official cloth trials add solids one after the other, a little above the floor, and let them
# settle for some frames each. Particles of two solids keep the rest distance, so a solid that is
# added closer than that to another is thrown aside, and may fall over.
#
# The method is that of the cloth: solids move freely in every substep, and passes over their
# contacts
# (`physion.physics.cloth.solids.correct_solids`) then correct them.


@kernel
def settle(
    state: SolidState,
    added: int,
    solids: SolidParticles,
    lattices: Solids,
    options: ClothOptions,
    frames: int,
) -> int:
    """Let the first ``added`` solids settle; return how many frames it took, at most ``frames``.

    ``state`` is changed. It ends early once all particles are slower than `REST_SPEED`.
    """
    step = options.frame_time / options.substeps
    count, bodies = solids.local.shape[1], len(state.q)
    start, touching = np.zeros((3, count)), np.empty(count, np.int64)
    # All particles of a solid move: to keep candidates costs more than to scan again.
    reach = options.rest_distance + options.search_margin
    near = new_neighbours(count, MAX_NEIGHBOURS, lattices, reach, 0.0)
    before, poses = new_poses(bodies), new_poses(bodies)
    old_center, old_q = state.center.copy(), state.q.copy()
    for frame in range(frames):
        for _ in range(options.substeps):
            place_bodies(state, solids, before)
            old_center[:] = state.center
            old_q[:] = state.q
            for body in range(added):
                place_particles(state, solids, before, body, start)
                _fall(state, body, step, options)
            place_bodies(state, solids, poses)
            number = _search_solids(
                state, added, solids, lattices, options, poses, before, near, touching
            )
            for _ in range(options.iterations):
                correct_solids(state, added, solids, options, touching[:number], near, start, poses)
            for body in range(added):
                for k in range(3):
                    state.velocity[body, k] = (state.center[body, k] - old_center[body, k]) / step
                spin_between(old_q[body], state.q[body], step, state.spin[body])
        if _fastest(state, solids, added) < REST_SPEED:
            return frame + 1
    return frames


@kernel
def _fall(state: SolidState, body: int, step: float, options: ClothOptions) -> None:
    """Move a solid by ``step`` seconds of gravity and drag alone."""
    for k in range(3):
        state.velocity[body, k] -= step * options.damping * state.velocity[body, k]
        state.spin[body, k] -= step * options.damping * state.spin[body, k]
    state.velocity[body, 2] -= step * options.gravity
    for k in range(3):
        state.center[body, k] += step * state.velocity[body, k]
    rotate_by(state.q[body], step * state.spin[body])


@kernel
def _search_solids(
    state: SolidState,
    added: int,
    solids: SolidParticles,
    lattices: Solids,
    options: ClothOptions,
    poses: BodyPoses,
    before: BodyPoses,
    near: Neighbours,
    touching: I64,
) -> int:
    """Search the neighbours of all particles among the other solids; return how many may touch.

    ``poses`` and ``before`` are those at the end and at the start of the substep. ``near`` is
    filled, and ``touching`` (P,) with the particles that have neighbours or the floor near them.
    """
    reach = options.rest_distance + options.search_margin
    near_floor = options.floor + options.floor_gap + options.search_margin
    bodies = len(state.q)
    points = np.zeros(solids.local.shape)
    bounds = (np.empty((bodies, 3)), np.empty((bodies, 3)))
    others = (np.empty((bodies, 3)), np.empty((bodies, 3)))
    world_bounds(lattices, poses, reach, bounds[0], bounds[1])
    number = 0
    for body in range(added):
        place_particles(state, solids, poses, body, points)
        first, last = solids.first[body], solids.first[body + 1]
        others[0][:] = bounds[0]
        others[1][:] = bounds[1]
        for k in range(3):
            others[0][body, k], others[1][body, k] = np.inf, -np.inf
            for other in range(added, bodies):
                others[0][other, k], others[1][other, k] = np.inf, -np.inf
        part = Neighbours(
            near.counts[first:last],
            near.body[first:last],
            near.position[first:last],
            near.displacement[first:last],
            near.searched_at[:, first:last],
            near.reach,
            near.slack,
            near.scanned_at,
            near.candidate_counts,
            near.candidates,
        )
        find_neighbours(points[:, first:last], -1.0, lattices, poses, before, others, part)
        for p in range(first, last):
            if near.counts[p] > 0 or points[2, p] < near_floor:
                touching[number] = p
                number += 1
    return number


@kernel
def _fastest(state: SolidState, solids: SolidParticles, added: int) -> float:
    """Return the largest speed that a particle of the first ``added`` solids can have, m/s."""
    fastest = 0.0
    for body in range(added):
        speed = spin = 0.0
        for k in range(3):
            speed += state.velocity[body, k] ** 2
            spin += state.spin[body, k] ** 2
        fastest = max(fastest, np.sqrt(speed) + np.sqrt(spin) * solids.radius[body])
    return fastest


@lru_cache(maxsize=64)
def settled_poses(
    bodies: tuple[SolidBody, ...], options: ClothOptions, spacing: float, frames: int
) -> tuple[tuple[Vec3, Quat], ...]:
    """Return position and rotation (w, x, y, z) of solids that settled one after the other.

    A solid that keeps the rest distance from those before it falls straight down and stands on the
    floor. Otherwise all that were added so far settle for ``frames`` frames, or until they rest.

    Parameters
    ----------
    bodies : tuple of SolidBody
        In the order in which they are added.
    options : ClothOptions
        Distances, friction, gravity.
    spacing : float
        Metres between the particles of a solid.
    frames : int
        Frames for each.
    """
    lattices = fill_lattices([(body.shape, body.scale) for body in bodies], spacing)
    solids = solid_particles(bodies, spacing)
    rotations = np.array([unit(body.rotation) for body in bodies])
    state = SolidState(
        np.array([body.position for body in bodies]) + rotate_vectors(rotations, solids.center),
        rotations.copy(),
        np.zeros((len(bodies), 3)),
        np.zeros((len(bodies), 3)),
    )
    resting = True
    for number in range(len(bodies)):
        touches = _comes_close(state, number, solids, lattices, options)
        lowest = _lowest(state, number, solids)
        if resting and not touches:
            state.center[number, 2] += options.floor + options.floor_gap - lowest
            if not _comes_close(state, number, solids, lattices, options):
                continue
            state.center[number, 2] += lowest - options.floor - options.floor_gap
        resting = settle(state, number + 1, solids, lattices, options, frames) < frames
    turned = rotate_vectors(state.q, solids.center)
    return tuple(
        (tuple(x), tuple(q))
        for x, q in zip((state.center - turned).tolist(), state.q.tolist(), strict=True)
    )


def _comes_close(
    state: SolidState,
    number: int,
    solids: SolidParticles,
    lattices: Solids,
    options: ClothOptions,
) -> bool:
    """Return whether a solid is closer than the rest distance to one that was added before."""
    count = len(solids.center)
    poses = new_poses(count)
    place_bodies(state, solids, poses)
    points = np.zeros_like(solids.local)
    place_particles(state, solids, poses, number, points)
    points = np.ascontiguousarray(points[:, solids.first[number] : solids.first[number + 1]])
    bounds = (np.empty((count, 3)), np.empty((count, 3)))
    world_bounds(lattices, poses, options.rest_distance, bounds[0], bounds[1])
    bounds[0][number:], bounds[1][number:] = np.inf, -np.inf
    near = new_neighbours(points.shape[1], 1, lattices, options.rest_distance, 0.0)
    find_neighbours(points, -1.0, lattices, poses, poses, bounds, near)
    return bool(near.counts.any())


def _lowest(state: SolidState, number: int, solids: SolidParticles) -> float:
    """Return the height of the lowest particle of a solid, metres."""
    local = solids.local[:, solids.first[number] : solids.first[number + 1]].T
    return float(rotate_vectors(state.q[number], local)[:, 2].min() + state.center[number, 2])


def settle_solids(scene: Scene, settings: ClothSettings | None = None) -> Scene:
    """Return the scene with its kinematic bodies settled on the floor, as in Flex.

    The official cloth trials add solids one after the other, above the floor, and let each settle
    for ``settle_frames`` before they add the cloth. A body that keeps the rest distance from those
    before it stands so that its lowest particle is ``floor_gap`` above the floor; others are thrown
    aside (`physion.physics.cloth.simulate`). Scenes without cloth or without ``settle_frames`` are
    returned unchanged.
    """
    rules = settings if settings is not None else ClothSettings()
    if not (scene.cloths and scene.settle_frames):
        return scene
    falling = [body for body in scene.bodies if body.kinematic and not body.scenery]
    if not falling:
        return scene
    poses = settled_poses(
        tuple(SolidBody(b.shape, b.scale, b.position, b.rotation, b.mass) for b in falling),
        _options(scene, rules),
        rules.particle_spacing,
        scene.settle_frames,
    )
    settled = {body.name: pose for body, pose in zip(falling, poses, strict=True)}
    return replace(
        scene,
        bodies=tuple(
            replace(body, position=settled[body.name][0], rotation=settled[body.name][1])
            if body.name in settled
            else body
            for body in scene.bodies
        ),
    )
