"""Bodies as the rigid engine sees them: convex hulls, masses, actors, and the settings.

An actor is what moves as one: a body, or several bodies joined together. Its frame has its origin
at the centre of mass and the axes of its first body. Bodies that do not move belong to the world.
`build_model` puts everything together that does not change while a scene moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.core.errors import BadSceneError
from physion.numerics.elementary import arctan2
from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import (
    apply,
    cross,
    determinant,
    dot,
    inverse,
    multiply,
    norm,
    ordered_mean,
    ordered_sum,
    outer,
    unit,
)
from physion.numerics.rotations import (
    conjugate,
    multiply_quaternions,
    rotate_vectors,
    rotation_matrices,
)
from physion.physics.engine import settings_tag
from physion.physics.rigid.collision.faces import Hulls
from physion.scenes.scene import FRAME_TIME, GRAVITY, Body, Scene, SurfaceMaterial, Vec3
from physion.scenes.shapes.meshes import revolve, solid_moments
from physion.scenes.shapes.primitives import ConvexPiece, ball_mesh, shape

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


# Convex hulls that stand for a body in collisions.
#
# The official simulator uses hulls of meshes for all shapes, balls and cylinders included. A hull
# rolls and slides unlike a smooth ball, so ours are hulls as well.

BALL_SEGMENTS = 16
"""Meridians of a ball's hull, with half as many bands. With 24, balls roll on for longer than in
the recorded trials; with 12 they stop too soon. (PhysX allows 255 corners.)"""
CYLINDER_SIDES = 16
"""Sides of a cylinder's hull. With 32, as drawn, outcomes, contact frames and final positions of
the recorded trials are all predicted worse, with 24 by half as much
(benchmarks/results/calibration.md)."""
SAME_FACE_COSINE = 1 - 1e-7
SAME_FACE_OFFSET = 1e-5
"""Triangles of a hull are one face where their normals agree by this cosine, and their offsets to
this fraction of the hull's size: what rounding leaves of a plane."""
ACROSS = 1e-7
"""A plane whose normal has no larger component along a direction does not cut it."""
CACHED_HULLS = 512
"""Scaled shapes whose hulls are kept in memory."""


@dataclass(frozen=True, eq=False)
class Hull:
    """Convex hull in the frame of its body.

    - ``corners`` (K, 3): metres. ``center`` (3,): their mean.
    - ``faces``: for each face its corner numbers, counterclockwise from outside.
    - ``inner_box`` (3,): half extents in metres of a box round ``center`` inside the hull.
    """

    corners: F64
    center: F64
    faces: tuple[I64, ...]
    inner_box: F64


@lru_cache(maxsize=CACHED_HULLS)
def collision_hulls(name: str, scale: Vec3) -> tuple[Hull, ...]:
    """Return the hulls of all convex pieces of the shape ``name``, scaled, in the body's frame."""
    hulls = []
    for corners, faces in _unit_hulls(name):
        scaled = corners * np.asarray(scale)
        center = ordered_mean(scaled, axis=0)
        box = inner_box(scaled, faces, center)
        hulls.append(Hull(scaled, center, faces, box))
    return tuple(hulls)


@cache
def _unit_hulls(name: str) -> tuple[tuple[F64, tuple[I64, ...]], ...]:
    """Return corners and faces of the hulls at unit scale.

    Points inside a face, such as the middle of a cylinder's ends, are no corners: a body would rest
    on them in place of its rim.
    """
    hulls = []
    for piece in shape(name).pieces:
        points = _corners(piece)
        faces = hull_faces(points)
        used = np.unique(np.concatenate(faces))
        corners = points[used]
        kept = tuple(np.searchsorted(used, face) for face in faces)
        hulls.append((corners, kept))
    return tuple(hulls)


def _corners(piece: ConvexPiece) -> F64:
    """Return the corners (K, 3) of a piece at unit scale."""
    if piece.kind == "convex":
        return piece.vertices
    if piece.kind == "sphere":
        return ball_mesh(piece.half[0], BALL_SEGMENTS).moved(offset=piece.center).vertices
    if piece.kind == "cylinder":
        outline = [(0.0, -1.0), (1.0, -1.0), (1.0, 1.0), (0.0, 1.0)]
        solid = revolve(outline, CYLINDER_SIDES).moved(piece.half).rotated(piece.rotation)
        return solid.moved(offset=piece.center).vertices
    return piece.mesh.vertices


def hull_faces(corners: F64) -> list[I64]:
    """Return the corner numbers of every flat face of a convex hull, in order round the face.

    ``corners`` (K, 3) are points in metres, on the hull or within its faces.
    """
    # Imported late: what only reads scenes and trials starts faster.
    from scipy.spatial import ConvexHull

    hull = ConvexHull(corners)
    size = float(np.ptp(corners, axis=0).max())
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    face_of = np.full(len(normals), -1)
    faces: list[I64] = []
    for t in range(len(normals)):
        if face_of[t] >= 0:
            continue
        same = (dot(normals, normals[t]) > SAME_FACE_COSINE) & (
            np.abs(offsets - offsets[t]) < SAME_FACE_OFFSET * size
        )
        # Triangles of one plane are one face.
        same &= face_of < 0
        face_of[same] = len(faces)
        used = np.unique(hull.simplices[same])
        points = corners[used] - ordered_mean(corners[used], axis=0)
        normal = normals[t]
        first = unit(points[0] - normal * dot(points[0], normal))
        second = cross(normal, first)
        angle = arctan2(dot(points, second), dot(points, first))
        faces.append(used[np.argsort(angle, kind="stable")].astype(np.int64))
    return faces


@kernel
def face_planes(vertices: F64, loops: I64, first_loop: I64) -> F64:
    """Return the planes (F, 4) of faces: outward unit normal n, and d in n . p = d.

    ``loops`` (L,) are rows of ``vertices`` (V, 3), those of face f from ``first_loop[f]`` on,
    counterclockwise from outside. The normal is the sum of the cross products of a fan of triangles
    from the face's first corner.
    """
    planes = np.zeros((len(first_loop) - 1, 4))
    for f in range(len(planes)):
        start, stop = first_loop[f], first_loop[f + 1]
        a = loops[start]
        x = y = z = 0.0
        for k in range(start + 1, stop - 1):
            b, c = loops[k], loops[k + 1]
            ux, uy, uz = (
                vertices[b, 0] - vertices[a, 0],
                vertices[b, 1] - vertices[a, 1],
                vertices[b, 2] - vertices[a, 2],
            )
            wx, wy, wz = (
                vertices[c, 0] - vertices[a, 0],
                vertices[c, 1] - vertices[a, 1],
                vertices[c, 2] - vertices[a, 2],
            )
            x += uy * wz - uz * wy
            y += uz * wx - ux * wz
            z += ux * wy - uy * wx
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        planes[f, 0], planes[f, 1], planes[f, 2] = x, y, z
        planes[f, 3] = x * vertices[a, 0] + y * vertices[a, 1] + z * vertices[a, 2]
    return planes


def inner_box(corners: F64, faces: tuple[I64, ...], center: F64) -> F64:
    """Return half extents (3,) in metres of a box round ``center`` inside a hull; see `Hull`."""
    first_loop = np.cumsum([0, *(len(face) for face in faces)]).astype(np.int64)
    planes = face_planes(corners, np.concatenate(faces), first_loop)
    return _inner_box(planes, center, np.ptp(corners, axis=0))


# With r the radius of the ball round the centre that fits in, the box starts as the cube in that
# ball, half a side r / sqrt 3; it is lengthened along the hull's longest axis until it meets a
# face, then widened alike along the other two. As PhysX 4 does when it cooks a mesh
# (``ComputeInternalExtent``): a manifold's tolerances depend on it.


@kernel
def _inner_box(planes: F64, center: F64, size: F64) -> F64:
    """Return the half extents of the box from the hull's planes (F, 4) and its size (3,)."""
    distance = np.zeros(len(planes))
    least = np.inf
    for f in range(len(planes)):
        distance[f] = planes[f, 3]
        for k in range(3):
            distance[f] -= planes[f, k] * center[k]
        least = min(least, abs(distance[f]))
    least /= np.sqrt(3.0)
    longest = int(np.argmax(size))
    i, j = (longest + 1) % 3, (longest + 2) % 3
    if size[i] < size[j]:
        i, j = j, i
    reach = width = np.inf
    for f in range(len(planes)):
        if abs(planes[f, longest]) <= ACROSS:
            continue
        for corner in range(4):
            along_i = least if corner % 2 else -least
            along_j = least if corner // 2 else -least
            side = along_i * planes[f, i] + along_j * planes[f, j]
            reach = min(reach, max(abs((distance[f] - side) / planes[f, longest]), least))
    for f in range(len(planes)):
        for diagonal in (-1.0, 1.0):
            along = planes[f, i] + diagonal * planes[f, j]
            if abs(along) <= ACROSS:
                continue
            for end in (-reach, reach):
                left = distance[f] - end * planes[f, longest]
                width = min(width, max(abs(left / along), least))
    half = np.zeros(3)
    half[longest], half[i], half[j] = reach, width, width
    return half


# Mass, centre of mass and inertia of bodies, from their convex pieces of uniform density.
#
# This is the one place where mass properties of bodies are computed: the engine, stored states and
# exported push points all use them. Like Unity, it takes them from the pieces that collide, not
# from the drawn solid.


@dataclass(frozen=True)
class MassProperties:
    """Mass properties of something rigid.

    ``mass`` in kg, ``center`` (3,) of mass in metres, ``inertia`` (3, 3) about it in kg m².
    """

    mass: float
    center: F64
    inertia: F64

    def moved(self, position: ArrayLike, rotation: ArrayLike) -> MassProperties:
        """Return those of the same thing rotated by a quaternion (4,), then put at ``position``."""
        matrix = rotation_matrices(rotation)
        return MassProperties(
            self.mass,
            np.asarray(position) + apply(matrix, self.center),
            multiply(multiply(matrix, self.inertia), matrix.T),
        )


def merge_masses(parts: list[MassProperties]) -> MassProperties:
    """Return the mass properties of several things held together.

    Inertias add by the parallel axis theorem: I = sum of I_i + m_i (|r_i|² 1 - r_i r_iᵀ), with r_i
    from the common centre to that of part i.
    """
    mass = float(ordered_sum([part.mass for part in parts]))
    center = sum((part.mass * part.center for part in parts), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for part in parts:
        arm = part.center - center
        inertia += part.inertia + part.mass * (dot(arm, arm) * np.eye(3) - outer(arm, arm))
    return MassProperties(mass, center, inertia)


def body_mass(body: Body) -> MassProperties:
    """Return the mass properties of a body in its own frame, scaled; its pose is not applied."""
    return _body_mass(body.shape, body.scale, body.mass)


@lru_cache(maxsize=CACHED_HULLS)
def _body_mass(name: str, scale: Vec3, mass: float) -> MassProperties:
    """Return the mass properties of a shape at a scale.

    Stretching by S multiplies volumes by |S|, integrals of x by S |S|, of x x^T by S S^T |S|.
    """
    volume, first, second = _unit_moments(name)
    if volume == 0.0:
        return hull_mass([], mass)
    factors = np.asarray(scale)
    stretched = abs(scale[0] * scale[1] * scale[2])
    return _from_moments(
        volume * stretched,
        first * factors * stretched,
        second * outer(factors, factors) * stretched,
        mass,
    )


@cache
def _unit_moments(name: str) -> tuple[float, F64, F64]:
    """Return the integrals of 1, x and x x^T over all pieces of a shape at unit scale."""
    moments = [hull_moments(hull.corners) for hull in collision_hulls(name, (1.0, 1.0, 1.0))]
    if not moments:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    volumes, firsts, seconds = zip(*moments, strict=True)
    return (
        float(ordered_sum(volumes)),
        ordered_sum(np.array(firsts), axis=0),
        ordered_sum(np.array(seconds), axis=0),
    )


def hull_mass(hulls: list[F64], mass: float) -> MassProperties:
    """Return the mass properties of convex pieces of one density, ``mass`` kg together.

    ``hulls`` are their corners, each (K, 3) in metres. Where pieces overlap, matter counts twice,
    as in Unity. Without pieces, the mass has its centre at the origin and a radius of gyration of
    1 m about every axis.
    """
    if not hulls:
        return MassProperties(mass, np.zeros(3), np.eye(3) * mass)
    volumes, firsts, seconds = zip(*map(hull_moments, hulls), strict=True)
    return _from_moments(
        float(ordered_sum(volumes)),
        ordered_sum(np.array(firsts), axis=0),
        ordered_sum(np.array(seconds), axis=0),
        mass,
    )


def _from_moments(volume: float, first: F64, second: F64, mass: float) -> MassProperties:
    """Return the mass properties of a solid with the integrals of 1, x and x x^T.

    With M = integral of x x^T about the centre of mass over the volume, the inertia is
    mass (tr(M) 1 - M).
    """
    center = first / volume
    moments = second / volume - outer(center, center)
    inertia = mass * (ordered_sum(np.diagonal(moments)) * np.eye(3) - moments)
    return MassProperties(mass, center, inertia)


def hull_moments(corners: F64) -> tuple[float, F64, F64]:
    """Return the integrals of 1, x (3,) and x x^T (3, 3) over a convex hull of corners (K, 3)."""
    # Imported late: what only reads scenes and trials starts faster.
    from scipy.spatial import ConvexHull

    corners = np.asarray(corners, np.float64)
    inside = ordered_mean(corners, axis=0)
    triangles = corners[ConvexHull(corners).simplices] - inside
    # Seen from inside, all triangles turn the same way once those with a negative volume are
    # reversed.
    reverse = determinant(triangles) < 0.0
    triangles[reverse] = triangles[reverse][:, ::-1]
    volume, first, second = solid_moments(triangles)
    shifted = outer(inside, first)
    return (
        volume,
        first + volume * inside,
        second + shifted + shifted.T + volume * outer(inside, inside),
    )


# Actors: bodies that joints hold together, their common mass and frame.


@dataclass(frozen=True)
class Actors:
    """Bodies of a scene grouped into A actors; N bodies. Actor A stands for the world.

    - ``mass`` (A,) kg, ``inertia`` (A, 3, 3) kg m², in actor frames. ``drag`` (A, 2): linear and
      angular drag per second.
    - ``actor_of`` (N,): actor of each body; A for those that do not move or are absent.
    - ``leader`` (A,): first body of each actor.
    - ``pivot`` (N, 3), ``rotation`` (N, 4), ``center`` (N, 3): a body's pose and its own centre of
      mass in the frame of its actor; the world frame for those without.
    - ``x`` (A + 1, 3), ``q`` (A + 1, 4): poses of the actors; the last is the world.
    """

    mass: F64
    inertia: F64
    drag: F64
    actor_of: I64
    leader: I64
    pivot: F64
    rotation: F64
    center: F64
    x: F64
    q: F64

    @property
    def count(self) -> int:
        """Number of actors."""
        return len(self.mass)


def group_bodies(scene: Scene, present: Sequence[bool] | None = None) -> list[list[int]]:
    """Return the indices of the bodies of every actor, in the order of their first body.

    ``present`` tells which bodies are in the scene, by default all. Joints to others do not hold.

    Raises `BadSceneError` for a joint between a body that moves and one that does not.
    """
    here = [True] * len(scene.bodies) if present is None else present
    moving = [
        i for i, body in enumerate(scene.bodies) if here[i] and not (body.kinematic or body.scenery)
    ]
    leader = {i: i for i in moving}
    for joint in scene.joints:
        a, b = scene.index(joint.parent), scene.index(joint.child)
        if not (here[a] and here[b]):
            continue
        if a not in leader or b not in leader:
            raise BadSceneError(
                f"scene {scene.name!r}: joint {joint.parent!r}-{joint.child!r} needs two bodies "
                "that move; make both kinematic or neither"
            )
        low, high = sorted((leader[a], leader[b]))
        leader = {i: low if at == high else at for i, at in leader.items()}
    groups: dict[int, list[int]] = {}
    for i in moving:
        groups.setdefault(leader[i], []).append(i)
    return list(groups.values())


def center_of_mass(scene: Scene, name: str) -> F64:
    """Return the centre of mass (3,) of what a body moves with, at the start; metres, world.

    This is where an impulse without a point acts: on all bodies that are joined to it together.
    """
    index = scene.index(name)
    group = next((group for group in group_bodies(scene) if index in group), [index])
    bodies = [scene.bodies[i] for i in group]
    parts = [body_mass(body).moved(body.position, unit(body.rotation)) for body in bodies]
    return merge_masses(parts).center


def find_actors(
    scene: Scene,
    present: Sequence[bool] | None = None,
    positions: F64 | None = None,
    rotations: F64 | None = None,
) -> Actors:
    """Group the bodies that move into actors.

    Parameters
    ----------
    scene
        Bodies and joints.
    present
        Which bodies are in the scene, by default all.
    positions, rotations : (N, 3), (N, 4), optional
        Present poses of all bodies, by default those of the scene.
    """
    bodies = scene.bodies
    if positions is None:
        positions = np.array([b.position for b in bodies], np.float64).reshape(-1, 3)
    if rotations is None:
        rotations = np.array([b.rotation for b in bodies], np.float64).reshape(-1, 4)
    rotations = unit(rotations)
    groups = group_bodies(scene, present)
    masses = [hull_mass([], b.mass) if b.scenery else body_mass(b) for b in bodies]
    count = len(groups)
    actor_of = np.full(len(bodies), count, np.int64)
    pivot, rotation = positions.copy(), rotations.copy()
    own = np.array([m.center for m in masses]).reshape(-1, 3)
    center = positions + rotate_vectors(rotations, own)
    x, q = np.zeros((count + 1, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count + 1, 1))
    whole: list[MassProperties] = []
    for actor, group in enumerate(groups):
        first, frame = positions[group[0]], rotations[group[0]]
        parts: list[MassProperties] = []
        for i in group:
            actor_of[i] = actor
            rotation[i] = multiply_quaternions(conjugate(frame), rotations[i])
            pivot[i] = rotate_vectors(conjugate(frame), positions[i] - first)
            parts.append(masses[i].moved(pivot[i], rotation[i]))
        whole.append(merge_masses(parts))
        x[actor], q[actor] = first + rotate_vectors(frame, whole[-1].center), frame
        for i, part in zip(group, parts, strict=True):
            pivot[i] -= whole[-1].center
            center[i] = part.center - whole[-1].center
    drag = [(bodies[group[0]].drag, bodies[group[0]].angular_drag) for group in groups]
    return Actors(
        mass=np.array([properties.mass for properties in whole]),
        inertia=np.array([properties.inertia for properties in whole]).reshape(-1, 3, 3),
        drag=np.array(drag, np.float64).reshape(-1, 2),
        actor_of=actor_of,
        leader=np.array([group[0] for group in groups], np.int64),
        pivot=pivot,
        rotation=rotation,
        center=center,
        x=x,
        q=q,
    )


# Constants of the rigid-body engine: time step, solver, friction, sleep.

FLOOR_MATERIAL = SurfaceMaterial(static_friction=0.6, dynamic_friction=0.6, restitution=0.0)
"""Unity's default material; the official scenes never set one for the floor."""


@dataclass(frozen=True, slots=True)
class RigidSettings:
    """Constants of the rigid-body engine. The defaults are those of the official simulator.

    "Unity" means a default of Unity 2019's physics (PhysX 4), "official" a value that the official
    command logs set, "PhysX" a constant of its patch-friction Gauss-Seidel solver.

    - ``dt``: seconds of a step; one step is one frame (official, measured from free falls).
    - ``gravity``: metres per second squared, downwards (official).
    - ``position_iterations``: Gauss-Seidel sweeps with penetration bias (official: 32).
    - ``velocity_iterations``: sweeps without bias, after the poses have moved (Unity: 1).
    - ``friction_sweeps``: number of the last position sweeps that solve friction; 0 means all
      (PhysX: 3).
    - ``persistent_manifolds``: contact points are kept from step to step (Unity 2019).
    - ``friction_doubling``: each of a patch's two anchors may bear the whole friction force, so
      that flat contacts have twice the friction of Coulomb's law. The official simulator behaves
      so (Unity's "improved patch friction" is off); with False the anchors divide the force.
    - ``contact_offset``: metres around every surface in which contacts are found (Unity: .01).
    - ``bias``: fraction of a penetration or gap that one step closes (PhysX: .8).
    - ``max_depenetration_speed``: metres per second (Unity: 10).
    - ``bounce_threshold``: approach speed in m/s above which restitution acts (Unity: 2).
    - ``friction_gain``: fraction of the tangential velocity that one sweep removes (PhysX: .8).
    - ``patch_cosine``: contacts whose normals agree by this cosine form one patch (PhysX: .999).
    - ``anchor_distance``: metres; a second friction anchor must be this far from the first, and
      anchors this far apart along the normal are forgotten (PhysX: .025).
    - ``anchor_gap``: metres; only contacts closer than this hold an anchor (PhysX: .04).
    - ``max_angular_velocity``: radians per second, about the centre of mass (Unity: 7).
    - ``sleep_threshold``: kinetic energy by mass in m²/s² (official: .01).
    - ``wake_time``: seconds of stillness before a body may sleep (PhysX: .4).
    - ``floor``: friction and restitution of the floor (Unity's default material).
    """

    dt: float = FRAME_TIME
    gravity: float = GRAVITY
    position_iterations: int = 32
    velocity_iterations: int = 1
    friction_sweeps: int = 3
    persistent_manifolds: bool = True
    friction_doubling: bool = True
    contact_offset: float = 0.01
    bias: float = 0.8
    max_depenetration_speed: float = 10.0
    bounce_threshold: float = 2.0
    friction_gain: float = 0.8
    patch_cosine: float = 0.999
    anchor_distance: float = 0.025
    anchor_gap: float = 0.04
    max_angular_velocity: float = 7.0
    sleep_threshold: float = 0.01
    wake_time: float = 0.4
    floor: SurfaceMaterial = FLOOR_MATERIAL

    def tag(self) -> str:
        """Return eight hexadecimal digits that change whenever a setting does."""
        return settings_tag(self)


# Model of a scene for the rigid engine: actors with mass, and convex hulls called geoms.
#
# The floor is handled apart, because a hull touches a plane with all its low corners.

MARGIN_FRACTION, MAX_MARGIN = 0.25, 0.05
"""A hull's margin is this part of the smallest half extent of its inner box, at most these metres
(PhysX: ``CalculatePCMConvexMargin``)."""
TOLERANCE_FRACTION, MIN_TOLERANCE, MAX_TOLERANCE = 0.1, 0.01, 0.05
"""The same for its tolerance, which is at least some metres (PhysX: ``CalculateConvexMargin``,
``PCM_WITNESS_POINT_LOWER_EPS`` and ``PCM_WITNESS_POINT_UPPER_EPS``)."""


@dataclass(frozen=True)
class RigidModel:
    """Everything about a scene that does not change while it moves.

    A actors, N bodies, G geoms.

    - ``actors``: masses, frames, poses at the start.
    - ``inertia`` (A + 1, 3, 3) in kg m^2, ``inv_mass`` (A + 1,), ``inv_inertia`` (A + 1, 3, 3): in
      actor frames; 0 for the world, which is the last.
    - ``hulls``: all geoms, in their actors' frames. ``first_geom`` (N + 1,): those of each body.
    - ``material`` (N + 1, 3): static and dynamic friction, restitution; the last is the floor.
    """

    actors: Actors
    inertia: F64
    inv_mass: F64
    inv_inertia: F64
    hulls: Hulls
    first_geom: I64
    material: F64


def build_model(
    scene: Scene, settings: RigidSettings, present: Sequence[bool] | None = None
) -> RigidModel:
    """Compute masses, frames and geoms of a scene.

    ``present`` tells which bodies are in the scene, by default all. Others have no geoms and stay
    where they are.
    """
    here = [True] * len(scene.bodies) if present is None else present
    actors = find_actors(scene, here)
    inertia, inv_inertia = np.zeros((2, actors.count + 1, 3, 3))
    inv_mass = np.zeros(actors.count + 1)
    for actor in range(actors.count):
        inertia[actor] = actors.inertia[actor]
        inv_inertia[actor] = inverse(actors.inertia[actor])
        inv_mass[actor] = 1.0 / actors.mass[actor]
    hulls = [
        collision_hulls(body.shape, body.scale) if there and not body.scenery else ()
        for body, there in zip(scene.bodies, here, strict=False)
    ]
    first_geom = np.cumsum([0, *(len(pieces) for pieces in hulls)]).astype(np.int64)
    materials = [b.contact for b in scene.bodies] + [settings.floor]
    return RigidModel(
        actors=actors,
        inertia=inertia,
        inv_mass=inv_mass,
        inv_inertia=inv_inertia,
        hulls=_gather(hulls, actors.pivot, actors.rotation),
        first_geom=first_geom,
        material=np.array(
            [[m.static_friction, m.dynamic_friction, m.restitution] for m in materials]
        ),
    )


def _gather(hulls: list[tuple[Hull, ...]], pivot: F64, rotation: F64) -> Hulls:
    """Return the hulls of all bodies as arrays, moved to poses ``pivot`` (N, 3), ``rotation``."""
    geoms = [hull for pieces in hulls for hull in pieces]
    corners = [
        pivot[i] + rotate_vectors(rotation[i], hull.corners)
        for i, pieces in enumerate(hulls)
        for hull in pieces
    ]
    vertices = np.concatenate(corners) if corners else np.zeros((0, 3))
    first_vertex = np.cumsum([0, *(len(c) for c in corners)]).astype(np.int64)
    faces = [f + start for g, start in zip(geoms, first_vertex, strict=False) for f in g.faces]
    loops = np.concatenate(faces) if faces else np.zeros(0, np.int64)
    first_loop = np.cumsum([0, *(len(face) for face in faces)]).astype(np.int64)
    least = np.array([hull.inner_box.min() for hull in geoms])
    bounds = np.array([[c.min(axis=0), c.max(axis=0)] for c in corners]).reshape(-1, 2, 3)
    low, high = bounds[:, 0], bounds[:, 1]
    return Hulls(
        vertices,
        first_vertex,
        loops,
        first_loop,
        np.cumsum([0, *(len(hull.faces) for hull in geoms)]).astype(np.int64),
        face_planes(vertices, loops, first_loop),
        np.minimum(MARGIN_FRACTION * least, MAX_MARGIN),
        np.clip(TOLERANCE_FRACTION * least, MIN_TOLERANCE, MAX_TOLERANCE),
        norm(np.array([hull.inner_box for hull in geoms]).reshape(-1, 3)),
        np.array([norm(c).max() for c in corners]),
        np.concatenate([0.5 * (low + high), 0.5 * (high - low)], axis=1),
    )
