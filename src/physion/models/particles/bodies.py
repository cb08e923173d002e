"""Objects of a scene as particles, and their motion.

Rigid and kinematic bodies are particles that are fixed to a pose, cloths are their vertices.
Scenery is left out, since it takes part in no collision, and so are bodies that are absent.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from physion.clips.batch import Motion
from physion.core.errors import BadInputError
from physion.numerics.linear_algebra import cross, norm
from physion.numerics.rotations import rotation_matrices
from physion.physics.particles import sample_particles
from physion.scenes.scene import Body, Scene, Vec3
from physion.scenes.shapes.primitives import shape

# Particles on the surface of a shape, evenly spaced, corners first.

F64 = NDArray[np.float64]

_FINE = 3
"""Candidates per distance of neighbouring points."""
_KEPT = 8192
"""Shapes whose points are kept, about 5 kB each: several models ask for those of all trials in
turn."""


def surface_points(shape_name: str, scale: Vec3, spacing: float, limit: int) -> tuple[F64, F64]:
    """Return points (P, 3) on the surface of a shape and unit normals (P, 3), in the body's frame.

    They are chosen one after the other, each the candidate farthest from those before, until every
    candidate has one closer than ``spacing`` (Gonzalez 1985) or there are ``limit`` points, so that
    a limit thins them evenly. The corners of the mesh are the first candidates, beginning with the
    one farthest from the middle of the bounds; then follow points on edges and faces. Where faces
    meet, the normal is the mean of theirs.

    Parameters
    ----------
    shape_name, scale
        Shape and its factors along x, y, z.
    spacing : float
        Metres; larger than 0.
    limit : int
        Largest number of points, at least 1.

    Raises
    ------
    UnknownNameError
        If there is no such shape.
    BadInputError
        If the spacing is not above 0, the limit below 1, or the shape has no faces.

    References
    ----------
    T. F. Gonzalez, Clustering to minimize the maximum intercluster distance, Theoretical Computer
    Science 38, 1985.
    """
    if not spacing > 0 or limit < 1:
        raise BadInputError(
            f"particles need a spacing above 0 m and a limit of at least 1, not {spacing} m and "
            f"{limit}"
        )
    x, y, z = (float(value) for value in scale)
    points, normals = _spread(shape_name, (x, y, z), float(spacing), int(limit))
    return points.copy(), normals.copy()


@lru_cache(maxsize=_KEPT)
def _spread(shape_name: str, scale: Vec3, spacing: float, limit: int) -> tuple[F64, F64]:
    candidates, normals, corner = _candidates(shape_name, scale, spacing, limit)
    middle = (candidates.min(axis=0) + candidates.max(axis=0)) / 2
    chosen: list[int] = []
    nearest = np.full(len(candidates), np.inf)
    first = norm(candidates - middle)
    for allowed in (corner, np.ones_like(corner)):
        while len(chosen) < limit:
            farthest = int(np.argmax(np.where(allowed, nearest if chosen else first, -1.0)))
            if nearest[farthest] < spacing:
                break
            chosen.append(farthest)
            nearest = np.minimum(nearest, norm(candidates - candidates[farthest]))
    return candidates[chosen], normals[chosen]


def _candidates(
    shape_name: str, scale: Vec3, spacing: float, limit: int
) -> tuple[F64, F64, NDArray[np.bool_]]:
    """Return points on the surface, their normals, and which are corners of the mesh.

    The others are the middles of sides of split faces.

    The longest side of every face is halved until it is at most a third of the spacing, or of the
    distance that ``limit`` points on the surface have, sqrt(area / limit).
    """
    mesh = shape(shape_name).mesh.moved(scale)
    if len(mesh.faces) == 0:
        raise BadInputError(f"shape {shape_name!r} has no faces on which particles could lie")
    faces = mesh.vertices[mesh.faces]
    areas = cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]) / 2
    total = float(np.sum(norm(areas)))
    longest = max(spacing, math.sqrt(total / limit)) / _FINE
    points, normals = [faces.reshape(-1, 3)], [np.repeat(areas, 3, axis=0)]
    while len(faces):
        sides = np.stack([norm(faces[:, (k + 1) % 3] - faces[:, k]) for k in range(3)], axis=1)
        split = sides.max(axis=1) > longest
        faces, areas, first = faces[split], areas[split], np.argmax(sides[split], axis=1)
        rows = np.arange(len(faces))
        a, b, c = (faces[rows, (first + k) % 3] for k in range(3))
        middle = (a + b) / 2
        points.append(middle)
        normals.append(areas)
        faces = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
        areas = np.concatenate([areas, areas]) / 2
    rounded = np.round(np.concatenate(points), 6)
    unique, place = np.unique(rounded, axis=0, return_inverse=True)
    sums = np.zeros_like(unique)
    np.add.at(sums, place.ravel(), np.concatenate(normals))
    outward: F64 = sums / np.maximum(norm(sums), 1e-12)[:, None]
    corner = np.zeros(len(unique), np.bool_)
    corner[place.ravel()[: len(points[0])]] = True
    return np.asarray(unique, np.float64), outward, corner


I64 = NDArray[np.int64]

RIGID, KINEMATIC, CLOTH, FREE = 0, 1, 2, 3
"""Kinds of objects. Those from `CLOTH` on consist of particles that move on their own; `FREE` are
bodies that nothing keeps rigid, in the published form alone."""
Fill = Literal["surface", "volume"]

MAX_PARTICLES = 200_000
"""Largest number of particles of one scene."""


@dataclass(frozen=True)
class ParticleSettings:
    """How objects become particles.

    - ``spacing``: metres between particles. ``limit``: largest number for one body,
      ``still_limit``: for a kinematic one, which may be large.
    - ``fill``: ``volume``, as the original study, or ``surface``.
    - ``inner``: how many of the nearest particles of its own rigid body a particle is linked to.
    - ``cloth_step``: every how many vertices of a cloth, along both sides, is a particle.
    - ``cloth_spacing``: metres between particles of bodies in scenes with cloth; by default as in
      the others.
    """

    spacing: float = 0.10
    limit: int = 100
    still_limit: int = 600
    fill: Fill = "surface"
    cloth_step: int = 3
    inner: int = 0
    cloth_spacing: float | None = None

    def __post_init__(self) -> None:
        counts = min(self.limit, self.still_limit, self.cloth_step)
        spacing = min(self.spacing, self.cloth_spacing or self.spacing)
        if not spacing > 0 or counts < 1 or self.fill not in ("surface", "volume"):
            raise BadInputError(
                "particles: the spacing must be above 0 m, limits and cloth_step at least 1, and "
                f"fill surface or volume, not {self.spacing}, {self.limit}, {self.still_limit}, "
                f"{self.cloth_step} and {self.fill!r}"
            )


@dataclass(frozen=True, eq=False)
class SceneParticles:
    """Particles of one scene: K objects, P particles in blocks by object.

    - ``things`` (K,): index of each object in `Scene.names`.
    - ``kinds`` (K,): `RIGID`, `KINEMATIC`, `CLOTH` or `FREE`.
    - ``owners`` (P,): row of the object of each particle.
    - ``normals`` (P, 3): outward unit normals in the body's frame; 0 where there is none, as in
      cloths and volumes.
    - ``shape`` (P, 3): metres, offset of each particle from the mean of its object's particles, in
      the body's frame; 0 for cloth.
    - ``pivots`` (K, 3): the mean of the particles in the body's frame; 0 for cloth.
    - ``vertices`` (C,): row in `Trajectory.cloth_vertices` of each particle of a cloth.
    - ``links`` (2, L): edges within objects, rows of particles, both ways: along the sides and
      diagonals of the grid of a cloth, and between near particles of a rigid body.
    - ``floor``: height of the floor, metres.
    - ``agent``, ``patient``: rows of objects, -1 for one that is absent.
    """

    name: str
    things: I64
    kinds: I64
    owners: I64
    shape: F64
    normals: F64
    pivots: F64
    vertices: I64
    links: I64
    floor: float
    agent: int
    patient: int

    @property
    def sizes(self) -> F64:
        """Root mean square (K,) of the offsets of an object's particles, metres; at least 1 mm."""
        count = len(self.kinds)
        squares = np.bincount(self.owners, (self.shape**2).sum(axis=1), count)
        return np.maximum(np.sqrt(squares / np.bincount(self.owners, minlength=count)), 1e-3)

    @property
    def loose(self) -> NDArray[np.bool_]:
        """Which particles (P,) move on their own: those of cloths and free bodies."""
        return np.asarray(self.kinds[self.owners] >= CLOTH)


@dataclass(frozen=True, eq=False)
class Poses:
    """Motion of the objects of one scene over T frames.

    - ``centers`` (T, K, 3): metres, mean of the particles of each object.
    - ``rotations`` (T, K, 3, 3): of bodies; the identity for cloths and free bodies.
    - ``loose`` (T, C, 3): positions of the particles that move on their own.
    """

    centers: F64
    rotations: F64
    loose: F64


_Key = tuple[int, ParticleSettings, tuple[bool, ...]]
_kept: OrderedDict[_Key, tuple[Scene, SceneParticles]] = OrderedDict()
"""Particles of the scenes that were asked for last, and the scenes, so that their ids stay."""
_BODIES_KEPT = 4_000_000
"""Largest number of particles that are kept, about 0.5 GB."""
_lock = threading.Lock()


def scene_particles(
    scene: Scene, settings: ParticleSettings, present: Sequence[bool] | None = None
) -> SceneParticles:
    """Return the particles of the objects of a scene.

    Parameters
    ----------
    scene
        The scene.
    settings
        Spacing, limit and fill.
    present
        Which bodies and cloths are there, in the order of `Scene.names`; by default all.

    Raises
    ------
    BadInputError
        If no object is left, or there are more than `MAX_PARTICLES`.
    """
    there = tuple(present) if present is not None else (True,) * len(scene.names())
    key = (id(scene), settings, there)
    with _lock:
        found = _kept.get(key)
        if found is not None:
            _kept.move_to_end(key)
            return found[1]
    particles = _sample(scene, settings, there)
    with _lock:
        _kept[key] = scene, particles
        while len(_kept) > 1 and sum(len(p.owners) for _, p in _kept.values()) > _BODIES_KEPT:
            _kept.popitem(last=False)
    return particles


def poses_of(particles: SceneParticles, motion: Motion, frames: Sequence[int]) -> Poses:
    """Return the motion of the objects of a scene in the given frames; of free bodies the poses.

    Raises `BadInputError` for a motion that is not known, as of a trial imported from a movie.
    """
    scene, trajectory = motion.scene, motion.trajectory
    rows = np.asarray(frames, np.int64)
    bodies = particles.things < len(scene.bodies)
    things = particles.things[bodies]
    positions = trajectory.positions[np.ix_(rows, things)].astype(np.float64)
    if not np.isfinite(positions).all():
        raise BadInputError(
            f"trial {scene.name!r} has no motion ({trajectory.engine}), which particles need"
        )
    count = len(particles.things)
    rotations = np.broadcast_to(np.eye(3), (len(rows), count, 3, 3)).copy()
    quaternions = trajectory.rotations[np.ix_(rows, things)].astype(np.float64)
    rotations[:, bodies] = rotation_matrices(quaternions / norm(quaternions)[..., None])
    centers = np.zeros((len(rows), count, 3))
    shift = (rotations[:, bodies] @ particles.pivots[bodies][None, :, :, None])[..., 0]
    centers[:, bodies] = positions + shift
    loose = trajectory.cloth_vertices[np.ix_(rows, particles.vertices)].astype(np.float64)
    owners = particles.owners[(particles.kinds == CLOTH)[particles.owners]]
    for row in np.flatnonzero(~bodies):
        centers[:, row] = loose[:, owners == row].mean(axis=1)
    return Poses(centers, rotations, loose)


def later_poses(poses: Poses, first: int) -> Poses:
    """Return a motion from row ``first`` on."""
    return Poses(poses.centers[first:], poses.rotations[first:], poses.loose[first:])


def put_by_events(scene: Scene, first: int, last: int) -> list[int]:
    """Return the things that appear or are moved by an event after frame ``first``, up to ``last``.

    They are where they are without having gone there.
    """
    return [
        scene.index(event.body)
        for event in scene.events
        if event.kind != "vanish" and first < event.frame <= last
    ]


def join_poses_in_time(first: Poses, second: Poses) -> Poses:
    """Return a motion followed by another one of the same objects."""
    return Poses(
        np.concatenate([first.centers, second.centers]),
        np.concatenate([first.rotations, second.rotations]),
        np.concatenate([first.loose, second.loose]),
    )


def particle_positions(particles: SceneParticles, poses: Poses) -> F64:
    """Return the positions (T, P, 3) of all particles in every row of a motion, metres."""
    rotations = poses.rotations[:, particles.owners]
    rotated = (rotations @ particles.shape[None, :, :, None])[..., 0]
    positions = poses.centers[:, particles.owners] + rotated
    positions[:, particles.loose] = poses.loose
    return positions


def _sample(scene: Scene, settings: ParticleSettings, present: tuple[bool, ...]) -> SceneParticles:
    if scene.cloths and settings.cloth_spacing is not None:
        settings = replace(settings, spacing=settings.cloth_spacing)
    things, kinds, normals, pivots = [], [], [], []
    shapes: list[F64] = []
    vertices, links = [np.zeros(0, np.int64)], [np.zeros((2, 0), np.int64)]
    for index, body in enumerate(scene.bodies):
        if body.scenery or not present[index]:
            continue
        points, outward = _points(body, settings)
        normals.append(outward)
        pivot = points.mean(axis=0)
        things.append(index)
        kinds.append(KINEMATIC if body.kinematic else RIGID)
        if not body.kinematic and settings.inner:
            links.append(_nearest(points, settings.inner) + sum(len(part) for part in shapes))
        pivots.append(pivot)
        shapes.append(points - pivot)
    for number, cloth in enumerate(scene.cloths):
        things.append(len(scene.bodies) + number)
        kinds.append(CLOTH)
        pivots.append(np.zeros(3))
        rows, grid = _grid(cloth.resolution, settings.cloth_step)
        before = sum(sheet.resolution**2 for sheet in scene.cloths[:number])
        links.append(grid + sum(len(points) for points in shapes))
        vertices.append(rows + before)
        shapes.append(np.zeros((len(rows), 3)))
        normals.append(np.zeros((len(rows), 3)))
    if not things:
        raise BadInputError(f"scene {scene.name!r} has no object that can become particles")
    counts = [len(points) for points in shapes]
    if sum(counts) > MAX_PARTICLES:
        raise BadInputError(
            f"scene {scene.name!r} has {sum(counts)} particles, at most {MAX_PARTICLES}: use a "
            "larger spacing or a smaller limit"
        )
    row_of = {thing: row for row, thing in enumerate(things)}
    agent, patient = (scene.index(name) for name in (scene.roles.agent, scene.roles.patient))
    return SceneParticles(
        name=scene.name,
        things=np.array(things, np.int64),
        kinds=np.array(kinds, np.int64),
        owners=np.repeat(np.arange(len(things)), counts),
        shape=np.concatenate(shapes),
        normals=np.concatenate(normals),
        pivots=np.array(pivots),
        vertices=np.concatenate(vertices),
        links=np.concatenate(links, axis=1),
        floor=scene.floor,
        agent=row_of.get(agent, -1),
        patient=row_of.get(patient, -1),
    )


def _nearest(points: F64, count: int) -> I64:
    """Return the links (2, L), both ways, of each point (P, 3) to the ``count`` nearest ones."""
    others = min(count, len(points) - 1)
    if others < 1:
        return np.zeros((2, 0), np.int64)
    near = cKDTree(points).query(points, others + 1)[1][:, 1:]
    pairs = np.stack([np.repeat(np.arange(len(points)), others), near.ravel()], axis=1)
    both = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    return np.asarray(both[both[:, 0] != both[:, 1]].T, np.int64)


def _grid(resolution: int, step: int) -> tuple[I64, I64]:
    """Return which vertices (C,) of a square sheet are particles, and their links (2, L)."""
    along = np.arange(0, resolution, step)
    rows = (along[:, None] * resolution + along[None, :]).ravel()
    count = len(along)
    number = np.arange(count * count).reshape(count, count)
    pairs = [
        (number[1:], number[:-1]),
        (number[:, 1:], number[:, :-1]),
        (number[1:, 1:], number[:-1, :-1]),
        (number[1:, :-1], number[:-1, 1:]),
    ]
    first = np.concatenate([a.ravel() for a, _ in pairs])
    second = np.concatenate([b.ravel() for _, b in pairs])
    links = np.stack([np.concatenate([first, second]), np.concatenate([second, first])])
    return rows.astype(np.int64), links.astype(np.int64)


def _points(body: Body, settings: ParticleSettings) -> tuple[F64, F64]:
    """Return particles of a body and their normals."""
    limit = settings.still_limit if body.kinematic else settings.limit
    if settings.fill == "surface":
        return surface_points(body.shape, body.scale, settings.spacing, limit)
    points = sample_particles(body.shape, body.scale, settings.spacing, limit).astype(np.float64)
    return points, np.zeros_like(points)
