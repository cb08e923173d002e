"""Collide: a ball shoots at an object; is the object knocked onto the zone behind it?"""

from __future__ import annotations

import math
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
    yaw,
)
from physion.scenes.scenarios import as_record, scenario, scene_name
from physion.scenes.scene import Body, Contact, Ending, Look, Push, Roles, Scene, Vec3
from physion.scenes.shapes import shape
from physion.seeds import child_generator

PUSH_HEIGHT = 0.8
"""Where the probe is pushed, as a share of its scale above its pivot."""
AIM_HEIGHT = 0.5
"""Metres above the floor at which the camera looks."""

CAMERA = CameraRule((2.3, 2.3), (0.0, 360.0), (0.75, 2.0))
SCENERY = SceneryRule(
    distractor_spacing_deg=20.0,
    occluder_spacing_deg=15.0,
    distractor_size=(0.5, 1.0),
    occluder_size=(0.25, 1.0),
)


@dataclass(frozen=True)
class Params:
    """What is drawn for a trial of collide (reference/official-system.md, 2.1, 3.0 and 3.3).

    Defaults are the official class defaults, but for the heading of the push: the class has 20
    degrees, at which most pushes miss, all configurations have 8 or less.

    - ``length``: metres from probe to target and from the middle to the zone's centre.
    - ``target_scale``, ``zone``: width along the push, across, height; ``probe_scale``: metres at
      unit size. Masses in kg.
    - ``zone_jitter``: metres across. ``lift``: metres that the probe starts above the floor.
    - ``push_speed``: metres per second that the push would give, ``push_angle_deg`` its heading,
      ``push_rise`` its vertical share.
    - ``push_jitter``: metres by which the point of the push is off in each direction, at most.
      The released configurations have 0.5, mostly outside the probe, which gives it a spin that
      nobody controls; the default is none.
    """

    length: float = 2.0
    targets: tuple[str, ...] = ("pipe", "cube", "pentagon")
    target_scale: Vec3 = (0.25, 0.25, 0.5)
    target_yaw_deg: Range = (0.0, 0.0)
    target_mass: float = 2.0
    probes: tuple[str, ...] = ("sphere",)
    probe_scale: float = 0.35
    probe_mass: Range = (2.0, 2.0)
    zone: Vec3 = (1.0, 1.0, 0.01)
    zone_jitter: float = 0.35
    lift: float = 0.0
    push_speed: Range = (5.0, 10.0)
    push_angle_deg: Range = (-8.0, 8.0)
    push_rise: Range = (0.0, 0.0)
    push_jitter: float = 0.0
    room: str = "box"
    camera: CameraRule = CAMERA
    scenery: SceneryRule = SCENERY


@scenario("collide", Params)
def sample(params: Params, seed: np.random.SeedSequence) -> Scene:
    """Draw a ball at -x that is pushed towards a target at +x, with the zone beyond."""
    placement, looks = child_generator(seed, "placement"), child_generator(seed, "looks")
    target_color = random_color(looks)
    offset = uniform(placement, (-params.zone_jitter, params.zone_jitter))
    zone = Body(
        "zone",
        "cube",
        (params.length, offset, 0.0),
        params.zone,
        mass=500.0,
        contact=Contact(1.0, 0.1, 0.0),
        kinematic=True,
        look=Look(random_color(looks, (target_color,)), "wood_ash"),
    )
    target = Body(
        "target",
        params.targets[int(placement.integers(len(params.targets)))],
        (params.length / 2, 0.0, 0.0),
        params.target_scale,
        yaw(math.radians(uniform(placement, params.target_yaw_deg))),
        params.target_mass,
        look=Look(target_color, "wood_cedar"),
    )
    probe, push = _probe(params, seed, Look(random_color(looks, (target_color,)), "wood_cedar"))
    bodies = (zone, target, probe)
    camera = place_camera(
        child_generator(seed, "camera"), params.camera, AIM_HEIGHT, (target, zone)
    )
    scenery = place_scenery(
        params.scenery,
        camera,
        bodies,
        child_generator(seed, "distractors"),
        child_generator(seed, "occluders"),
    )
    return Scene(
        name=scene_name("collide", seed),
        scenario="collide",
        bodies=(*bodies, *scenery),
        roles=Roles("target", "zone", "probe"),
        camera=camera,
        pushes=(push,),
        room=params.room,
        ending=Ending(max_frames=152),
        parameters=as_record(params),
    )


def _probe(params: Params, seed: np.random.SeedSequence, look: Look) -> tuple[Body, Push]:
    rng = child_generator(seed, "push")
    kind = params.probes[int(rng.integers(len(params.probes)))]
    mass = uniform(rng, params.probe_mass)
    speed, rise = uniform(rng, params.push_speed), uniform(rng, params.push_rise)
    heading = math.radians(uniform(rng, params.push_angle_deg))
    size = params.probe_scale
    x, y, z = -params.length / 2, 0.0, params.lift
    # The push is at most as high as the probe's own top: flat shapes are not pushed in the air.
    height = min(PUSH_HEIGHT, float(shape(kind).bounds[1, 2])) * size
    dx, dy, dz = (float(d) for d in rng.uniform(-params.push_jitter, params.push_jitter, 3))
    probe = Body(
        "probe",
        kind,
        (x, y, z),
        (size, size, size),
        mass=mass,
        contact=Contact(0.4, 0.4, 0.0),
        angular_drag=0.0,
        look=look,
    )
    way = (math.cos(heading), math.sin(heading), rise)
    return probe, Push(
        "probe",
        (speed * mass * way[0], speed * mass * way[1], speed * mass * way[2]),
        (x + dx, y + dy, z + height + dz),
    )
