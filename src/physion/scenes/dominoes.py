"""Dominoes: a pushed domino topples a row of others, or not; does the last one reach the zone?"""

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
from physion.seeds import child_generator

ZONE_GAP = 0.1
"""Metres added between zone and target (official-system.md, section 3.1)."""
PUSH_HEIGHT = 0.8
"""Where the probe is pushed, as a share of its height."""
AIM_HEIGHT = 0.5
"""Metres above the floor at which the camera looks."""
BODY_GAP = 0.01
"""Metres kept free between neighbours, which officially may start inside each other."""

CAMERA, SCENERY = CameraRule(), SceneryRule()


@dataclass(frozen=True)
class Params:
    """What is drawn for a trial of dominoes.

    Defaults are the official configuration `pilot_dominoes_2mid_J025R30`, in which every second
    trial ends in contact (sections 2.1, 3.0 and 3.1 of reference/official-system.md).

    - ``length``: metres from probe to target. ``middle``: how many dominoes between.
    - ``domino``: width along the row, width across, height, metres. ``mass``: kg.
    - ``spacing_jitter``, ``lateral_jitter``: shares of the spacing and of the width across.
    - ``middle_yaw_deg``, ``probe_yaw_deg``: degrees.
    - ``remove_middle``: one of the middle dominoes is left out.
    - ``push_speed``: metres per second that the push would give. ``push_frame``: when.
      ``push_angle_deg``: heading of the push away from the row.
    """

    length: float = 1.5
    middle: int = 2
    domino: Vec3 = (0.1, 0.25, 0.5)
    mass: float = 2.0
    zone: Vec3 = (0.5, 2.0, 0.01)
    spacing_jitter: float = 0.25
    lateral_jitter: float = 0.25
    middle_yaw_deg: Range = (-30.0, 30.0)
    probe_yaw_deg: Range = (0.0, 0.0)
    remove_middle: bool = False
    push_speed: Range = (0.75, 0.75)
    push_frame: Range = (0.0, 15.0)
    push_angle_deg: Range = (0.0, 0.0)
    monochrome: bool = True
    room: str = "box"
    camera: CameraRule = CAMERA
    scenery: SceneryRule = SCENERY


@scenario("dominoes", Params)
def sample(params: Params, seed: np.random.SeedSequence) -> Scene:
    """Draw a row of dominoes along x, the probe at its negative end, the zone beyond the target."""
    looks = child_generator(seed, "looks")
    target_color = random_color(looks)
    zone = Body(
        "zone",
        "cube",
        (params.length / 2 + params.zone[0] + ZONE_GAP, 0.0, 0.0),
        params.zone,
        mass=500.0,
        contact=Contact(1.0, 0.1, 0.0),
        kinematic=True,
        look=Look(random_color(looks, (target_color,)), "wood_ash"),
    )
    target = Body(
        "target",
        "cube",
        (params.length / 2, 0.0, 0.0),
        params.domino,
        mass=params.mass,
        look=Look(target_color, "wood_cedar"),
    )
    probe, push = _probe(params, seed, Look(random_color(looks, (target_color,)), "wood_cedar"))
    bodies = (zone, target, probe, *_middle(params, seed, looks, target_color))
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
        name=scene_name("dominoes", seed),
        scenario="dominoes",
        bodies=(*bodies, *scenery),
        roles=Roles("target", "zone", "probe"),
        camera=camera,
        pushes=(push,),
        room=params.room,
        ending=Ending(max_frames=302),
        parameters=as_record(params),
    )


def _probe(params: Params, seed: np.random.SeedSequence, look: Look) -> tuple[Body, Push]:
    rng = child_generator(seed, "push")
    turn = math.radians(uniform(rng, params.probe_yaw_deg))
    heading = math.radians(uniform(rng, params.push_angle_deg))
    impulse = uniform(rng, params.push_speed) * params.mass
    place = (-params.length / 2, 0.0, 0.0)
    probe = Body(
        "probe",
        "cube",
        place,
        params.domino,
        yaw(turn),
        mass=params.mass,
        contact=Contact(0.01, 0.01, 0.0),
        angular_drag=0.0,
        look=look,
    )
    push = Push(
        "probe",
        (impulse * math.cos(heading), impulse * math.sin(heading), 0.0),
        (place[0], place[1], PUSH_HEIGHT * params.domino[2]),
        int(uniform(rng, params.push_frame)),
    )
    return probe, push


def _middle(
    params: Params, seed: np.random.SeedSequence, looks: np.random.Generator, avoid: Vec3
) -> list[Body]:
    """The dominoes between; their jitter adds up, and the row stops short of the target."""
    rng = child_generator(seed, "placement")
    wide, deep, _ = params.domino
    spacing = params.length / (params.middle + 1)
    removed = int(rng.integers(max(params.middle, 1))) if params.remove_middle else -1
    last = params.length / 2 - wide / 2
    probe_turn = max(map(abs, params.probe_yaw_deg))
    taken = -params.length / 2 + _reach(wide, deep, math.radians(probe_turn))
    shared = random_color(looks, (avoid,))
    x = -params.length / 2
    bodies = []
    for i in range(params.middle):
        share = params.spacing_jitter
        x += spacing * uniform(rng, (1 - share, 1 + share))
        y = deep * uniform(rng, (-params.lateral_jitter, params.lateral_jitter))
        turn = math.radians(uniform(rng, params.middle_yaw_deg))
        color = shared if params.monochrome else random_color(looks, (avoid,))
        reach = _reach(wide, deep, turn) + BODY_GAP
        place = max(min(x, last - reach), taken + reach)
        if place > last - reach:
            break
        taken = place + reach
        if i != removed:
            look = Look(color, "wood_cedar")
            at = (place, y, 0.0)
            rest = (params.domino, yaw(turn), params.mass)
            bodies.append(Body(f"middle_{i}", "cube", at, *rest, look=look))
        if x > last - reach:
            break
    return bodies


def _reach(wide: float, deep: float, turn: float) -> float:
    """Half of what a turned domino takes up along the row."""
    return (abs(math.cos(turn)) * wide + abs(math.sin(turn)) * deep) / 2
