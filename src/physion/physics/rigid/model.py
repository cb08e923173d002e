"""Model of a scene for the rigid engine: actors with mass, convex geoms, MuJoCo's collision model.

An actor is what moves as one: a body, or several bodies joined together. Its frame has its origin
at the centre of mass and the axes of its first body. MuJoCo holds one free body for every actor
and one convex mesh for every piece of a shape, and only finds the contacts between them. The floor
is handled apart, because a convex hull touches a plane with all its low corners, not just three.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from physion.errors import BadSceneError
from physion.numerics.linear_algebra import inverse, unit
from physion.numerics.rotations import conjugate, multiply_quaternions, rotate_vectors
from physion.physics.rigid.hulls import collision_hulls
from physion.physics.rigid.manifold import HullFaces
from physion.physics.rigid.mass import MassProperties, body_mass, hull_mass, merge_masses
from physion.physics.rigid.settings import RigidSettings
from physion.scenes.scene import Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MAX_CONTACTS = 4096


@dataclass(frozen=True)
class RigidModel:
    """Everything about a scene that does not change while it moves.

    A actors, N bodies, G geoms. Actor A stands for the world.

    - ``inv_mass`` (A + 1,), ``inv_inertia`` (A + 1, 3, 3): in actor frames; 0 for the world.
    - ``drag`` (A, 2): linear and angular drag per second.
    - ``actor_of`` (N,): actor of each body; A for kinematic bodies and scenery.
    - ``pivot`` (N, 3), ``rotation`` (N, 4), ``center`` (N, 3): a body's pose and its own centre of
      mass in its actor's frame (the world frame for kinematic bodies).
    - ``geom_body`` (G,): body of each geom.
    - ``hulls``: corners and faces of all geoms, in their actors' frames.
    - ``material`` (N + 1, 3): static and dynamic friction, restitution; the last is the floor.
    - ``start_x`` (A + 1, 3), ``start_q`` (A + 1, 4): poses of the actors in the scene.
    """

    inv_mass: F64
    inv_inertia: F64
    drag: F64
    actor_of: I64
    pivot: F64
    rotation: F64
    center: F64
    geom_body: I64
    hulls: HullFaces
    material: F64
    start_x: F64
    start_q: F64
    mujoco_model: mujoco.MjModel

    @property
    def actors(self) -> int:
        """Number of actors that can move."""
        return len(self.inv_mass) - 1


def group_bodies(scene: Scene) -> list[list[int]]:
    """Return the indices of the bodies of every actor, in the order of their first body.

    Raises `BadSceneError` for a joint between a body that moves and one that does not.
    """
    moving = [i for i, body in enumerate(scene.bodies) if not (body.kinematic or body.scenery)]
    leader = {i: i for i in moving}
    for joint in scene.joints:
        a, b = scene.index(joint.parent), scene.index(joint.child)
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


def build_model(scene: Scene, settings: RigidSettings) -> RigidModel:
    """Compute masses, frames and geoms of a scene, and compile MuJoCo's collision model."""
    groups = group_bodies(scene)
    actors, count = len(groups), len(scene.bodies)
    positions = np.array([b.position for b in scene.bodies], dtype=np.float64).reshape(-1, 3)
    rotations = np.array([b.rotation for b in scene.bodies], dtype=np.float64).reshape(-1, 4)
    rotations = unit(rotations)
    hulls = [[] if b.scenery else collision_hulls(b.shape, b.scale) for b in scene.bodies]
    masses = [
        hull_mass([piece.corners for piece in pieces], body.mass)
        for pieces, body in zip(hulls, scene.bodies, strict=True)
    ]
    actor_of = np.full(count, actors, np.int64)
    pivot, rotation = positions.copy(), rotations.copy()
    center = positions + rotate_vectors(rotations, np.array([m.center for m in masses]))
    inv_mass, inv_inertia = np.zeros(actors + 1), np.zeros((actors + 1, 3, 3))
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
        inv_inertia[actor] = inverse(whole.inertia)
        start_x[actor] = positions[group[0]] + rotate_vectors(frame, whole.center)
        start_q[actor] = frame
        for i, part in zip(group, parts, strict=True):
            pivot[i] -= whole.center
            center[i] = part.center - whole.center
    drag = np.array(
        [[scene.bodies[g[0]].drag, scene.bodies[g[0]].angular_drag] for g in groups]
    ).reshape(-1, 2)
    geom_body = [i for i, pieces in enumerate(hulls) for _ in pieces]
    corners = [
        pivot[i] + rotate_vectors(rotation[i], piece.corners)
        for i, pieces in enumerate(hulls)
        for piece in pieces
    ]
    geoms = [piece for pieces in hulls for piece in pieces]
    first_vertex = np.cumsum([0, *(len(c) for c in corners)])
    loops = [
        face + start for g, start in zip(geoms, first_vertex, strict=False) for face in g.faces
    ]
    materials = [b.contact for b in scene.bodies] + [settings.floor]
    return RigidModel(
        inv_mass=inv_mass,
        inv_inertia=inv_inertia,
        drag=drag,
        actor_of=actor_of,
        pivot=pivot,
        rotation=rotation,
        center=center,
        geom_body=np.array(geom_body, np.int64),
        hulls=HullFaces(
            np.concatenate(corners) if corners else np.zeros((0, 3)),
            first_vertex,
            np.concatenate(loops) if loops else np.zeros(0, np.int64),
            np.cumsum([0, *(len(loop) for loop in loops)]),
            np.cumsum([0, *(len(geom.faces) for geom in geoms)]),
        ),
        material=np.array(
            [[m.static_friction, m.dynamic_friction, m.restitution] for m in materials]
        ),
        start_x=start_x,
        start_q=start_q,
        mujoco_model=_compile(actors, actor_of[geom_body], corners, settings),
    )


def _compile(
    actors: int, geom_actor: I64, corners: list[F64], settings: RigidSettings
) -> mujoco.MjModel:
    """Return MuJoCo's model: a free body for every actor, a mesh for every geom."""
    spec = mujoco.MjSpec()
    spec.option.timestep = settings.dt
    bodies = []
    for _ in range(actors):
        body = spec.worldbody.add_body()
        body.add_freejoint()
        body.mass = 1.0
        body.inertia = [1.0, 1.0, 1.0]
        body.explicitinertial = True
        bodies.append(body)
    bodies.append(spec.worldbody)
    # MuJoCo numbers geoms body by body, the world first; names carry our own numbers.
    for number, (actor, points) in enumerate(zip(geom_actor, corners, strict=True)):
        mesh = spec.add_mesh()
        mesh.name = f"mesh{number}"
        mesh.uservert = points.ravel().tolist()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        geom = bodies[actor].add_geom()
        geom.name = f"geom{number}"
        geom.type = mujoco.mjtGeom.mjGEOM_MESH
        geom.meshname = mesh.name
        geom.gap = settings.contact_offset
    return spec.compile()
