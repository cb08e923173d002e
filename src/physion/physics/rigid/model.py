"""Model of a scene for the rigid engine: actors with mass, and convex hulls called geoms.

An actor is what moves as one: a body, or several bodies joined together. Its frame has its origin
at the centre of mass and the axes of its first body. The floor is handled apart, because a hull
touches a plane with all its low corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadSceneError
from physion.numerics.linear_algebra import inverse, norm, unit
from physion.numerics.rotations import conjugate, multiply_quaternions, rotate_vectors
from physion.physics.rigid.collision.hull_records import Hulls
from physion.physics.rigid.hulls import Hull, collision_hulls, face_planes
from physion.physics.rigid.mass import MassProperties, body_mass, hull_mass, merge_masses
from physion.physics.rigid.settings import RigidSettings
from physion.scenes.scene import Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MARGIN_FRACTION, MAX_MARGIN = 0.25, 0.05
"""A hull's margin is this part of the smallest half extent of its inner box, at most these metres
(PhysX: ``CalculatePCMConvexMargin``)."""
TOLERANCE_FRACTION, MIN_TOLERANCE, MAX_TOLERANCE = 0.1, 0.01, 0.05
"""The same for its tolerance, which is at least some metres (PhysX: ``CalculateConvexMargin``,
``PCM_WITNESS_POINT_LOWER_EPS`` and ``PCM_WITNESS_POINT_UPPER_EPS``)."""


@dataclass(frozen=True)
class RigidModel:
    """Everything about a scene that does not change while it moves.

    A actors, N bodies, G geoms. Actor A stands for the world.

    - ``inertia`` (A + 1, 3, 3) in kg m^2, ``inv_mass`` (A + 1,), ``inv_inertia`` (A + 1, 3, 3): in
      actor frames; 0 for the world.
    - ``drag`` (A, 2): linear and angular drag per second.
    - ``actor_of`` (N,): actor of each body; A for kinematic bodies and scenery.
    - ``pivot`` (N, 3), ``rotation`` (N, 4), ``center`` (N, 3): a body's pose and its own centre of
      mass in its actor's frame (the world frame for kinematic bodies).
    - ``leader`` (A,): first body of each actor.
    - ``hulls``: all geoms, in their actors' frames. ``first_geom`` (N + 1,): those of each body.
    - ``material`` (N + 1, 3): static and dynamic friction, restitution; the last is the floor.
    - ``start_x`` (A + 1, 3), ``start_q`` (A + 1, 4): poses of the actors in the scene.
    """

    inertia: F64
    inv_mass: F64
    inv_inertia: F64
    drag: F64
    actor_of: I64
    pivot: F64
    rotation: F64
    center: F64
    leader: I64
    hulls: Hulls
    first_geom: I64
    material: F64
    start_x: F64
    start_q: F64

    @property
    def actors(self) -> int:
        """Number of actors that can move."""
        return len(self.inv_mass) - 1


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


def build_model(
    scene: Scene, settings: RigidSettings, present: Sequence[bool] | None = None
) -> RigidModel:
    """Compute masses, frames and geoms of a scene.

    ``present`` tells which bodies are in the scene, by default all. Others have no geoms and stay
    where they are.
    """
    here = [True] * len(scene.bodies) if present is None else present
    groups = group_bodies(scene, here)
    actors, count = len(groups), len(scene.bodies)
    positions = np.array([b.position for b in scene.bodies], dtype=np.float64).reshape(-1, 3)
    rotations = np.array([b.rotation for b in scene.bodies], dtype=np.float64).reshape(-1, 4)
    rotations = unit(rotations)
    hulls = [
        collision_hulls(body.shape, body.scale) if there and not body.scenery else ()
        for body, there in zip(scene.bodies, here, strict=False)
    ]
    masses = [hull_mass([], b.mass) if b.scenery else body_mass(b) for b in scene.bodies]
    actor_of = np.full(count, actors, np.int64)
    pivot, rotation = positions.copy(), rotations.copy()
    center = positions + rotate_vectors(rotations, np.array([m.center for m in masses]))
    inv_mass, inv_inertia = np.zeros(actors + 1), np.zeros((actors + 1, 3, 3))
    inertia = np.zeros((actors + 1, 3, 3))
    start_x, start_q = np.zeros((actors + 1, 3)), np.tile([1.0, 0, 0, 0], (actors + 1, 1))
    for actor, group in enumerate(groups):
        frame = rotations[group[0]]
        parts: list[MassProperties] = []
        for i in group:
            actor_of[i] = actor
            rotation[i] = multiply_quaternions(conjugate(frame), rotations[i])
            pivot[i] = rotate_vectors(conjugate(frame), positions[i] - positions[group[0]])
            parts.append(masses[i].moved(pivot[i], rotation[i]))
        whole = merge_masses(parts)
        inv_mass[actor] = 1.0 / whole.mass
        inertia[actor] = whole.inertia
        inv_inertia[actor] = inverse(whole.inertia)
        start_x[actor] = positions[group[0]] + rotate_vectors(frame, whole.center)
        start_q[actor] = frame
        for i, part in zip(group, parts, strict=True):
            pivot[i] -= whole.center
            center[i] = part.center - whole.center
    drag = np.array(
        [[scene.bodies[g[0]].drag, scene.bodies[g[0]].angular_drag] for g in groups]
    ).reshape(-1, 2)
    materials = [b.contact for b in scene.bodies] + [settings.floor]
    return RigidModel(
        inertia=inertia,
        inv_mass=inv_mass,
        inv_inertia=inv_inertia,
        drag=drag,
        actor_of=actor_of,
        pivot=pivot,
        rotation=rotation,
        center=center,
        leader=np.array([group[0] for group in groups], np.int64),
        hulls=_gather(hulls, pivot, rotation),
        first_geom=np.cumsum([0, *(len(pieces) for pieces in hulls)]).astype(np.int64),
        material=np.array(
            [[m.static_friction, m.dynamic_friction, m.restitution] for m in materials]
        ),
        start_x=start_x,
        start_q=start_q,
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
