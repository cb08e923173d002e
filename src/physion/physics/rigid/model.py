"""Model of a scene for the rigid engine: actors with mass, and convex hulls called geoms.

The floor is handled apart, because a hull touches a plane with all its low corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.numerics.linear_algebra import inverse, norm
from physion.numerics.rotations import rotate_vectors
from physion.physics.rigid.actors import Actors, find_actors
from physion.physics.rigid.collision.fast_pairs import SweepScene, sweep_scene
from physion.physics.rigid.collision.hull_records import Hulls
from physion.physics.rigid.hulls import Hull, collision_hulls, face_planes
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

    A actors, N bodies, G geoms.

    - ``actors``: masses, frames, poses at the start.
    - ``inertia`` (A + 1, 3, 3) in kg m^2, ``inv_mass`` (A + 1,), ``inv_inertia`` (A + 1, 3, 3): in
      actor frames; 0 for the world, which is the last.
    - ``hulls``: all geoms, in their actors' frames. ``first_geom`` (N + 1,): those of each body.
    - ``swept``: thresholds of continuous collision detection.
    - ``material`` (N + 1, 3): static and dynamic friction, restitution; the last is the floor.
    """

    actors: Actors
    inertia: F64
    inv_mass: F64
    inv_inertia: F64
    hulls: Hulls
    first_geom: I64
    swept: SweepScene
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
    inradius = np.array([hull.inradius for pieces in hulls for hull in pieces])
    materials = [b.contact for b in scene.bodies] + [settings.floor]
    return RigidModel(
        actors=actors,
        inertia=inertia,
        inv_mass=inv_mass,
        inv_inertia=inv_inertia,
        hulls=_gather(hulls, actors.pivot, actors.rotation),
        first_geom=first_geom,
        swept=sweep_scene(inradius, first_geom, actors.pivot),
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
