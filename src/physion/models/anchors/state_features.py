"""State of agent, patient and probe at the last observed frame, as a row of numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.models.batch import LAST_OBSERVED, Motion
from physion.numerics.linear_algebra import norm
from physion.numerics.rotations import rotate_vectors
from physion.physics.trajectory import State
from physion.scenes.scene import Scene
from physion.scenes.shapes.primitives import shape

F64 = NDArray[np.float64]

ROLES = ("agent", "patient", "probe")
PAIRS = (("agent", "patient"), ("probe", "agent"), ("probe", "patient"))
"""Pairs whose relative position and velocity are features."""
BLOCK: tuple[str, ...] = (
    "present",
    "cloth",
    "x",
    "y",
    "z",
    "qw",
    "qx",
    "qy",
    "qz",
    "vx",
    "vy",
    "vz",
)
BLOCK += ("wx", "wy", "wz", "length", "width", "height")
BETWEEN = ("dx", "dy", "dz", "dvx", "dvy", "dvz", "distance")
NAMES = tuple(f"{role} {name}" for role in ROLES for name in BLOCK) + tuple(
    f"{a} to {b} {name}" for a, b in PAIRS for name in BETWEEN
)
"""Names of the features; metres, seconds and radians."""


@dataclass(frozen=True)
class Thing:
    """Body or cloth at one instant: centre (3,), rotation (4,), velocities (3,), extents (3,)."""

    cloth: bool
    center: F64
    rotation: F64
    velocity: F64
    angular_velocity: F64
    size: F64


def state_features(motion: Motion) -> F64:
    """Return the features called `NAMES` of the last observed frame of a motion.

    Agent, patient and probe (the body that is pushed) give whether they are there, whether they
    are cloth, and then the centre of their bounding box, rotation (with w not negative),
    velocities and size; pairs of them give relative position and velocity, and distance. A cloth
    counts as a point with the mean of its vertices and no rotation. What is absent gives zeros.
    """
    scene, state = motion.scene, motion.trajectory.state(LAST_OBSERVED)
    things = {role: find_thing(scene, state, getattr(scene.roles, role)) for role in ROLES}
    rows = [_block(things[role]) for role in ROLES]
    rows += [_between(things[first], things[second]) for first, second in PAIRS]
    return np.concatenate(rows)


def find_thing(scene: Scene, state: State, name: str | None) -> Thing | None:
    """Return the body or cloth called ``name``, None if the scene or the instant has none."""
    if name is None:
        return None
    index = scene.index(name)
    if not scene.present(state.frame)[index]:
        return None
    if index >= len(scene.bodies):
        return _cloth(scene, state, index - len(scene.bodies))
    body = scene.bodies[index]
    low, high = shape(body.shape).bounds * np.asarray(body.scale)
    rotation = state.rotations[index]
    return Thing(
        cloth=False,
        center=state.positions[index] + rotate_vectors(rotation, (low + high) / 2),
        rotation=-rotation if rotation[0] < 0 else rotation,
        velocity=state.velocities[index],
        angular_velocity=state.angular_velocities[index],
        size=high - low,
    )


def _cloth(scene: Scene, state: State, number: int) -> Thing:
    """Return cloth ``number`` as the mean of its vertices."""
    counts = [cloth.resolution**2 for cloth in scene.cloths]
    rows = slice(sum(counts[:number]), sum(counts[: number + 1]))
    return Thing(
        cloth=True,
        center=state.cloth_vertices[rows].mean(axis=0),
        rotation=np.array([1.0, 0.0, 0.0, 0.0]),
        velocity=state.cloth_velocities[rows].mean(axis=0),
        angular_velocity=np.zeros(3),
        size=np.asarray(scene.cloths[number].size, np.float64),
    )


def _block(thing: Thing | None) -> F64:
    """Return the features of one thing, in the order of `BLOCK`."""
    if thing is None:
        return np.zeros(len(BLOCK))
    flags = [1.0, float(thing.cloth)]
    parts = [thing.center, thing.rotation, thing.velocity, thing.angular_velocity, thing.size]
    return np.concatenate([flags, *parts])


def _between(first: Thing | None, second: Thing | None) -> F64:
    """Return the features of a pair, in the order of `BETWEEN`."""
    if first is None or second is None:
        return np.zeros(len(BETWEEN))
    apart = second.center - first.center
    speed = second.velocity - first.velocity
    return np.concatenate([apart, speed, [float(norm(apart))]])
