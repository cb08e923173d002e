"""MuJoCo's model of a scene: a free body for every actor, a convex mesh for every piece."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import log_of
from physion.numerics.rotations import rotate_vectors
from physion.physics.mujoco.settings import MujocoSettings
from physion.physics.rigid.actors import Actors
from physion.physics.rigid.hulls import collision_hulls
from physion.physics.trajectory import ENVIRONMENT
from physion.scenes.scene import FRAME_TIME, Scene, SurfaceMaterial

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

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
