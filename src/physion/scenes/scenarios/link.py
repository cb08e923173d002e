"""Link: a ball hits a pole with rings on it; does the agent, one of them, reach the zone?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physion.scenes.sampling.build import scenario
from physion.scenes.sampling.parameters import Counts, Length, Room
from physion.scenes.sampling.placement import BodyRule, CameraRule, PushRule, SceneryRule, ZoneRule
from physion.scenes.sampling.stacks import (
    FilledStackRule,
    StandParameters,
    StandRule,
    sample_standing,
)
from physion.scenes.scene import Scene, Vec3

STAND_COLOR: Vec3 = (1.0, 1.0, 1.0)

STAND = StandRule(
    BodyRule(("cylinder",), (0.3, 0.3), mass=(4.0, 4.0), textures=("wood_ash",)),
    True,
    BodyRule(
        ("cylinder",),
        ((0.15, 0.15), (0.15, 0.15), (1.0, 1.0)),
        mass=(4.0, 4.0),
        textures=("wood_ash",),
    ),
    True,
)
LINKS = FilledStackRule(
    BodyRule(
        ("torus",),
        (0.3, 0.3),
        (-45.0, 45.0),
        static_friction=(0.0, 0.9),
        dynamic_friction=(0.0, 0.9),
        restitution=(0.0, 1.0),
    ),
    (1, 5),
)
ZONE = ZoneRule(("torus",), ((3.0, 3.0), (3.0, 3.0), (0.02, 0.02)), friction=(0.05, 0.05))
PROBE = BodyRule(
    ("sphere",),
    (0.6, 0.6),
    mass=(12.0, 12.0),
    static_friction=(0.01, 0.01),
    dynamic_friction=(0.01, 0.01),
)
PUSH = PushRule(speed=(1.0, 7.0), height=0.5, frame=(15.0, 15.0))
CAMERA = CameraRule((2.75, 2.75), (0.0, 90.0), (1.5, 2.5))
SCENERY = SceneryRule()


@dataclass(frozen=True)
class LinkParameters(StandParameters):
    """Parameters of the scenario link (docs/official-system.md, 2.1, 3.0 and 3.6).

    The stand is a base with a pole, and possibly a cap that keeps the rings on the pole. Below a
    cap the rings start lower than in the official scenes, where they may start inside it.
    """

    length: Length = 2.0
    stand: StandRule = STAND
    stack: FilledStackRule = LINKS
    choice: Counts = (0, 50)
    zone: ZoneRule = ZONE
    probe: BodyRule = PROBE
    push: PushRule = PUSH
    monochrome: bool = True
    room: Room = "box"
    camera: CameraRule = CAMERA
    scenery: SceneryRule = SCENERY


@scenario("link", LinkParameters)
def sample(params: LinkParameters, seed: np.random.SeedSequence) -> Scene:
    """Sample rings on a pole in the middle of a ring or plate, and a ball at -x pushed at it."""
    return sample_standing("link", params, seed, STAND_COLOR, STAND_COLOR)
