"""What is drawn for the bodies and pushes of a scenario, said in the same words in all of them."""

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
    """How a body that moves is drawn (defaults: section 2.1 of docs/official-system.md).

    - ``shapes``: one of these, each as likely. ``scale``: metres at unit size.
    - ``turn_deg``: about the upright, or about three axes. ``mass``: kg. With ``tumbled`` a single
      range gives one angle for all three axes, as the probes of the official Roll have.
    - ``static_friction``, ``dynamic_friction``: drawn apart, but static is never below dynamic
      (officially it may be), so that their ranges must meet. ``restitution``: 0 to 1.
    - ``textures``: material names or families.
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
        """What is wrong with values that are good one by one, or None."""
        most, least = self.static_friction[1], self.dynamic_friction[0]
        if most >= least:
            return None
        return (
            f"static_friction is at most {most:g} and dynamic_friction at least {least:g}; static "
            "friction is never below dynamic friction"
        )


@dataclass(frozen=True)
class ZoneRule:
    """How the patient, a flat body that never moves, is drawn.

    ``center`` is where its middle stands, metres, relative to the place that the scenario gives
    it. ``friction`` is the dynamic one; static friction is ten times as large.
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

    - ``speed``: metres per second that the push would give a free body: impulse over mass.
    - ``heading_deg``: away from +x, towards +y. ``rise``: vertical over horizontal part.
    - ``height``: where it acts, as a share of the probe's scale above its pivot.
    - ``point_jitter``: metres by which that point is off in each direction, at most. Officially
      it may lie outside the body, which gives it a spin that nobody controls.
    - ``frame``: when; the last is left out.
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
    """A body of ``rule`` with its pivot at ``position``."""
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


def raised_to_floor(body: Body) -> Body:
    """The body, raised if any of it is under the floor: turned ones reach below their pivot."""
    missing = max(0.0, -float(world_bounds(body)[0, 2]))
    x, y, z = body.position
    return replace(body, position=(x, y, z + missing))


def require_apart(one: Body, other: Body) -> None:
    """Raise `BadSceneError` where the boxes round two bodies share room at the start."""
    low, high = np.array([world_bounds(body) for body in (one, other)]).transpose(1, 0, 2)
    if (low.max(axis=0) < high.min(axis=0)).all():
        raise BadSceneError(
            f"{one.name} and {other.name} would start inside each other: make the scene longer or "
            "the bodies smaller"
        )


def draw_zone(
    rng: np.random.Generator, rule: ZoneRule, look: Look, position: tuple[float, float] = (0.0, 0.0)
) -> Body:
    """The patient called ``zone``, on the floor at ``place`` plus the rule's own centre."""
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
    """A push on ``body``; its heading is turned by ``turn`` radians.

    The point is at most as high as the body's own top: flat shapes are not pushed in the air.
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
