"""A scene as the engine sees it: actors with mass, geoms with vertices, MuJoCo's collision model.

An actor is what moves as one: a body, or several bodies joined together. Its frame has its origin
at the centre of mass and the axes of its first body. MuJoCo holds one free body for every actor
and one convex mesh for every piece of a shape, and finds the contacts between them; the floor is
handled apart, because a convex hull must touch a plane with all its low corners, not just three.
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
from physion.physics.rigid.mass import MassProperties, hull_mass, merge_masses
from physion.physics.rigid.settings import Settings
from physion.scenes.scene import Scene

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MAX_CONTACTS = 4096


@dataclass(frozen=True)
class RigidModel:
    """Everything about a scene that does not change while it moves.

    A actors, N bodies, G geoms, V vertices of all geoms together. Actor A stands for the world.

    - ``inv_mass`` (A + 1,), ``inv_inertia`` (A + 1, 3, 3): in actor frames; 0 for the world.
    - ``drag`` (A, 2): linear and angular share of the velocity lost each second.
    - ``actor_of`` (N,): actor of each body; A for kinematic bodies and scenery.
    - ``pivot`` (N, 3), ``turn`` (N, 4), ``center`` (N, 3): a body's pose and its own centre of
      mass in its actor's frame (the world frame for kinematic bodies).
    - ``geom_body`` (G,): body of each geom.
    - ``vertices`` (V, 3): corners in the actor's frame; ``first_vertex`` (G + 1,) says whose.
    - ``loops`` (L,): corner numbers round every face; ``first_loop`` (F + 1,) says whose;
      ``first_face`` (G + 1,) says which faces a geom has.
    - ``material`` (N + 1, 3): static and dynamic friction, restitution; the last is the floor.
    - ``start_x`` (A + 1, 3), ``start_q`` (A + 1, 4): poses of the actors in the scene.
    """

    inv_mass: Array
    inv_inertia: Array
    drag: Array
    actor_of: Index
    pivot: Array
    turn: Array
    center: Array
    geom_body: Index
    vertices: Array
    first_vertex: Index
    loops: Index
    first_loop: Index
    first_face: Index
    material: Array
    start_x: Array
    start_q: Array
    mujoco_model: mujoco.MjModel

    @property
    def actors(self) -> int:
        """How many things can move."""
        return len(self.inv_mass) - 1


def group_bodies(scene: Scene) -> list[list[int]]:
    """Indices of the bodies of every actor, in the order of their first body."""
    moving = [i for i, body in enumerate(scene.bodies) if not (body.kinematic or body.scenery)]
    leader = {i: i for i in moving}
    for joint in scene.joints:
        a, b = scene.index(joint.parent), scene.index(joint.child)
        if a not in leader or b not in leader:
            # Something joined to a body that never moves does not move either.
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


def build_model(scene: Scene, settings: Settings) -> RigidModel:
    """Work out masses, frames and geoms of a scene and compile MuJoCo's collision model."""
    groups = group_bodies(scene)
    actors, count = len(groups), len(scene.bodies)
    positions = np.array([b.position for b in scene.bodies], dtype=np.float64).reshape(-1, 3)
    turns = np.array([b.rotation for b in scene.bodies], dtype=np.float64).reshape(-1, 4)
    turns = unit(turns)
    hulls = [[] if b.scenery else collision_hulls(b.shape, b.scale) for b in scene.bodies]
    masses = [
        hull_mass([piece.corners for piece in pieces], body.mass)
        for pieces, body in zip(hulls, scene.bodies, strict=True)
    ]
    actor_of = np.full(count, actors, np.int64)
    pivot, turn = positions.copy(), turns.copy()
    center = positions + rotate_vectors(turns, np.array([m.center for m in masses]))
    inv_mass, inv_inertia = np.zeros(actors + 1), np.zeros((actors + 1, 3, 3))
    start_x, start_q = np.zeros((actors + 1, 3)), np.tile([1.0, 0, 0, 0], (actors + 1, 1))
    for actor, group in enumerate(groups):
        frame = turns[group[0]]
        parts: list[MassProperties] = []
        for i in group:
            actor_of[i] = actor
            turn[i] = multiply_quaternions(conjugate(frame), turns[i])
            pivot[i] = rotate_vectors(conjugate(frame), positions[i] - positions[group[0]])
            parts.append(masses[i].moved(pivot[i], turn[i]))
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
        pivot[i] + rotate_vectors(turn[i], piece.corners)
        for i, pieces in enumerate(hulls)
        for piece in pieces
    ]
    geoms = [piece for pieces in hulls for piece in pieces]
    first_vertex = np.cumsum([0, *(len(c) for c in corners)])
    loops = [
        face + start for g, start in zip(geoms, first_vertex, strict=False) for face in g.faces
    ]
    contacts = [b.contact for b in scene.bodies] + [settings.floor]
    return RigidModel(
        inv_mass=inv_mass,
        inv_inertia=inv_inertia,
        drag=drag,
        actor_of=actor_of,
        pivot=pivot,
        turn=turn,
        center=center,
        geom_body=np.array(geom_body, np.int64),
        vertices=np.concatenate(corners) if corners else np.zeros((0, 3)),
        first_vertex=first_vertex,
        loops=np.concatenate(loops) if loops else np.zeros(0, np.int64),
        first_loop=np.cumsum([0, *(len(loop) for loop in loops)]),
        first_face=np.cumsum([0, *(len(geom.faces) for geom in geoms)]),
        material=np.array(
            [[c.static_friction, c.dynamic_friction, c.restitution] for c in contacts]
        ),
        start_x=start_x,
        start_q=start_q,
        mujoco_model=_compile(actors, actor_of[geom_body], corners, settings),
    )


def _compile(
    actors: int, geom_actor: Index, corners: list[Array], settings: Settings
) -> mujoco.MjModel:
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
