"""Support: a ball hits a tower; does the object on top fall onto the plate around the tower?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physion.core.seeds import child_generator
from physion.scenes.sampling.build import Palette, build_scene, scenario
from physion.scenes.sampling.parameters import Length, Room, retry
from physion.scenes.sampling.placement import (
    BodyRule,
    CameraRule,
    PushRule,
    SceneryRule,
    ZoneRule,
    draw_body,
    draw_push,
    draw_zone,
)
from physion.scenes.sampling.stacks import (
    StackRule,
    draw_looks,
    draw_stack,
    height_of_top,
    is_clear_of,
    raise_above,
    set_mass_by_volume,
)
from physion.scenes.scene import Body, Roles, Scene

MAX_FRAMES = 602
TRIES = 100

BLOCKS = StackRule(
    BodyRule(
        ("cube",),
        (0.4, 0.5),
        (-45.0, 45.0),
        static_friction=(0.0, 0.9),
        dynamic_friction=(0.0, 0.9),
        restitution=(0.0, 1.0),
    ),
    jitter=0.3,
)
CAP = BodyRule(("sphere",), (0.4, 0.4))
ZONE = ZoneRule(scale=((5.0, 5.0), (5.0, 5.0), (0.01, 0.01)), friction=(0.15, 0.15))
PROBE = BodyRule(
    ("sphere",), (0.3, 0.3), static_friction=(0.01, 0.01), dynamic_friction=(0.01, 0.01)
)
PUSH = PushRule(speed=(1.0, 8.0), height=0.5, frame=(15.0, 15.0))
CAMERA = CameraRule((2.75, 2.75), (0.0, 90.0), (0.75, 2.0))
SCENERY = SceneryRule()


@dataclass(frozen=True)
class SupportParameters:
    """Parameters of the scenario support (docs/official-system.md, 2.1, 3.0 and 3.2).

    - ``length``: metres; the probe starts at x = -length / 2, the tower is at the centre.
    - ``stack``: the blocks of the tower, from below. ``cap``: the object on top, the agent.

    Masses of blocks and cap are for a cube with sides of 0.5 m (`StackRule`).
    """

    length: Length = 2.0
    stack: StackRule = BLOCKS
    cap: BodyRule = CAP
    zone: ZoneRule = ZONE
    probe: BodyRule = PROBE
    push: PushRule = PUSH
    monochrome: bool = True
    room: Room = "box"
    camera: CameraRule = CAMERA
    scenery: SceneryRule = SCENERY


@scenario("support", SupportParameters)
def sample(params: SupportParameters, seed: np.random.SeedSequence) -> Scene:
    """Sample a tower in the middle of a plate, and a ball at -x pushed towards its foot."""
    rng, palette = child_generator(seed, "placement"), Palette.of(seed)
    target_look = palette.agent_look(params.cap.textures)
    probe_look = palette.look(params.probe.textures)
    zone = draw_zone(rng, params.zone, palette.look(params.zone.textures))
    looks = draw_looks(rng, params.stack, palette, params.monochrome)
    push_rng = child_generator(seed, "push")
    drawn: list[Body] = []

    def attempt() -> str | None:
        floor = zone.scale[2]
        blocks = draw_stack(rng, params.stack, floor, (zone,), looks, "block")
        top = height_of_top(blocks[-1]) if blocks else floor
        cap = set_mass_by_volume(draw_body(rng, params.cap, "target", (0.0, 0.0, top), target_look))
        start = (-params.length / 2, 0.0, 0.0)
        probe = draw_body(push_rng, params.probe, "probe", start, probe_look, angular_drag=0.0)
        drawn[:] = [raise_above(cap, (zone, *blocks)), raise_above(probe, (zone,)), *blocks]
        return None if is_clear_of(drawn[1], blocks) else "the probe would start inside the tower"

    retry(TRIES, "support", attempt)
    target, probe = drawn[:2]
    return build_scene(
        "support",
        seed,
        params,
        bodies=(zone, *drawn),
        roles=Roles("target", "zone", "probe"),
        max_frames=MAX_FRAMES,
        aim_height=height_of_top(target) / 2,
        pushes=(draw_push(push_rng, params.push, probe),),
    )
