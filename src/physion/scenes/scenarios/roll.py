"""Roll: an object slides down a ramp, rolls over a ledge or is hit; does it reach the zone?"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Annotated

import numpy as np

from physion.core.seeds import child_generator
from physion.scenes.sampling.build import Palette, as_record, build_scene, scenario, scene_name
from physion.scenes.sampling.parameters import (
    FloorPosition,
    Frictions,
    Length,
    Masses,
    Materials,
    NamesOf,
    Room,
    Shapes,
    Sizes,
    draw_axes,
    pick,
    uniform,
    yaw,
)
from physion.scenes.sampling.placement import (
    BodyRule,
    CameraRule,
    PushRule,
    SceneryRule,
    ZoneRule,
    draw_body,
    draw_push,
    draw_zone,
    raise_to_floor,
    world_corners,
)
from physion.scenes.scenarios import collide
from physion.scenes.scene import Body, Roles, Scene, SurfaceMaterial

TEMPLATES = ("ramp", "ledge", "collision")
MAX_FRAMES = 302
GAP = 0.001
"""Gap between the ramp and a target that had to be raised, metres."""

Templates = Annotated[tuple[str, ...], NamesOf("template", TEMPLATES)]

PRIMITIVES = ("bowl", "cone", "cube", "cylinder", "dumbbell", "pentagon", "pipe", "pyramid")
ROLLING = ("pipe", "cube", "pentagon", "sphere")
ANY_ROTATION = ((0.0, 360.0), (0.0, 360.0), (0.0, 360.0))
SMALL, ROUGH, SMOOTH = (0.25, 0.25), (0.4, 0.4), (0.01, 0.01)

RELEASED = BodyRule(ROLLING, SMALL, ANY_ROTATION, static_friction=ROUGH, dynamic_friction=ROUGH)
ROLLED = BodyRule(ROLLING, SMALL, static_friction=ROUGH, dynamic_friction=ROUGH)
KNOCKED = BodyRule((*PRIMITIVES, "sphere"), (SMALL, SMALL, (0.5, 0.5)))
KNOCKING = BodyRule(
    PRIMITIVES,
    (0.35, 0.35),
    (-180.0, 180.0),
    tumbled=True,
    static_friction=ROUGH,
    dynamic_friction=ROUGH,
)
RAMP_ZONE = ZoneRule(scale=((2.05, 2.05), (2.05, 2.05), (0.01, 0.01)))
LEDGE_ZONE = ZoneRule(scale=((2.0, 2.0), (2.0, 2.0), (0.01, 0.01)))
LEDGE_PUSH = PushRule(speed=(4.0, 7.0), heading_deg=(-20.0, 20.0), height=0.0)
KNOCK = PushRule(speed=(2.0, 9.0), heading_deg=(-3.0, 3.0))
CAMERA, SCENERY = CameraRule(), SceneryRule()


@dataclass(frozen=True)
class RampRule:
    """Template in which the target is released above a slippery ramp that ends before the zone.

    - ``length``: metres from the scene's centre to the zone's centre; the pivot of the ramp is at
      x = -length / 2.
    - ``shapes``, ``scale``, ``friction``, ``mass``, ``textures``: of the ramp. ``lift``: height of
      the ramp above the floor, metres; officially the thickness of the zone.
    - ``start``: horizontal distance from the ramp's pivot to the target's pivot, up the slope,
      metres (measured in official scenes).
    - ``drop``: height of the target's pivot above the ramp's top, metres. A rotated target that
      would start inside the ramp is raised.
    """

    length: Length = 1.25
    shapes: Shapes = ("ramp_with_platform_30",)
    scale: Sizes = ((0.2, 0.2), (0.5, 0.5), (1.0, 1.0))
    lift: Length = 0.0
    friction: Frictions = SMOOTH
    mass: Masses = (500.0, 500.0)
    textures: Materials = ("wood_ash",)
    start: Length = 0.1953
    drop: Length = 0.15
    target: BodyRule = RELEASED
    zone: ZoneRule = RAMP_ZONE


@dataclass(frozen=True)
class LedgeRule:
    """Template in which the target is pushed at its base over a low round ledge towards the zone.

    - ``length``: metres from the scene's centre to the zone's centre; the target is at
      x = -length / 2.
    - ``shapes``, ``scale``, ``center``, ``friction``, ``mass``, ``textures``: of the ledge. The
      official ledge is a sphere scaled to a length of 100 m, half of it below the floor; the half
      cylinder has the same cross-section and stands on the floor.
    """

    length: Length = 1.5
    shapes: Shapes = ("half:cylinder",)
    scale: Sizes = ((0.05, 0.05), (100.0, 100.0), (0.05, 0.05))
    center: FloorPosition = (0.0, 0.0)
    friction: Frictions = (0.5, 0.5)
    mass: Masses = (1000.0, 1000.0)
    textures: Materials = ("wood", "metal", "plastic")
    target: BodyRule = ROLLED
    zone: ZoneRule = LEDGE_ZONE
    push: PushRule = LEDGE_PUSH


@dataclass(frozen=True)
class CollisionRule:
    """Template like `collide.CollideParameters`, with probes of any shape that start in the air."""

    length: Length = 1.7
    target: BodyRule = KNOCKED
    probe: BodyRule = KNOCKING
    zone: ZoneRule = collide.ZONE
    zone_jitter: Length = 0.35
    lift: Length = 0.25
    push: PushRule = KNOCK
    monochrome: bool = True


@dataclass(frozen=True)
class RollParameters:
    """Parameters of the scenario roll (docs/official-system.md, 2.1, 3.0 and 3.7).

    ``template`` is one of `TEMPLATES`, or several of which one is drawn; only the rule of that name
    is used. Defaults follow the published configurations, except ``ramp.lift`` (0.01 there)
    and ``collision.push.point_jitter`` (0.5 there, mostly outside the probe).
    """

    template: Templates = ("ramp",)
    ramp: RampRule = RampRule()
    ledge: LedgeRule = LedgeRule()
    collision: CollisionRule = CollisionRule()
    room: Room = "box"
    camera: CameraRule = CAMERA
    scenery: SceneryRule = SCENERY


@scenario("roll", RollParameters)
def sample(params: RollParameters, seed: np.random.SeedSequence) -> Scene:
    """Sample a scene of one template, with the zone at +x; the scene's parameters name it."""
    template = pick(child_generator(seed, "template"), params.template)
    chosen = replace(params, template=(template,))
    if template == "collision":
        return _sample_collision(chosen, seed)
    return _sample_ramp(chosen, seed) if template == "ramp" else _sample_ledge(chosen, seed)


def _sample_ramp(params: RollParameters, seed: np.random.SeedSequence) -> Scene:
    rule, rng, palette = params.ramp, child_generator(seed, "placement"), Palette.of(seed)
    zone = draw_zone(rng, rule.zone, palette.look(rule.zone.textures), (rule.length, 0.0))
    look = palette.agent_look(rule.target.textures)
    friction = uniform(rng, rule.friction)
    ramp = Body(
        "ramp",
        pick(rng, rule.shapes),
        (-rule.length / 2, 0.0, rule.lift),
        draw_axes(rng, rule.scale),
        yaw(math.pi),  # down towards the zone
        uniform(rng, rule.mass),
        SurfaceMaterial(friction, friction, 0.0),
        kinematic=True,
        look=palette.look(rule.textures),
    )
    top = float(world_corners(ramp)[:, 2].max()) - rule.lift
    position = (ramp.position[0] - rule.start, 0.0, top + rule.drop)
    target = draw_body(rng, rule.target, "target", position, look, angular_drag=0.0)
    return build_scene(
        "roll",
        seed,
        params,
        bodies=(zone, _above_ramp(target, ramp), ramp),
        roles=Roles("target", "zone"),
        max_frames=MAX_FRAMES,
    )


def _above_ramp(target: Body, ramp: Body) -> Body:
    """Return the target, raised if a part of it is inside a ramp that leads down towards +x.

    It is outside if it lies above a plane through the ridge between slope and platform that is not
    steeper than the slope.
    """
    corners = world_corners(ramp)
    top, bottom = corners[:, 2].max(), corners[:, 2].min()
    ridge, foot = corners[corners[:, 2] > top - 1e-9, 0].max(), corners[:, 0].max()
    grades = np.linspace(0.0, (top - bottom) / (foot - ridge), 256)[:, None]
    along, up = world_corners(target)[:, 0] - ridge, world_corners(target)[:, 2] - top
    missing = float((-up - along * grades).max(axis=1).min())
    x, y, z = target.position
    return replace(target, position=(x, y, z + missing + GAP)) if missing > 0 else target


def _sample_ledge(params: RollParameters, seed: np.random.SeedSequence) -> Scene:
    rule, rng, palette = params.ledge, child_generator(seed, "placement"), Palette.of(seed)
    zone = draw_zone(rng, rule.zone, palette.look(rule.zone.textures), (rule.length, 0.0))
    look = palette.agent_look(rule.target.textures)
    friction = uniform(rng, rule.friction)
    ledge = Body(
        "ledge",
        pick(rng, rule.shapes),
        (*rule.center, 0.0),
        draw_axes(rng, rule.scale),
        mass=uniform(rng, rule.mass),
        contact=SurfaceMaterial(friction, friction, 0.0),
        kinematic=True,
        look=palette.look(rule.textures),
    )
    position = (-rule.length / 2, 0.0, 0.0)
    target = raise_to_floor(draw_body(rng, rule.target, "target", position, look, angular_drag=0.0))
    push = draw_push(child_generator(seed, "push"), rule.push, target)
    return build_scene(
        "roll",
        seed,
        params,
        bodies=(zone, target, ledge),
        roles=Roles("target", "zone", "target"),
        max_frames=MAX_FRAMES,
        pushes=(push,),
        around=(zone, target),  # the ledge extends behind and before all scenery
    )


def _sample_collision(params: RollParameters, seed: np.random.SeedSequence) -> Scene:
    rule = params.collision
    values = {field.name: getattr(rule, field.name) for field in fields(rule)}
    same = collide.CollideParameters(
        **values, room=params.room, camera=params.camera, scenery=params.scenery
    )
    return replace(
        collide.sample(same, seed),
        name=scene_name("roll", seed),
        scenario="roll",
        parameters=as_record(params),
    )
