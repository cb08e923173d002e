"""Actors of a scene: what moves as one, with its mass and its frame.

An actor is a body, or several bodies joined together. Its frame has its origin at the centre of
mass and the axes of its first body. Bodies that do not move belong to the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadSceneError
from physion.numerics.linear_algebra import unit
from physion.numerics.rotations import conjugate, multiply_quaternions, rotate_vectors
from physion.physics.rigid.mass import MassProperties, body_mass, hull_mass, merge_masses
from physion.scenes.scene import Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


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
