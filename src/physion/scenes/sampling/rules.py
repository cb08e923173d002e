"""Rules by which all scenarios draw bodies, zones and pushes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from physion.errors import BadSceneError
from physion.numerics.elementary import cos, sin
from physion.scenes.sampling.parameters import (
    Angles,
    EarlyFrames,
    FloorPosition,
    Fractions,
    Frictions,
    Length,
    Masses,
    Materials,
    Multiple,
    Multiples,
    Rotations,
    Shapes,
    Sizes,
    Speeds,
    draw_axes,
    draw_frame,
    draw_rotation,
    euler_rotation,
    is_range,
    pick,
    uniform,
)
from physion.scenes.sampling.placement import world_bounds
from physion.scenes.scene import Body, Look, Push, SurfaceMaterial, Vec3
from physion.scenes.shapes.primitives import shape

STATIC_OVER_DYNAMIC = 10.0
"""Static over dynamic friction of a zone (docs/official-system.md, section 1)."""


@dataclass(frozen=True)
class BodyRule:
    """How a moving body is drawn (defaults: docs/official-system.md, section 2.1).

    - ``shapes``: one of these, all equally likely. ``scale``: factor of the unit shape (metres for
      shapes of unit size). ``mass``: kg.
    - ``turn_deg``: rotation about z, or about three axes. With ``tumbled`` a single range gives one
      angle that is used for all three axes, as for the probes of the official Roll.
    - ``static_friction``, ``dynamic_friction``: drawn independently, but static is raised to
      dynamic if it is lower (officially it is not). ``restitution``: 0 to 1.
    - ``textures``: names of materials or families.
    """

    shapes: Shapes = ("cube",)
    scale: Sizes = (1.0, 1.0)
    turn_deg: Rotations = (0.0, 0.0)
    tumbled: bool = False
    mass: Masses = (2.0, 2.0)
    static_friction: Frictions = (0.5, 0.5)
    dynamic_friction: Frictions = (0.5, 0.5)
    restitution: Fractions = (0.0, 0.0)
    textures: Materials = ("wood_cedar",)

    def check_values(self) -> str | None:
        """Return which values contradict each other, or None."""
        most, least = self.static_friction[1], self.dynamic_friction[0]
        if most >= least:
            return None
        return (
            f"static_friction is at most {most:g} and dynamic_friction at least {least:g}; static "
            "friction must be able to reach dynamic friction"
        )


@dataclass(frozen=True)
class ZoneRule:
    """How the zone is drawn: the patient of most scenarios, a flat body that never moves.

    ``center`` is an offset (metres) of its position in the scenario. ``friction`` is the dynamic
    friction; static friction is ten times as large.
    """

    shapes: Shapes = ("cube",)
    scale: Sizes = ((0.5, 0.5), (2.0, 2.0), (0.01, 0.01))
    center: FloorPosition = (0.0, 0.0)
    friction: Frictions = (0.1, 0.1)
    mass: Masses = (500.0, 500.0)
    textures: Materials = ("wood_ash",)


@dataclass(frozen=True)
class PushRule:
    """How the probe is pushed.

    - ``speed``: impulse over mass, the change of velocity of a free body, m/s.
    - ``heading_deg``: direction, from +x towards +y. ``rise``: ratio of the vertical to the
      horizontal part.
    - ``height``: height of the point of action above the pivot, as a fraction of the scale.
    - ``point_jitter``: largest displacement of this point along each axis, metres. Officially the
      point may lie outside the body, which then spins in an uncontrolled way.
    - ``frame``: the frame after which it acts; the last of the range is never drawn.
    """

    speed: Speeds = (1.0, 1.0)
    heading_deg: Angles = (0.0, 0.0)
    rise: Multiples = (0.0, 0.0)
    height: Multiple = 0.8
    point_jitter: Length = 0.0
    frame: EarlyFrames = (0.0, 0.0)


def draw_body(
    rng: np.random.Generator,
    rule: BodyRule,
    name: str,
    position: Vec3,
    look: Look,
    *,
    angular_drag: float = 0.05,
) -> Body:
    """Draw a body by ``rule``, with its pivot at ``position``."""
    kind, scale = pick(rng, rule.shapes), draw_axes(rng, rule.scale)
    if rule.tumbled and is_range(rule.turn_deg):
        rotation = euler_rotation(*draw_axes(rng, rule.turn_deg))
    else:
        rotation = draw_rotation(rng, rule.turn_deg)
    mass = uniform(rng, rule.mass)
    dynamic = uniform(rng, rule.dynamic_friction)
    static = max(uniform(rng, rule.static_friction), dynamic)
    material = SurfaceMaterial(static, dynamic, uniform(rng, rule.restitution))
    return Body(
        name, kind, position, scale, rotation, mass, material, angular_drag=angular_drag, look=look
    )


def raise_to_floor(body: Body) -> Body:
    """Return the body, raised if a part of it is below the floor (rotated bodies may be)."""
    missing = max(0.0, -float(world_bounds(body)[0, 2]))
    x, y, z = body.position
    return replace(body, position=(x, y, z + missing))


def require_apart(one: Body, other: Body) -> None:
    """Raise `BadSceneError` if the bounding boxes of two bodies overlap."""
    low, high = np.array([world_bounds(body) for body in (one, other)]).transpose(1, 0, 2)
    if (low.max(axis=0) < high.min(axis=0)).all():
        raise BadSceneError(
            f"{one.name} and {other.name} would start inside each other: increase the length of "
            "the scene or make the bodies smaller"
        )


def draw_zone(
    rng: np.random.Generator, rule: ZoneRule, look: Look, position: tuple[float, float] = (0.0, 0.0)
) -> Body:
    """Draw the patient ``zone``, on the floor at ``position`` plus the rule's ``center``."""
    kind, scale = pick(rng, rule.shapes), draw_axes(rng, rule.scale)
    friction = uniform(rng, rule.friction)
    return Body(
        "zone",
        kind,
        (position[0] + rule.center[0], position[1] + rule.center[1], 0.0),
        scale,
        mass=uniform(rng, rule.mass),
        contact=SurfaceMaterial(STATIC_OVER_DYNAMIC * friction, friction, 0.0),
        kinematic=True,
        look=look,
    )


def draw_push(rng: np.random.Generator, rule: PushRule, body: Body, rotation: float = 0.0) -> Push:
    """Draw a push on ``body``; its heading is rotated by ``rotation`` radians about z.

    The point of action is at most as high as the top of the body.
    """
    speed, rise = uniform(rng, rule.speed), uniform(rng, rule.rise)
    heading = math.radians(uniform(rng, rule.heading_deg)) + rotation
    right, ahead, up = draw_axes(rng, ((-rule.point_jitter, rule.point_jitter),) * 3)
    frame = draw_frame(rng, rule.frame)
    height = min(rule.height, float(shape(body.shape).bounds[1, 2])) * body.scale[2]
    impulse = speed * body.mass
    x, y, z = body.position
    return Push(
        body.name,
        (impulse * cos(heading), impulse * sin(heading), impulse * rise),
        (x + right, y + ahead, z + height + up),
        frame,
    )
