"""Stacks of bodies, the stands that carry them, and masses proportional to volume."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from physion.numerics.linear_algebra import norm
from physion.scenes.sampling.build import Palette, move_up
from physion.scenes.sampling.clearance import GAP, raise_above
from physion.scenes.sampling.parameters import (
    LEAST_MASS,
    Counts,
    CountsFromOne,
    Fraction,
    Slope,
    draw_count,
    uniform,
)
from physion.scenes.sampling.rules import BodyRule, draw_body
from physion.scenes.scene import Body, Joint, Look
from physion.scenes.shapes.primitives import shape
from physion.scenes.shapes.props import NATURAL_SIZES

UNIT_VOLUME = 0.125
"""Volume of the cube with sides of 0.5 m whose mass the rules give, cubic metres."""
SMALLEST = 0.05
"""Smallest side of a body in a stack with a gradient, metres. Officially there is no limit."""
ATTACHMENT_MASS_FACTORS = {"cylinder": math.pi / 4, "cone": math.pi / 12}
"""Mass of an attachment relative to that of its bounding box. In the official command logs the mass
of every other body is that of its bounding box, whatever its shape."""
CONE_RISE = 0.25
"""Bodies on a cone start higher by this factor times the cone's diagonal over its height."""
OPEN_BELOW = ("pipe", "torus")
"""Shapes of a base that are open below, so that bodies inside stand on the floor."""


PLAIN = BodyRule()


@dataclass(frozen=True)
class StackRule:
    """How a stack of bodies is drawn (docs/official-system.md, 3.2).

    - ``member``: rule of each body. Its ``mass`` is that of a cube with sides of 0.5 m; the mass of
      the body is proportional to the product of its scales.
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

    Masses are those of a cube with sides of 0.5 m, as in `StackRule`. The scale of a prop is a
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

    ``body.mass`` is that of a cube of `UNIT_VOLUME`; the result is multiplied by ``factor``.
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
