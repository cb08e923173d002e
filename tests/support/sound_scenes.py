"""What makes a scene sound at its start, for the tests of scenarios and of their presets."""

from __future__ import annotations

import itertools
import math
from functools import cache

import numpy as np
from scipy.optimize import linprog

from physion.numerics.rotations import rotate_vectors
from physion.scenes.looks import TEXTURES
from physion.scenes.sampling.placement import project_to_image, world_bounds
from physion.scenes.scene import Body, Cloth, Scene
from physion.scenes.shapes.primitives import shape


def thing(scene: Scene, name: str) -> Body | Cloth:
    return (*scene.bodies, *scene.cloths)[scene.index(name)]


def body(scene: Scene, name: str) -> Body:
    found = thing(scene, name)
    assert isinstance(found, Body)
    return found


def bounds(one: Body | Cloth) -> np.ndarray:
    """(2, 3): smallest and largest coordinates, of a cloth as it lies before it falls."""
    if isinstance(one, Body):
        return world_bounds(one)
    corners = sheet(one)
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def sheet(cloth: Cloth) -> np.ndarray:
    flat = [(x, y, 0.0) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
    return rotate_vectors(cloth.rotation, np.array(flat) * cloth.size) + cloth.position


@cache
def unit_corners(name: str) -> tuple[np.ndarray, ...]:
    return tuple(piece.mesh.vertices for piece in shape(name).pieces)


def hulls(one: Body | Cloth) -> list[np.ndarray]:
    """World corners of all pieces, a hair smaller so that touching is not overlapping."""
    if isinstance(one, Cloth):
        return [sheet(one)]
    corners = [rotate_vectors(one.rotation, piece * one.scale) for piece in unit_corners(one.shape)]
    return [c.mean(axis=0) + 0.998 * (c - c.mean(axis=0)) + one.position for c in corners]


def overlap(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two convex hulls share a point: boxes first, then a linear program."""
    if (a.max(axis=0) < b.min(axis=0)).any() or (b.max(axis=0) < a.min(axis=0)).any():
        return False
    # A point of both hulls: weights of a's corners and of b's corners that give the same point.
    equal = np.zeros((5, len(a) + len(b)))
    equal[:3, : len(a)], equal[:3, len(a) :] = a.T, -b.T
    equal[3, : len(a)] = equal[4, len(a) :] = 1
    found = linprog(np.zeros(equal.shape[1]), A_eq=equal, b_eq=[0, 0, 0, 1, 1], method="highs")
    return bool(found.status == 0)


def overlapping(scene: Scene) -> list[tuple[str, str]]:
    """Pairs of solids, cloth included, that start inside each other."""
    solids = [one for one in (*scene.bodies, *scene.cloths) if not getattr(one, "scenery", False)]
    return [
        (one.name, other.name)
        for one, other in itertools.combinations(solids, 2)
        if any(overlap(a, b) for a, b in itertools.product(hulls(one), hulls(other)))
    ]


def assert_valid(scene: Scene) -> None:
    """Roles, shapes, materials and frictions make sense, and nothing starts under the floor."""
    agent, patient = thing(scene, scene.roles.agent), body(scene, scene.roles.patient)
    assert patient.kinematic and not patient.scenery
    if isinstance(agent, Body):
        assert not agent.kinematic and not agent.scenery
    assert 1 <= scene.ending.min_frames <= 151 <= scene.ending.max_frames
    for one in (*scene.bodies, *scene.cloths):
        assert one.look.texture in TEXTURES
        assert math.isclose(math.hypot(*one.rotation), 1.0)
        assert bounds(one)[0, 2] > scene.floor - 1e-9, f"{one.name} starts under the floor"
    for one in scene.bodies:
        assert shape(one.shape).mesh.faces.size
        assert one.contact.static_friction >= one.contact.dynamic_friction
        assert one.mass >= 0.001 and min(one.scale) >= 0.001


def assert_seen(scene: Scene) -> None:
    """The middles of agent and patient are in the picture."""
    for name in (scene.roles.agent, scene.roles.patient):
        center = bounds(thing(scene, name)).mean(axis=0)
        assert max(map(abs, project_to_image(scene.camera, center))) < 1, name
