"""Drop: an object falls onto another one; does it reach the zone below?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from physion.core.seeds import child_generator
from physion.numerics.elementary import standard_normal
from physion.numerics.linear_algebra import unit
from physion.scenes.sampling.build import Palette, build_scene, scenario
from physion.scenes.sampling.parameters import (
    Length,
    Lengths,
    Multiples,
    Room,
    as_quaternion,
    uniform,
)
from physion.scenes.sampling.placement import (
    BodyRule,
    CameraRule,
    SceneryRule,
    ZoneRule,
    draw_body,
    draw_zone,
    raise_to_floor,
    world_bounds,
)
from physion.scenes.scene import Body, Quat, Roles, Scene

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
MAX_FRAMES = 302
FALL = 0.1
"""Smallest height of free fall, metres. Long objects may have to start higher than drawn."""
ANY_ROTATION = ((0.0, 360.0), (0.0, 360.0), (0.0, 360.0))

DROPPED = BodyRule(
    PRIMITIVES,
    (0.1, 0.4),
    ANY_ROTATION,
    mass=(2.0, 7.0),
    static_friction=(0.4, 0.4),
    dynamic_friction=(0.4, 0.4),
)
LOWER = BodyRule(
    ("bowl", "cube", "cylinder", "pipe"),
    (0.3, 1.0),
    mass=(10.0, 11.0),
    static_friction=(0.4, 0.4),
    dynamic_friction=(0.4, 0.4),
)
ZONE = ZoneRule(scale=((2.0, 2.0), (2.0, 2.0), (0.01, 0.01)))
CAMERA = CameraRule((2.0, 2.0), (45.0, 225.0), (0.25, 4.0))
"""The official camera may be 2 cm above the floor, from where the zone cannot be seen."""
SCENERY = SceneryRule()


@dataclass(frozen=True)
class DropParameters:
    """Parameters of the scenario drop (docs/official-system.md, 2.1, 3.0 and 3.5).

    Defaults follow the official `simple` configurations, except ``even_turn``. Masses are the
    values that had an effect: the official mass arguments had none.

    - ``dropped``: the falling object. ``lower``: the object below, on the floor or on the zone.
    - ``even_turn``: draw the orientation of the falling object uniformly among all rotations.
      Otherwise it is rotated by ``dropped.turn_deg``, officially by three uniform angles, which
      is not a uniform orientation.
    - ``height``: of the falling object's pivot above the floor, metres; ``jitter``: its largest
      displacement along x and y, metres. It starts higher if it would be inside the lower object
      or just above it.
    - ``camera_height``: as a factor of the height of the fall, within ``camera.height`` (metres).
    """

    dropped: BodyRule = DROPPED
    lower: BodyRule = LOWER
    zone: ZoneRule = ZONE
    even_turn: bool = True
    height: Lengths = (1.25, 1.5)
    jitter: Length = 0.2
    camera_height: Multiples = (0.0, 2.0)
    monochrome: bool = True
    room: Room = "box"
    camera: CameraRule = CAMERA
    scenery: SceneryRule = SCENERY


@scenario("drop", DropParameters)
def sample(params: DropParameters, seed: np.random.SeedSequence) -> Scene:
    """Sample a randomly rotated object in the air above one that stands at the origin."""
    rng, palette = child_generator(seed, "placement"), Palette.of(seed)
    zone = draw_zone(rng, params.zone, palette.look(params.zone.textures))
    look = palette.look(params.lower.textures)
    lower = _put_on_zone(draw_body(rng, params.lower, "lower", (0.0, 0.0, 0.0), look), zone)
    target = _draw_dropped(params, rng, palette, lower)
    fall = target.position[2]
    lowest, highest = params.camera.height
    low, high = (min(max(times * fall, lowest), highest) for times in params.camera_height)
    return build_scene(
        "drop",
        seed,
        params,
        bodies=(zone, target, lower),
        roles=Roles("target", "zone"),
        max_frames=MAX_FRAMES,
        aim_height=fall / 2,
        camera=replace(params.camera, height=(low, high)),
    )


def _put_on_zone(lower: Body, zone: Body) -> Body:
    """Return the lower body, on the zone if it is above it, otherwise on the floor."""
    lower = raise_to_floor(lower)
    below, body = world_bounds(zone), world_bounds(lower)
    apart = (below[1, :2] <= body[0, :2]).any() or (body[1, :2] <= below[0, :2]).any()
    x, y, z = lower.position
    return lower if apart else replace(lower, position=(x, y, z + float(below[1, 2])))


def _draw_dropped(
    params: DropParameters, rng: np.random.Generator, palette: Palette, lower: Body
) -> Body:
    """Draw the falling object, high enough to fall at least `FALL` metres."""
    x, y = (uniform(rng, (-params.jitter, params.jitter)) for _ in range(2))
    position = (x, y, uniform(rng, params.height))
    look = palette.agent_look(params.dropped.textures)
    target = draw_body(rng, params.dropped, "target", position, look)
    rotation = random_rotation(rng)
    if params.even_turn:
        target = replace(target, rotation=rotation)
    missing = float(world_bounds(lower)[1, 2] + FALL - world_bounds(target)[0, 2])
    return replace(target, position=(x, y, position[2] + max(0.0, missing)))


def random_rotation(rng: np.random.Generator) -> Quat:
    """Draw a rotation uniformly among all orientations."""
    return as_quaternion(unit(standard_normal(rng, 4)))
