"""Objects of a scene as particles, and their motion.

Rigid and kinematic bodies are particles that are fixed to a pose, cloths are their vertices.
Scenery is left out, since it takes part in no collision, and so are bodies that are absent.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from physion.clips.batch import Motion
from physion.clips.states import kept_bytes
from physion.core.errors import BadInputError
from physion.numerics.linear_algebra import cross, norm
from physion.numerics.rotations import rotation_matrices
from physion.scenes.scene import Body, Scene, Vec3
from physion.scenes.shapes.primitives import shape

# Particles on the surface of a shape, evenly spaced, corners first.

F64 = NDArray[np.float64]

_FINE = 3
"""Candidates per distance of neighbouring points."""
_KEPT = 8192
"""Shapes whose points are kept, about 5 kB each: several models ask for the shapes of all trials in
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

RIGID, KINEMATIC, CLOTH = 0, 1, 2
"""Kinds of objects. Cloths consist of particles that move on their own."""

MAX_PARTICLES = 200_000
"""Largest number of particles of one scene."""


@dataclass(frozen=True)
class Sampling:
    """How objects become particles.

    - ``spacing``: metres between particles. ``limit``: largest number for one body,
      ``still_limit``: for a kinematic one, which may be large.
    - ``inner``: how many of the nearest particles of its own rigid body a particle is linked to.
    - ``within``: no links; instead particles of one object are neighbours while they are near.
    - ``cloth_step``: every how many vertices of a cloth, along both sides, is a particle.
    - ``free``: whether the particles of rigid bodies move on their own, so that bodies deform.
    """

    spacing: float = 0.10
    limit: int = 100
    still_limit: int = 600
    cloth_step: int = 3
    inner: int = 0
    within: bool = False
    free: bool = False

    def __post_init__(self) -> None:
        counts = min(self.limit, self.still_limit, self.cloth_step)
        if not self.spacing > 0 or counts < 1:
            raise BadInputError(
                "particles: the spacing must be above 0 m, limits and cloth_step at least 1, not "
                f"{self.spacing}, {self.limit}, {self.still_limit} and {self.cloth_step}"
            )


@dataclass(frozen=True, eq=False)
class SceneParticles:
    """Particles of one scene: K objects, P particles in blocks by object.

    - ``things`` (K,): index of each object in `Scene.names`.
    - ``kinds`` (K,): `RIGID`, `KINEMATIC` or `CLOTH`.
    - ``owners`` (P,): row of the object of each particle.
    - ``normals`` (P, 3): outward unit normals in the body's frame; 0 where there is none, as in
      cloths.
    - ``shape`` (P, 3): metres, offset of each particle from the mean of its object's particles, in
      the body's frame; 0 for cloth.
    - ``pivots`` (K, 3): the mean of the particles in the body's frame; 0 for cloth.
    - ``vertices`` (C,): row in `Trajectory.cloth_vertices` of each particle of a cloth.
    - ``links`` (2, L): edges within objects, rows of particles, both ways: along the sides and
      diagonals of the grid of a cloth, and between near particles of a rigid body.
    - ``floor``: height of the floor, metres.
    - ``agent``, ``patient``: rows of objects, -1 for one that is absent.
    - ``free``: whether the particles of rigid bodies move on their own.
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
    free: bool = False

    @property
    def sizes(self) -> F64:
        """Root mean square (K,) of the offsets of an object's particles, metres; at least 1 mm."""
        count = len(self.kinds)
        squares = np.bincount(self.owners, (self.shape**2).sum(axis=1), count)
        return np.maximum(np.sqrt(squares / np.bincount(self.owners, minlength=count)), 1e-3)

    @property
    def loose(self) -> NDArray[np.bool_]:
        """Which particles (P,) move on their own: of cloths, and of bodies that are free."""
        kinds = self.kinds[self.owners]
        return np.asarray((kinds == CLOTH) | ((kinds == RIGID) & self.free))


@dataclass(frozen=True, eq=False)
class Poses:
    """Motion of the objects of one scene over T frames.

    - ``centers`` (T, K, 3): metres, mean of the particles of each object.
    - ``rotations`` (T, K, 3, 3): of bodies, a fit where they deform; the identity for cloths.
    - ``loose`` (T, C, 3): positions of the particles that move on their own.
    """

    centers: F64
    rotations: F64
    loose: F64


_Key = tuple[str, Sampling, tuple[bool, ...]]
_kept: OrderedDict[_Key, tuple[Scene, SceneParticles]] = OrderedDict()
"""Particles of the scenes that were asked for last, and the scenes. A training reads a scene anew
where there are more motions than fit into memory; it still has its particles."""
_BYTES = 125
"""Of a particle that is kept, about."""
_lock = threading.Lock()


def scene_particles(
    scene: Scene, sampling: Sampling, present: Sequence[bool] | None = None
) -> SceneParticles:
    """Return the particles of the objects of a scene.

    Parameters
    ----------
    scene
        The scene.
    sampling
        Distances and numbers of particles.
    present
        Which bodies and cloths are there, in the order of `Scene.names`; by default all.

    Raises
    ------
    BadInputError
        If no object is left, or there are more than `MAX_PARTICLES`.
    """
    there = tuple(present) if present is not None else (True,) * len(scene.names())
    key = (scene.name, sampling, there)
    with _lock:
        found = _kept.get(key)
        # Another scene can have this name.
        if found is not None and (found[0] is scene or found[0] == scene):
            _kept.move_to_end(key)
            return found[1]
    particles = _sample(scene, sampling, there)
    with _lock:
        _kept[key] = scene, particles
        most = kept_bytes() // _BYTES
        while len(_kept) > 1 and sum(len(p.owners) for _, p in _kept.values()) > most:
            _kept.popitem(last=False)
    return particles


def poses_of(particles: SceneParticles, motion: Motion, frames: Sequence[int]) -> Poses:
    """Return the motion of the objects of a scene in the given frames.

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
    if particles.free:
        placed = posed_positions(particles, centers, rotations)
        placed[:, (particles.kinds == CLOTH)[particles.owners]] = loose
        loose = placed[:, particles.loose]
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


def posed_positions(particles: SceneParticles, centers: F64, rotations: F64) -> F64:
    """Return where particles (T, P, 3) would be if all objects were rigid, metres.

    The other arguments are as in `Poses`.
    """
    rotated = (rotations[:, particles.owners] @ particles.shape[None, :, :, None])[..., 0]
    positions: F64 = centers[:, particles.owners] + rotated
    return positions


def particle_positions(particles: SceneParticles, poses: Poses) -> F64:
    """Return the positions (T, P, 3) of all particles in every row of a motion, metres."""
    positions = posed_positions(particles, poses.centers, poses.rotations)
    positions[:, particles.loose] = poses.loose
    return positions


def _sample(scene: Scene, sampling: Sampling, present: tuple[bool, ...]) -> SceneParticles:
    things, kinds, normals, pivots = [], [], [], []
    shapes: list[F64] = []
    vertices, links = [np.zeros(0, np.int64)], [np.zeros((2, 0), np.int64)]
    for index, body in enumerate(scene.bodies):
        if body.scenery or not present[index]:
            continue
        points, outward = _points(body, sampling)
        normals.append(outward)
        pivot = points.mean(axis=0)
        things.append(index)
        kinds.append(KINEMATIC if body.kinematic else RIGID)
        if not body.kinematic and sampling.inner and not sampling.within:
            links.append(_nearest(points, sampling.inner) + sum(len(part) for part in shapes))
        pivots.append(pivot)
        shapes.append(points - pivot)
    for number, cloth in enumerate(scene.cloths):
        things.append(len(scene.bodies) + number)
        kinds.append(CLOTH)
        pivots.append(np.zeros(3))
        rows, grid = _grid(cloth.resolution, sampling.cloth_step)
        before = sum(sheet.resolution**2 for sheet in scene.cloths[:number])
        if not sampling.within:
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
        free=sampling.free,
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


def _points(body: Body, sampling: Sampling) -> tuple[F64, F64]:
    """Return particles of a body and their normals."""
    limit = sampling.still_limit if body.kinematic else sampling.limit
    return surface_points(body.shape, body.scale, sampling.spacing, limit)


# Rigid motions of objects from the motions of their particles.
#
# Rotations are written as rotation vectors (axis times angle in radians) where they are learned.
# The fit of a rotation R and translation t to n pairs of points x -> y with weights w is the least
# squares problem
#
#     min sum_i w_i |R x_i + t - y_i|^2
#
# Its solution (Kabsch 1976): with the weighted means x', y' and H = sum_i w_i (x_i - x') (y_i -
# y')^T = U S V^T is R = V diag(1, 1, det(V U^T)) U^T, t = y' - R x'.
#
# References
# ----------
# W. Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Crystallographica
# A 32, 1976.
# M. A. Fischler and R. C. Bolles, Random sample consensus, Communications of the ACM 24, 1981.

_SMALL = 1e-12


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians.

    Rodrigues: R = I + a K + b K^2 with K the cross product matrix of the vector, angle t,
    a = sin(t) / t and b = (1 - cos(t)) / t^2.
    """
    squared = vector.pow(2).sum(-1)
    angle = squared.clamp_min(_SMALL).sqrt()
    small = squared < 1e-8
    a = torch.where(small, 1 - squared / 6, angle.sin() / angle)[..., None, None]
    b = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / angle.pow(2))[..., None, None]
    cross = cross_matrix(vector)
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    rotation: Tensor = eye + a * cross + b * (cross @ cross)
    return rotation


def cross_matrix(vector: Tensor) -> Tensor:
    """Return the matrices K (..., 3, 3) with K x = vector x x."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, -1).reshape(*vector.shape[:-1], 3, 3)


def vector_from_rotation(rotation: Tensor) -> Tensor:
    """Return rotation vectors (..., 3) of rotation matrices (..., 3, 3), angles in 0..pi.

    The angle t is atan2(|s|, (trace - 1) / 2) with s the axial vector of (R - R^T) / 2, whose
    length is sin(t) and whose direction is the axis. Where sin(t) vanishes with t near pi, the axis
    is the longest column of (R + I) / 2, which is the projection on it.
    """
    axial = torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        -1,
    )
    sine = axial / 2
    length = sine.pow(2).sum(-1).clamp_min(_SMALL).sqrt()
    cosine = (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angle = torch.atan2(length, cosine)
    factor = torch.where(length < 1e-5, torch.ones_like(length), angle / length)
    vector = sine * factor[..., None]
    halfway = (length < 1e-4) & (cosine < 0)
    if bool(halfway.any()):
        eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
        columns = ((rotation[halfway] + eye) / 2).transpose(-1, -2)
        rows = columns.pow(2).sum(-1).argmax(-1)
        axis = columns[torch.arange(len(rows), device=rows.device), rows]
        axis = axis / axis.norm(dim=-1, keepdim=True)
        sign = torch.where((axis * sine[halfway]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        vector = vector.clone()
        vector[halfway] = sign * axis * angle[halfway][..., None]
    return vector


def sum_by(values: Tensor, group: Tensor, count: int) -> Tensor:
    """Return the sums (count, ...) of the rows of ``values`` (n, ...) with each group (n,)."""
    return values.new_zeros(count, *values.shape[1:]).index_add(0, group, values)


def mean_by(values: Tensor, group: Tensor, count: int) -> Tensor:
    """Return the means (count, ...) of the rows of each group; 0 for a group without rows."""
    rows = torch.bincount(group, minlength=count).clamp_min(1).to(values.dtype)
    return sum_by(values, group, count) / rows.reshape(-1, *[1] * (values.ndim - 1))


def fit_rigid(
    shape: Tensor, points: Tensor, owners: Tensor, count: int, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the rotations (K, 3, 3) and translations (K, 3) that fit shapes to points best.

    Parameters
    ----------
    shape, points : (P, 3)
        Points of the objects at rest, and where they are, metres.
    owners : (P,)
        Object of each point, 0..K-1.
    count : int
        K.
    weights : (P,), optional
        Not negative; by default 1.

    Notes
    -----
    An object of one or two points, or of points on a line, has more than one best rotation; one of
    them is returned.
    """
    weight = torch.ones_like(points[:, 0]) if weights is None else weights
    total = sum_by(weight, owners, count).clamp_min(_SMALL)[:, None]
    start = sum_by(weight[:, None] * shape, owners, count) / total
    goal = sum_by(weight[:, None] * points, owners, count) / total
    a, b = shape - start[owners], points - goal[owners]
    spread = sum_by(weight[:, None, None] * a[:, :, None] * b[:, None, :], owners, count)
    rotation = _best_rotation(spread)
    return rotation, goal - (rotation @ start[..., None])[..., 0]


def _best_rotation(spread: Tensor) -> Tensor:
    """Return the rotation of Kabsch for matrices H (..., 3, 3)."""
    u, _, vh = torch.linalg.svd(spread)
    v, ut = vh.transpose(-1, -2), u.transpose(-1, -2)
    sign = torch.det(v @ ut)
    scale = torch.ones_like(spread[..., 0])
    scale[..., 2] = torch.where(sign < 0, -1.0, 1.0).to(spread.dtype)
    rotation: Tensor = (v * scale[..., None, :]) @ ut
    return rotation


def fit_robust(
    shape: Tensor,
    points: Tensor,
    owners: Tensor,
    count: int,
    tolerance: float,
    draws: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit a rigid motion to the particles of each object that agree with one another (RANSAC).

    Every hypothesis is fitted to four particles of each object; its inliers are the particles that
    it puts within ``tolerance`` of where they are. The one with most inliers, among them the fit to
    all particles, is fitted again to its inliers.

    Parameters
    ----------
    shape, points, owners, count
        As `fit_rigid`.
    tolerance : float
        Metres.
    draws : (hypotheses, 4)
        Random numbers in 0..1 that choose the particles. They are the same for every object, so
        that the fit of one does not depend on the others.

    Returns
    -------
    rotation, translation, inliers
        (K, 3, 3), (K, 3), and which particles (P,) are inliers.
    """
    numbers = torch.bincount(owners, minlength=count)
    starts = torch.cumsum(numbers, 0) - numbers
    rotation, shift = fit_rigid(shape, points, owners, count)

    def agree(rotation: Tensor, shift: Tensor) -> Tensor:
        put = (rotation[owners] @ shape[..., None])[..., 0] + shift[owners]
        return (put - points).pow(2).sum(-1) <= tolerance**2

    inliers = agree(rotation, shift)
    votes = sum_by(inliers.to(points.dtype), owners, count)
    for draw in draws:
        rows = starts[:, None] + (draw * numbers[:, None]).long().clamp_max(
            (numbers - 1).clamp_min(0)[:, None]
        )
        own = torch.arange(count, device=points.device).repeat_interleave(4)
        tried, moved = fit_rigid(shape[rows].flatten(0, 1), points[rows].flatten(0, 1), own, count)
        found = agree(tried, moved)
        number = sum_by(found.to(points.dtype), owners, count)
        better = number > votes
        votes = torch.where(better, number, votes)
        inliers = torch.where(better[owners], found, inliers)
    # An object without inliers keeps all its particles.
    inliers = inliers | (votes < 3)[owners]
    rotation, shift = fit_rigid(shape, points, owners, count, inliers.to(points.dtype))
    return rotation, shift, inliers
