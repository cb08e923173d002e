"""Stacks of bodies and the stands that carry them, as in support, contain and link.

Bodies are raised until they overlap no other (`raise_above`); a shape is represented by its convex
pieces, as in collisions. Masses are proportional to volumes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from physion.core.seeds import child_generator
from physion.numerics.elementary import cos, sin, tan
from physion.numerics.linear_algebra import apply, inverse, multiply, norm
from physion.numerics.rotations import rotate_vectors
from physion.scenes.sampling.build import Palette, build_scene, move_up
from physion.scenes.sampling.parameters import (
    LEAST_MASS,
    Counts,
    CountsFromOne,
    Fraction,
    Length,
    Room,
    Slope,
    draw_count,
    retry,
    uniform,
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
    world_bounds,
)
from physion.scenes.scene import Body, Joint, Look, Roles, Scene, Vec3
from physion.scenes.shapes.meshes import Points
from physion.scenes.shapes.primitives import shape
from physion.scenes.shapes.props import NATURAL_SIZES

# Tests for overlap of bodies, and the height by which a body must be raised to avoid one.

GAP = 0.001
"""Gap left below a body that had to be raised, metres."""
TOUCH = 1e-6
"""Overlaps smaller than this (metres) count as touching."""
EXACT = 1e-12
"""Distances to a plane smaller than this (metres) are rounding errors."""
DEEP = 1e6
"""Depth (metres) of the three starting corners in `_rise`, below every body."""
MAX_EXCHANGES = 200


def _slope_grid() -> Points:
    angles = 2 * np.pi * np.arange(16) / 16
    slopes = tan(np.radians([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 87.0, 89.5]))
    directions = np.stack([cos(angles), sin(angles)], axis=1)
    return np.asarray((slopes[:, None, None] * directions).reshape(-1, 2))


SLOPES = _slope_grid()
"""(K, 2): slopes along x and y, up to nearly upright."""


def raise_above(body: Body, obstacles: Sequence[Body]) -> Body:
    """Return the body, raised above all ``obstacles`` that it would start in or under."""
    rise = required_rise(body, obstacles)
    return move_up(body, rise + GAP) if rise > 0 else body


def required_rise(body: Body, obstacles: Sequence[Body]) -> float:
    """Return by how many metres ``body`` must rise until no obstacle is inside or above it."""
    (x0, y0, bottom), (x1, y1, _) = world_bounds(body)
    parts = _corners(body)
    pairs = []
    for obstacle in obstacles:
        low, high = world_bounds(obstacle)
        if high[2] <= bottom + TOUCH or high[0] <= x0 or high[1] <= y0:
            continue
        if low[0] >= x1 or low[1] >= y1:
            continue
        pairs += [(_rough_rise(u, part), u, part) for u in _corners(obstacle) for part in parts]
    need = 0.0
    for rough, under, part in sorted(pairs, key=lambda pair: -pair[0]):
        if rough <= need + TOUCH:
            break
        need = max(need, _rise(under, part))
    return need


def is_clear_of(body: Body, others: Sequence[Body]) -> bool:
    """Return whether the bounding box of ``body`` in x and y overlaps none of theirs."""
    low, high = world_bounds(body)
    boxes = [world_bounds(other) for other in others]
    return all((high[:2] < b[0, :2]).any() or (low[:2] > b[1, :2]).any() for b in boxes)


def _corners(body: Body) -> list[Points]:
    """Return the corners (K, 3) of each convex piece in world coordinates."""
    offset = np.array(body.position)
    return [
        rotate_vectors(body.rotation, piece * body.scale) + offset
        for piece in _unit_corners(body.shape)
    ]


@cache
def _unit_corners(name: str) -> tuple[Points, ...]:
    return tuple(piece.mesh.vertices for piece in shape(name).pieces)


def _rough_rise(under: Points, part: Points) -> float:
    """Return an upper bound of the height by which ``part`` must rise to be above ``under``.

    Consider a plane z = u x + v y + c. It lies above all of ``under`` and below all of the risen
    ``part`` if the rise is max(z - u x - v y) over ``under`` plus max(u x + v y - z) over ``part``.
    The minimum over all slopes (u, v) is exact (`_rise`); over a grid of slopes it is a bound.
    """
    over = (under[:, 2:] - multiply(under[:, :2], SLOPES.T)).max(axis=0)
    return float((over + (multiply(part[:, :2], SLOPES.T) - part[:, 2:]).max(axis=0)).min())


def _rise(under: Points, part: Points) -> float:
    """Return the exact rise (see `_rough_rise`); minus infinity if the footprints do not overlap.

    The differences between points of ``under`` and points of ``part`` form a convex body, and the
    rise is the height at which the z axis leaves this body at the top. The simplex method finds
    it: three differences form a triangle around the axis; in each step one corner is exchanged for
    the difference farthest above the plane of the triangle, until none is above.
    """
    corners = np.array([[1.0, 0.0, -DEEP], [-0.5, 0.75, -DEEP], [-0.5, -0.75, -DEEP]])
    for _ in range(MAX_EXCHANGES):
        # Row i gives the barycentric weight of corner i at the point (x, y, 1); weights sum to 1.
        weights = inverse(np.vstack([corners[:, :2].T, np.ones(3)]))
        u, v, height = apply(weights.T, corners[:, 2])
        over = under[:, 2] - u * under[:, 0] - v * under[:, 1]
        below = part[:, 2] - u * part[:, 0] - v * part[:, 1]
        top, bottom = over.argmax(), below.argmin()
        rise = float(over[top] - below[bottom])
        if rise <= height + EXACT * norm((u, v, 1.0)):
            return -np.inf if (corners[:, 2] == -DEEP).any() else rise
        farthest = under[top] - part[bottom]
        step = apply(weights, (farthest[0], farthest[1], 1.0))
        # Exchange the corner whose weight at the origin reaches zero first.
        at_origin = np.maximum(weights[:, 2], 0.0)
        limits = np.divide(at_origin, step, out=np.full(3, np.inf), where=step > 1e-12)
        corners[limits.argmin()] = farthest
    return _rough_rise(under, part)


UNIT_VOLUME = 0.125
"""Volume of the cube with sides of 0.5 m whose mass the rules give, cubic metres."""
SMALLEST = 0.05
"""Smallest side of a body in a stack with a gradient, metres. Officially there is no limit."""
ATTACHMENT_MASS_FACTORS = {"cylinder": math.pi / 4, "cone": math.pi / 12}
"""Mass of an attachment relative to a solid bounding box. In the official command logs the mass
of every other body is the mass of its bounding box, whatever its shape."""
CONE_RISE = 0.25
"""Bodies on a cone start higher by this factor times the cone's diagonal over its height."""
OPEN_BELOW = ("pipe", "torus")
"""Shapes of a base that are open below, so that bodies inside stand on the floor."""


PLAIN = BodyRule()


@dataclass(frozen=True)
class StackRule:
    """How a stack of bodies is drawn (docs/official-system.md, 3.2).

    - ``member``: rule of each body. Its ``mass`` is the mass of a cube with sides of 0.5 m; the
      mass of the body is proportional to the product of its scales.
    - ``count``: number of bodies. ``gradient``: metres by which each is smaller than the one below.
    - ``jitter``: largest displacement along x and y, as a fraction of the scale.
    """

    member: BodyRule = PLAIN
    count: Counts = (2, 2)
    gradient: Slope = 0.0
    jitter: Fraction = 0.0


@dataclass(frozen=True)
class FilledStackRule(StackRule):
    """`StackRule` of at least one body, since one of them is the agent."""

    count: CountsFromOne = (2, 2)


@dataclass(frozen=True)
class StandRule:
    """How the stand is drawn on or in which a stack stands (docs/official-system.md, 3.4 and 3.6).

    - ``base``: the lowest body. ``attached``: there is an ``attachment`` on its top.
    - ``joined``: base, attachment and cap are connected rigidly.
    - ``capped``: a second body drawn by ``base`` is on top of the attachment.

    Masses are for a cube with sides of 0.5 m, as in `StackRule`. The scale of a prop is a
    multiple of its natural size.
    """

    base: BodyRule = PLAIN
    attached: bool = False
    attachment: BodyRule = PLAIN
    joined: bool = False
    capped: bool = False


@dataclass(frozen=True)
class Stand:
    """Bodies of a stand.

    - ``holders``: the base and, if there is one, the attachment. ``cap``: the body on top.
    - ``top``: height of the upper end of the base, metres.
    - ``start``: height at which a stack starts in the official scenes, metres.
    """

    holders: tuple[Body, ...]
    cap: Body | None
    joints: tuple[Joint, ...]
    top: float
    start: float

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Return all bodies of the stand."""
        return self.holders if self.cap is None else (*self.holders, self.cap)


def set_mass_by_volume(body: Body, factor: float = 1.0) -> Body:
    """Return the body with a mass proportional to its volume, at least `LEAST_MASS`.

    ``body.mass`` is the mass of a cube of `UNIT_VOLUME`; the result is multiplied by ``factor``.
    """
    mass = body.mass * math.prod(body.scale) / UNIT_VOLUME * factor
    return replace(body, mass=max(mass, LEAST_MASS))


def height_of_top(body: Body) -> float:
    """Return the height of the top of a body that is not tilted, metres."""
    return body.position[2] + float(shape(body.shape).bounds[1, 2]) * body.scale[2]


def draw_looks(
    rng: np.random.Generator, rule: StackRule, palette: Palette, monochrome: bool
) -> list[Look]:
    """Draw the number of bodies of a stack, and a look for each."""
    textures = rule.member.textures
    return [palette.look(textures, monochrome) for _ in range(draw_count(rng, rule.count))]


def draw_stack(
    rng: np.random.Generator,
    rule: StackRule,
    start: float,
    obstacles: Sequence[Body],
    looks: Sequence[Look],
    name: str,
    mass_factor: float = 1.0,
) -> list[Body]:
    """Draw a stack with one body for each of ``looks``, from below, the lowest at height ``start``.

    Parameters
    ----------
    rng
        Random stream.
    rule
        How the bodies are drawn.
    start
        Height of the lowest pivot, metres.
    obstacles
        A body that would start inside one of these is raised above it, with all bodies on it.
    looks
        Look of each body.
    name
        Names of the bodies are this and an index: ``name_0``, ``name_1``, ...
    mass_factor
        Factor of the masses (`set_mass_by_volume`).
    """
    bodies: list[Body] = []
    for i, look in enumerate(looks):
        body = draw_body(rng, rule.member, f"{name}_{i}", (0.0, 0.0, start), look)
        grown = rule.gradient * (len(looks) / 2 - i)
        x, y, z = (max(side + grown, SMALLEST) for side in body.scale)
        right, ahead = (side * uniform(rng, (-rule.jitter, rule.jitter)) for side in (x, y))
        body = replace(body, scale=(x, y, z), position=(right, ahead, start))
        body = raise_above(set_mass_by_volume(body, mass_factor), (*obstacles, *bodies))
        bodies.append(body)
        start = height_of_top(body)
    return bodies


def draw_stand(
    rng: np.random.Generator, rule: StandRule, zone: Body, base_look: Look, attachment_look: Look
) -> Stand:
    """Draw the base in the centre of the scene, with attachment and cap if ``rule`` has them."""
    base = set_mass_by_volume(_draw_stand_body(rng, rule.base, "base", 0.0, base_look))
    through = base.shape in OPEN_BELOW
    height = 0.0 if through else height_of_top(base)
    base = raise_above(base, (zone,))
    top = base.position[2] if through else height_of_top(base)
    start = height + zone.scale[2]
    if not rule.attached:
        return Stand((base,), None, (), top, start)
    pole = _draw_stand_body(rng, rule.attachment, "attachment", top, attachment_look)
    pole = raise_above(
        set_mass_by_volume(pole, ATTACHMENT_MASS_FACTORS.get(pole.shape, 1.0)), (zone, base)
    )
    joints = [Joint("base", "attachment")] if rule.joined else []
    if pole.shape == "cone":
        start += CONE_RISE * float(norm(pole.scale[:2])) / pole.scale[2]
    if not rule.capped:
        return Stand((base, pole), None, tuple(joints), top, start)
    cap = set_mass_by_volume(
        _draw_stand_body(rng, rule.base, "cap", height_of_top(pole), base_look)
    )
    joints += [Joint("attachment", "cap")] if rule.joined else []
    # In the official code the cap raises the stack as if it were a second base.
    start += height_of_top(cap) - cap.position[2]
    return Stand((base, pole), cap, tuple(joints), top, start)


def lower_below_cap(stack: Sequence[Body], stand: Stand) -> list[Body] | None:
    """Return the stack, lowered to end below the cap if there is one; None if it does not fit."""
    if stand.cap is None or not stack:
        return list(stack)
    above = max(height_of_top(stack[-1]) + GAP - stand.cap.position[2], 0.0)
    low = stack[0].position[2] - above
    return [move_up(body, -above) for body in stack] if low >= stand.top else None


def choose_position(rng: np.random.Generator, count: int, choice: tuple[int, int]) -> int:
    """Draw an index below ``count`` in the range ``choice``; the last index if there is none."""
    allowed = range(count)[choice[0] : choice[1] + 1]
    index = int(rng.integers(max(len(allowed), 1)))
    return allowed[index] if allowed else count - 1


def _draw_stand_body(
    rng: np.random.Generator, rule: BodyRule, name: str, height: float, look: Look
) -> Body:
    body = draw_body(rng, rule, name, (0.0, 0.0, height), look)
    if not body.shape.startswith("prop:"):
        return body
    size = NATURAL_SIZES[body.shape.removeprefix("prop:")]
    x, y, z = (side * natural for side, natural in zip(body.scale, size, strict=True))
    return replace(body, scale=(x, y, z))


# Sampling shared by contain and link: a ball hits a stand that carries a stack of bodies.

TRIES = 100
MAX_FRAMES = 452
STACK_MASS = 0.25
"""Factor of the masses of the stack's bodies (docs/official-system.md, 3.4)."""


@dataclass(frozen=True)
class StandParameters:
    """Parameters of a scenario in which a ball hits a stand.

    - ``length``: metres; the probe starts at x = -length / 2, the stand is at the centre.
    - ``stand``: what carries or holds the stack.
    - ``stack``: the bodies on or in it, from below. ``choice``: indices of those that may be the
      agent (0 is the lowest), all equally likely.

    Masses of stand and stack are for a cube with sides of 0.5 m (`StackRule`), and a quarter
    of it for the stack.
    """

    length: Length
    stand: StandRule
    stack: FilledStackRule
    choice: Counts
    zone: ZoneRule
    probe: BodyRule
    push: PushRule
    monochrome: bool
    room: Room
    camera: CameraRule
    scenery: SceneryRule


@dataclass
class _DrawnStand:
    stand: Stand
    stack: list[Body]
    probe: Body


def sample_standing(
    scenario: str,
    params: StandParameters,
    seed: np.random.SeedSequence,
    base_color: Vec3 | None,
    attachment_color: Vec3,
) -> Scene:
    """Sample a stand in the centre, a stack in or on it, and a ball at -x pushed towards its foot.

    ``base_color`` and ``attachment_color`` are fixed in the official configurations; None draws
    the colour.
    """
    rng, palette = child_generator(seed, "placement"), Palette.of(seed)
    member = params.stack.member
    agent_look = palette.agent_look(member.textures)
    base_look = _set_look_color(palette.look(params.stand.base.textures), base_color)
    attachment_look = _set_look_color(
        palette.look(params.stand.attachment.textures), attachment_color
    )
    probe_look = palette.look(params.probe.textures)
    zone = draw_zone(rng, params.zone, palette.look(params.zone.textures))
    looks = draw_looks(rng, params.stack, palette, params.monochrome)
    agent = choose_position(rng, len(looks), params.choice)
    looks[agent] = agent_look
    push_rng = child_generator(seed, "push")
    drawn: list[_DrawnStand] = []

    def attempt() -> str | None:
        stand = draw_stand(rng, params.stand, zone, base_look, attachment_look)
        obstacles = (zone, *stand.holders)
        stack = draw_stack(rng, params.stack, stand.start, obstacles, looks, "member", STACK_MASS)
        fitting = lower_below_cap(stack, stand)
        start = (-params.length / 2, 0.0, 0.0)
        probe = draw_body(push_rng, params.probe, "probe", start, probe_look, angular_drag=0.0)
        probe = raise_above(probe, (zone,))
        if fitting is None:
            return "the stack does not fit under the cap"
        if not is_clear_of(probe, (*stand.bodies, *fitting)):
            return "the probe would start inside the stand"
        drawn.append(_DrawnStand(stand, fitting, probe))
        return None

    retry(TRIES, scenario, attempt)
    result = drawn[0]
    target = replace(result.stack[agent], name="target")
    others = [body for i, body in enumerate(result.stack) if i != agent]
    return build_scene(
        scenario,
        seed,
        params,
        bodies=(zone, target, result.probe, *result.stand.bodies, *others),
        roles=Roles("target", "zone", "probe"),
        max_frames=MAX_FRAMES,
        aim_height=height_of_top(result.stack[-1]) / 2,
        pushes=(draw_push(push_rng, params.push, result.probe),),
        joints=result.stand.joints,
    )


def _set_look_color(look: Look, color: Vec3 | None) -> Look:
    return look if color is None else replace(look, color=color)
