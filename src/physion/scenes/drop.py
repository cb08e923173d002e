"""Drop: an object falls onto another one; does it end up on the zone below, or stay off it?"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from physion.scenes.looks import random_color
from physion.scenes.placement import (
    CameraRule,
    Range,
    SceneryRule,
    place_camera,
    place_scenery,
    uniform,
    world_bounds,
)
from physion.scenes.scenarios import as_record, scenario, scene_name
from physion.scenes.scene import Body, Contact, Ending, Look, Quat, Roles, Scene, Vec3
from physion.seeds import child_generator

PRIMITIVES = (
    "bowl",
    "cone",
    "cube",
    "cylinder",
    "dumbbell",
    "octahedron",
    "pentagon",
    "pipe",
    "platonic",
    "pyramid",
    "sphere",
    "torus",
    "triangular_prism",
)
FALL = 0.1
"""Least free fall in metres: long objects that hang down start higher than drawn."""
LOWEST_CAMERA = 0.25
"""Metres. The official camera may be 2 cm above the floor, where nobody can see the zone."""

CAMERA = CameraRule((2.0, 2.0), (45.0, 225.0), (0.0, 2.0))
SCENERY = SceneryRule()


@dataclass(frozen=True)
class Params:
    """What is drawn for a trial of drop (reference/official-system.md, 2.1, 3.0 and 3.5).

    - ``dropped`` and ``lower``: which shapes fall, and onto which; their scales, and masses in kg
      (the official mass arguments had no effect; these are the values in use).
    - ``height``: metres of the pivot above the floor. ``jitter``: metres along x and y.
    - ``camera``: its heights are multiples of the height of the fall.
    """

    dropped: tuple[str, ...] = PRIMITIVES
    dropped_scale: Range = (0.1, 0.4)
    dropped_mass: Range = (2.0, 7.0)
    lower: tuple[str, ...] = ("bowl", "cube", "cylinder", "pipe")
    lower_scale: Range = (0.3, 1.0)
    lower_mass: Range = (10.0, 11.0)
    height: Range = (1.25, 1.5)
    jitter: float = 0.2
    zone: Vec3 = (2.0, 2.0, 0.01)
    zone_center: tuple[float, float] = (0.0, 0.0)
    zone_friction: float = 0.1
    room: str = "box"
    camera: CameraRule = CAMERA
    scenery: SceneryRule = SCENERY


@scenario("drop", Params)
def sample(params: Params, seed: np.random.SeedSequence) -> Scene:
    """Draw an object in the air, turned at random, above one that stands on the zone."""
    rng, looks = child_generator(seed, "placement"), child_generator(seed, "looks")
    target_color = random_color(looks)
    zone = Body(
        "zone",
        "cube",
        (*params.zone_center, 0.0),
        params.zone,
        mass=500.0,
        contact=Contact(10 * params.zone_friction, params.zone_friction, 0.0),
        kinematic=True,
        look=Look(random_color(looks, (target_color,)), "wood_ash"),
    )
    lower_look = Look(random_color(looks, (target_color,)), "wood_cedar")
    lower = _lower(params, rng, lower_look)
    target = _target(params, rng, lower, Look(target_color, "wood_cedar"))
    fall = target.position[2]
    low, high = params.camera.height
    rule = dataclasses.replace(
        params.camera, height=(max(low * fall, LOWEST_CAMERA), max(high * fall, LOWEST_CAMERA))
    )
    bodies = (zone, target, lower)
    camera = place_camera(child_generator(seed, "camera"), rule, fall / 2, (target, zone))
    scenery = place_scenery(
        params.scenery,
        camera,
        bodies,
        child_generator(seed, "distractors"),
        child_generator(seed, "occluders"),
    )
    return Scene(
        name=scene_name("drop", seed),
        scenario="drop",
        bodies=(*bodies, *scenery),
        roles=Roles("target", "zone"),
        camera=camera,
        room=params.room,
        ending=Ending(max_frames=302),
        parameters=as_record(params),
    )


def _lower(params: Params, rng: np.random.Generator, look: Look) -> Body:
    kind = params.lower[int(rng.integers(len(params.lower)))]
    size = uniform(rng, params.lower_scale)
    return Body(
        "lower",
        kind,
        (0.0, 0.0, params.zone[2]),  # on the zone, where the official one starts inside it
        (size, size, size),
        mass=uniform(rng, params.lower_mass),
        contact=Contact(0.4, 0.4, 0.0),
        look=look,
    )


def _target(params: Params, rng: np.random.Generator, lower: Body, look: Look) -> Body:
    kind = params.dropped[int(rng.integers(len(params.dropped)))]
    size = uniform(rng, params.dropped_scale)
    x, y = (float(d) for d in rng.uniform(-params.jitter, params.jitter, 2))
    target = Body(
        "target",
        kind,
        (x, y, uniform(rng, params.height)),
        (size, size, size),
        random_rotation(rng),
        uniform(rng, params.dropped_mass),
        Contact(0.4, 0.4, 0.0),
        look=look,
    )
    missing = world_bounds(lower)[1, 2] + FALL - world_bounds(target)[0, 2]
    lifted = (x, y, target.position[2] + max(0.0, float(missing)))
    return dataclasses.replace(target, position=lifted)


def random_rotation(rng: np.random.Generator) -> Quat:
    """An even random rotation; three even Euler angles, as officially, would prefer the poles."""
    parts = rng.standard_normal(4)
    w, x, y, z = (float(part) for part in parts / np.linalg.norm(parts))
    return (w, x, y, z)
