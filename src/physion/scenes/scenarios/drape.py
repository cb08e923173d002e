"""Drape: a cloth falls over objects; does it touch the zone between them?"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, NamedTuple

import numpy as np

from physion.core.seeds import child_generator
from physion.scenes.sampling.build import Palette, build_scene, scenario
from physion.scenes.sampling.parameters import (
    SMALLEST_SIDE,
    FloorPosition,
    Fraction,
    Fractions,
    Length,
    Lengths,
    Masses,
    Materials,
    Offsets,
    Props,
    Quantity,
    Range,
    Room,
    Shapes,
    Sides,
    SizeFactors,
    pick,
    retry,
    uniform,
    yaw,
)
from physion.scenes.sampling.placement import (
    CameraRule,
    SceneryRule,
    ZoneRule,
    draw_zone,
    world_bounds,
)
from physion.scenes.scene import Body, Cloth, Roles, Scene, Vec3
from physion.scenes.shapes.primitives import PREFIX
from physion.scenes.shapes.props import NATURAL_SIZES

MAX_FRAMES = 151
TRIES = 100
VERTEX_SPACING = 0.04
"""Distance between the vertices of a cloth, metres: 51 vertices for the official 2 m."""


class PropPlacement(NamedTuple):
    """Size and position on the floor (metres) of a prop, and its rotation about z."""

    size: Vec3
    position: tuple[float, float]
    angle_deg: float = 0.0


OFFICIAL_PROPS = {
    "floor_lamp": PropPlacement((0.613, 0.503, 1.286), (0.058, -1.098)),
    "sculpture": PropPlacement((1.387, 1.414, 1.121), (0.029, -1.086)),
    "desk_lamp": PropPlacement((0.979, 0.231, 1.177), (0.187, -1.086), angle_deg=-90.0),
    "armchair": PropPlacement((0.915, 0.914, 0.833), (0.0, -1.4)),
}
"""The four props of the official scenes, with measured sizes and positions."""
DEFAULT_PROP_POSITION = (0.0, -1.1)

Frames = Annotated[int, Quantity("frames", 0, 10000)]

FAMILIES = ("wood", "metal", "plastic")
ZONE = ZoneRule(("cone",), ((0.2, 0.2), (0.2, 0.2), (0.3, 0.3)))
CAMERA = CameraRule((1.5, 2.5), (0.0, 90.0), (1.5, 2.0), mirror=0.5)
SCENERY = SceneryRule(distractor_size=(0.8, 1.2), occluder_size=(0.8, 1.2))


@dataclass(frozen=True)
class ClothRule:
    """How the cloth is drawn: a square sheet, released flat and horizontal.

    - ``size``: length of a side, metres. ``stretch``, ``bend``, ``tether``: stiffnesses (`Cloth`).
    - ``x``, ``y``, ``height``: position of the centre, metres. ``mass``: kg. ``textures``.
    """

    size: Sides = (2.0, 2.0)
    stretch: Fractions = (0.0, 1.0)
    bend: Fractions = (0.0, 1.0)
    tether: Fractions = (0.0, 1.0)
    x: Offsets = (-0.2, 0.2)
    y: Offsets = (-0.6, -0.4)
    height: Lengths = (1.3, 1.5)
    mass: Masses = (0.5, 0.5)
    textures: Materials = ("cloth",)


@dataclass(frozen=True)
class AnchorRule:
    """How the anchors are drawn: the objects on both sides that support the cloth.

    - ``shapes``; ``width`` along x and ``depth`` along y, metres; ``mass``: kg; ``textures``.
    - ``height``: metres, plus or minus up to ``height_jitter``; the right anchor is higher by
      ``taller``.
    - ``between``: x of the left and of the right anchor; each is moved outwards by up to
      ``jitter``.
    - ``extra``: probability of a third anchor. It has the height ``extra_height`` (with the same
      jitter) and stands ``extra_distance`` to the left of the left anchor with the probability
      ``extra_left``, otherwise to the right of the right anchor; then it is moved to the left by
      up to ``jitter``. (Measured on 69 official trials.)
    """

    shapes: Shapes = ("cone", "cube", "cylinder", "pyramid", "triangular_prism")
    width: Sides = (0.1, 0.3)
    depth: Sides = (0.2, 0.5)
    height: Length = 0.6
    height_jitter: Length = 0.2
    taller: Length = 0.1
    between: Offsets = (-0.4, 0.4)
    jitter: Length = 0.1
    extra: Fraction = 0.7
    extra_left: Fraction = 0.65
    extra_distance: Length = 0.5
    extra_height: Length = 0.5
    mass: Masses = (25.0, 25.0)
    textures: Materials = FAMILIES

    def check_values(self) -> str | None:
        """Return which values contradict each other, or None."""
        for key, height in (("height", self.height), ("extra_height", self.extra_height)):
            if height - self.height_jitter < SMALLEST_SIDE:
                return (
                    f"height_jitter is {self.height_jitter:g} m and {key} {height:g} m; "
                    f"their difference must be at least {SMALLEST_SIDE:g} m"
                )
        return None


@dataclass(frozen=True)
class PropRule:
    """How the large object behind the others is drawn.

    ``size`` is a factor of the official size (`OFFICIAL_PROPS`), or of the natural size of props
    that the study did not use; ``shift`` is an offset of the official position, metres.
    """

    props: Props = tuple(OFFICIAL_PROPS)
    size: SizeFactors = (1.0, 1.0)
    shift: FloorPosition = (0.0, 0.0)
    mass: Masses = (100.0, 100.0)
    textures: Materials = FAMILIES


@dataclass(frozen=True)
class DrapeParameters:
    """Parameters of the scenario drape (docs/official-system.md, 2.1, 3.0 and 3.8).

    Defaults are the official rules, with average values of what differs between configurations.

    - ``zone_share``: position of the zone as a fraction of the way from the right anchor to the
      left one. ``zone_y``: metres.
    - ``settle_frames``: see `Scene`. Bodies never move, since cloth does not push them.
    """

    cloth: ClothRule = ClothRule()
    anchors: AnchorRule = AnchorRule()
    zone: ZoneRule = ZONE
    zone_share: Fractions = (0.2, 0.8)
    zone_y: Offsets = (-0.2, 0.4)
    prop: PropRule = PropRule()
    settle_frames: Frames = 100
    room: Room = "box"
    camera: CameraRule = CAMERA
    scenery: SceneryRule = SCENERY


@scenario("drape", DrapeParameters)
def sample(params: DrapeParameters, seed: np.random.SeedSequence) -> Scene:
    """Sample a cloth above anchors along x, with the zone between them and a prop behind."""
    palette = Palette.of(seed)
    cloth = _draw_cloth(params.cloth, child_generator(seed, "cloth"), palette)
    prop = _draw_prop(params.prop, child_generator(seed, "prop"), palette)
    anchors = _draw_anchors(params.anchors, child_generator(seed, "anchors"), palette, prop)
    zone = _draw_zone(params, child_generator(seed, "placement"), palette, (prop, *anchors))
    sheet = Body(cloth.name, "cube", cloth.position, (cloth.size[0], cloth.size[1], 0.01))
    bodies = (zone, *anchors, prop)
    return build_scene(
        "drape",
        seed,
        params,
        bodies=bodies,
        cloths=(cloth,),
        roles=Roles("cloth", "zone"),
        max_frames=MAX_FRAMES,
        seen=(zone, sheet),
        around=(*bodies, sheet),
        settle_frames=params.settle_frames,
    )


def _draw_cloth(rule: ClothRule, rng: np.random.Generator, palette: Palette) -> Cloth:
    size = uniform(rng, rule.size)
    return Cloth(
        "cloth",
        (uniform(rng, rule.x), uniform(rng, rule.y), uniform(rng, rule.height)),
        (size, size, 0.0),
        mass=uniform(rng, rule.mass),
        resolution=max(2, round(size / VERTEX_SPACING) + 1),
        stretch=uniform(rng, rule.stretch),
        bend=uniform(rng, rule.bend),
        tether=uniform(rng, rule.tether),
        look=palette.agent_look(rule.textures),
    )


def _draw_prop(rule: PropRule, rng: np.random.Generator, palette: Palette) -> Body:
    name = pick(rng, rule.props)
    official = OFFICIAL_PROPS.get(name, PropPlacement(NATURAL_SIZES[name], DEFAULT_PROP_POSITION))
    factor = uniform(rng, rule.size)
    width, depth, height = (side * factor for side in official.size)
    across = official.angle_deg % 180 != 0
    return Body(
        "prop",
        PREFIX + name,
        (official.position[0] + rule.shift[0], official.position[1] + rule.shift[1], 0.0),
        (depth, width, height) if across else (width, depth, height),
        yaw(math.radians(official.angle_deg)),
        mass=uniform(rng, rule.mass),
        kinematic=True,
        look=palette.look(rule.textures),
    )


def _draw_anchors(
    rule: AnchorRule, rng: np.random.Generator, palette: Palette, prop: Body
) -> list[Body]:
    """Draw the left and the right anchor, and possibly the third."""
    left, right = rule.between
    rightwards, leftwards = (0.0, rule.jitter), (-rule.jitter, 0.0)
    wanted = [
        ("anchor_left", left, leftwards, rule.height),
        ("anchor_right", right, rightwards, rule.height + rule.taller),
    ]
    if rng.random() < rule.extra:
        aside = rng.random() < rule.extra_left
        x = left - rule.extra_distance if aside else right + rule.extra_distance
        wanted.append(("anchor_extra", x, leftwards, rule.extra_height))
    placed: list[Body] = []
    for name, x, jitter, height in wanted:
        draw = partial(_anchor, rule, rng, name, x, jitter, height)
        placed.append(_draw_apart(name, (prop, *placed), draw))
    return [replace(anchor, look=palette.look(rule.textures)) for anchor in placed]


def _anchor(
    rule: AnchorRule,
    rng: np.random.Generator,
    name: str,
    x: float,
    jitter: Range,
    height: float,
) -> Body:
    height += uniform(rng, (-rule.height_jitter, rule.height_jitter))
    return Body(
        name,
        pick(rng, rule.shapes),
        (x + uniform(rng, jitter), 0.0, 0.0),
        (uniform(rng, rule.width), uniform(rng, rule.depth), height),
        mass=uniform(rng, rule.mass),
        kinematic=True,
    )


def _draw_zone(
    params: DrapeParameters, rng: np.random.Generator, palette: Palette, others: Sequence[Body]
) -> Body:
    left, right = params.anchors.between
    look = palette.look(params.zone.textures)

    def draw() -> Body:
        x = right - uniform(rng, params.zone_share) * (right - left)
        return draw_zone(rng, params.zone, look, (x, uniform(rng, params.zone_y)))

    return _draw_apart("zone", others, draw)


def _draw_apart(name: str, others: Sequence[Body], draw: Callable[[], Body]) -> Body:
    """Draw a body until its footprint overlaps none of ``others``.

    In the official scenes they may overlap, and are pushed apart while they settle.
    """
    drawn: list[Body] = []

    def attempt() -> str | None:
        drawn.append(draw())
        low, high = world_bounds(drawn[-1])[:, :2]
        for other in others:
            other_low, other_high = world_bounds(other)[:, :2]
            if (low < other_high).all() and (other_low < high).all():
                return f"it overlaps {other.name}"
        return None

    retry(TRIES, name, attempt)
    return drawn[-1]
