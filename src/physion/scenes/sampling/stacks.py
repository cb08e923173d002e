"""Bodies that stand on one another: stacks, what they stand on, and masses by volume."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from physion.numerics.linear_algebra import norm
from physion.scenes.sampling.build import Palette, raised
from physion.scenes.sampling.clearance import GAP, raised_clear_of
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
"""Cubic metres of the cube of 0.5 m a side whose mass the rules give."""
SMALLEST = 0.05
"""Metres: the smallest side that a gradient leaves. Officially blocks shrink to nothing."""
ATTACHMENT_SHARES = {"cylinder": math.pi / 4, "cone": math.pi / 12}
"""By how much attachments are lighter than their bounding boxes. In the official command logs no
other body is, whatever its shape."""
CONE_RISE = 0.25
"""What stands on a cone starts higher by this times the cone's diagonal over its height."""
OPEN_BELOW = ("pipe", "torus")
"""Bases in which things stand on the floor."""


PLAIN = BodyRule()


@dataclass(frozen=True)
class StackRule:
    """How bodies that stand on one another are drawn (docs/official-system.md, 3.2).

    - ``member``: each body; its ``mass`` is that of a cube of 0.5 m a side, and is multiplied with
      the product of the body's scales over that of the cube's.
    - ``count``: how many. ``gradient``: metres by which each body is smaller than that below.
    - ``jitter``: how far aside a body stands along x and y, at most, as a share of its scale.
    """

    member: BodyRule = PLAIN
    count: Counts = (2, 2)
    gradient: Slope = 0.0
    jitter: Fraction = 0.0


@dataclass(frozen=True)
class FilledStackRule(StackRule):
    """A `StackRule` of at least one body: the agent is one of them."""

    count: CountsFromOne = (2, 2)


@dataclass(frozen=True)
class StandRule:
    """What a stack stands on or in (docs/official-system.md, 3.4 and 3.6).

    - ``base``: the lowest body. ``attachment``: one on its top, if ``attached``.
    - ``joined``: base and attachment are held together, and attachment and cap.
    - ``capped``: another body of the kind of ``base`` is on top of the attachment.

    Masses are those of a cube of 0.5 m a side, as in `StackRule`. The scale of a prop is a multiple
    of its natural size.
    """

    base: BodyRule = PLAIN
    attached: bool = False
    attachment: BodyRule = PLAIN
    joined: bool = False
    capped: bool = False


@dataclass(frozen=True)
class Stand:
    """A drawn stand.

    ``holders`` are the base and, where there is one, the attachment. ``top`` is the height in
    metres at which the base ends, ``start`` that at which a stack officially starts.
    """

    holders: tuple[Body, ...]
    cap: Body | None
    joints: tuple[Joint, ...]
    top: float
    start: float

    @property
    def bodies(self) -> tuple[Body, ...]:
        """All bodies of the stand."""
        return self.holders if self.cap is None else (*self.holders, self.cap)


def with_mass_by_volume(body: Body, share: float = 1.0) -> Body:
    """The body with a ``share`` of its mass by volume, ``body.mass`` being that of the unit.

    It keeps the least mass that a body may have.
    """
    mass = body.mass * math.prod(body.scale) / UNIT_VOLUME * share
    return replace(body, mass=max(mass, LEAST_MASS))


def top_height(body: Body) -> float:
    """Height in metres of the top of an upright body."""
    return body.position[2] + float(shape(body.shape).bounds[1, 2]) * body.scale[2]


def draw_looks(
    rng: np.random.Generator, rule: StackRule, palette: Palette, monochrome: bool
) -> list[Look]:
    """The looks of a stack's bodies, and so how many there are."""
    textures = rule.member.textures
    return [palette.look(textures, monochrome) for _ in range(draw_count(rng, rule.count))]


def draw_stack(
    rng: np.random.Generator,
    rule: StackRule,
    start: float,
    obstacles: Sequence[Body],
    looks: Sequence[Look],
    name: str,
    mass_share: float = 1.0,
) -> list[Body]:
    """One body for each of ``looks``, the lowest at height ``start``.

    They are called ``name`` and a number, from below. A body that would start inside one of the
    ``obstacles`` is put above it, and what stands on it as much higher.
    """
    bodies: list[Body] = []
    for i, look in enumerate(looks):
        body = draw_body(rng, rule.member, f"{name}_{i}", (0.0, 0.0, start), look)
        grown = rule.gradient * (len(looks) / 2 - i)
        x, y, z = (max(side + grown, SMALLEST) for side in body.scale)
        right, ahead = (side * uniform(rng, (-rule.jitter, rule.jitter)) for side in (x, y))
        body = replace(body, scale=(x, y, z), position=(right, ahead, start))
        body = raised_clear_of(with_mass_by_volume(body, mass_share), (*obstacles, *bodies))
        bodies.append(body)
        start = top_height(body)
    return bodies


def draw_stand(
    rng: np.random.Generator, rule: StandRule, zone: Body, base_look: Look, attachment_look: Look
) -> Stand:
    """A base in the middle of the scene, with what ``rule`` puts on it."""
    base = with_mass_by_volume(_draw_part(rng, rule.base, "base", 0.0, base_look))
    through = base.shape in OPEN_BELOW
    height = 0.0 if through else top_height(base)
    base = raised_clear_of(base, (zone,))
    top = base.position[2] if through else top_height(base)
    start = height + zone.scale[2]
    if not rule.attached:
        return Stand((base,), None, (), top, start)
    pole = _draw_part(rng, rule.attachment, "attachment", top, attachment_look)
    pole = raised_clear_of(
        with_mass_by_volume(pole, ATTACHMENT_SHARES.get(pole.shape, 1.0)), (zone, base)
    )
    joints = [Joint("base", "attachment")] if rule.joined else []
    if pole.shape == "cone":
        start += CONE_RISE * float(norm(pole.scale[:2])) / pole.scale[2]
    if not rule.capped:
        return Stand((base, pole), None, tuple(joints), top, start)
    cap = with_mass_by_volume(_draw_part(rng, rule.base, "cap", top_height(pole), base_look))
    joints += [Joint("attachment", "cap")] if rule.joined else []
    # Officially the cap raises the stack as if it were a second base.
    start += top_height(cap) - cap.position[2]
    return Stand((base, pole), cap, tuple(joints), top, start)


def lowered_under_cap(stack: Sequence[Body], stand: Stand) -> list[Body] | None:
    """The stack, as low as it must be to end below the cap; None if it does not fit there."""
    if stand.cap is None or not stack:
        return list(stack)
    above = max(top_height(stack[-1]) + GAP - stand.cap.position[2], 0.0)
    low = stack[0].position[2] - above
    return [raised(body, -above) for body in stack] if low >= stand.top else None


def choose_position(rng: np.random.Generator, count: int, choice: tuple[int, int]) -> int:
    """One of ``count`` positions, within ``choice`` as far as there are such, else the highest."""
    allowed = range(count)[choice[0] : choice[1] + 1]
    at = int(rng.integers(max(len(allowed), 1)))
    return allowed[at] if allowed else count - 1


def _draw_part(
    rng: np.random.Generator, rule: BodyRule, name: str, height: float, look: Look
) -> Body:
    body = draw_body(rng, rule, name, (0.0, 0.0, height), look)
    if not body.shape.startswith("prop:"):
        return body
    size = NATURAL_SIZES[body.shape.removeprefix("prop:")]
    x, y, z = (side * natural for side, natural in zip(body.scale, size, strict=True))
    return replace(body, scale=(x, y, z))
