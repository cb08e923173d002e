"""Contain: a ball hits a container; does an object in it fall onto the plate around it?"""

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

ATTACHMENT_COLOR: Vec3 = (0.8, 0.8, 0.8)

STAND = StandRule(
    BodyRule(("bowl",), (0.5, 1.0), mass=(2.0, 3.0), textures=("wood_ash",)),
    False,
    BodyRule(("bowl",), (0.6, 0.6), mass=(3.0, 3.0), textures=("wood_ash",)),
)
CONTAINED = FilledStackRule(
    BodyRule(
        ("sphere",),
        (0.2, 0.4),
        (-45.0, 45.0),
        static_friction=(0.0, 0.9),
        dynamic_friction=(0.0, 0.9),
        restitution=(0.0, 1.0),
    ),
    (1, 3),
    jitter=0.2,
)
ZONE = ZoneRule(scale=((3.0, 3.0), (3.0, 3.0), (0.01, 0.01)))
PROBE = BodyRule(
    ("sphere",),
    (0.3, 0.3),
    mass=(3.0, 3.0),
    static_friction=(0.01, 0.01),
    dynamic_friction=(0.01, 0.01),
)
PUSH = PushRule(speed=(4.0, 9.0), height=0.5, frame=(15.0, 15.0))
CAMERA = CameraRule((3.0, 3.0), (0.0, 90.0), (1.5, 2.5))
SCENERY = SceneryRule()


@dataclass(frozen=True)
class ContainParameters(StandParameters):
    """Parameters of the scenario contain (docs/official-system.md, 2.1, 3.0 and 3.4).

    The stand is the container, and a second one on it if ``attached``.
    """

    length: Length = 2.0
    stand: StandRule = STAND
    stack: FilledStackRule = CONTAINED
    choice: Counts = (0, 50)
    zone: ZoneRule = ZONE
    probe: BodyRule = PROBE
    push: PushRule = PUSH
    monochrome: bool = False
    room: Room = "box"
    camera: CameraRule = CAMERA
    scenery: SceneryRule = SCENERY


@scenario("contain", ContainParameters)
def sample(params: ContainParameters, seed: np.random.SeedSequence) -> Scene:
    """Sample a container in the middle of a plate or ring, and a ball at -x pushed towards it."""
    return sample_standing("contain", params, seed, None, ATTACHMENT_COLOR)
