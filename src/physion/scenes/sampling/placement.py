"""Placement of the camera, of scenery, and of the bodies, zones and pushes of all scenarios.

Scenery are distractors behind and occluders in front of the bodies. The rules follow the official
generator (docs/official-system.md, sections 2.4 and 2.5), with one addition: a camera that does not
see agent and patient is drawn again.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.core.errors import BadSceneError
from physion.numerics.elementary import arctan2, cos, sin, tan
from physion.numerics.linear_algebra import dot, norm, ordered_mean, unit
from physion.numerics.rotations import rotate_vectors
from physion.scenes.looks import prop_look
from physion.scenes.sampling.parameters import (
    Angle,
    Angles,
    Distances,
    EarlyFrames,
    FloorPosition,
    Fraction,
    Fractions,
    Frictions,
    Length,
    Lengths,
    Masses,
    Materials,
    Multiple,
    Multiples,
    Props,
    Quantity,
    Range,
    Rotations,
    Shapes,
    Sides,
    Sizes,
    Speeds,
    draw_axes,
    draw_frame,
    draw_rotation,
    euler_rotation,
    is_range,
    pick,
    uniform,
    yaw,
)
from physion.scenes.scene import Body, Camera, Look, Push, SurfaceMaterial, Vec3
from physion.scenes.shapes.primitives import expand_props, shape
from physion.scenes.shapes.props import NATURAL_SIZES

CLEARANCE = 0.25
"""Distance between the bodies and the scenery, metres."""
CAMERA_TRIES = 200
NEAREST_OCCLUDER = 0.85
"""Largest fraction of the distance to the camera at which an occluder may stand."""

STEPS_ASIDE = (0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6)
"""Positions tried one after the other for a prop, in multiples of the angle between neighbours."""
FARTHER = (1.0, 1.5)
"""Distances at which positions are tried, as multiples of the distance drawn."""
FARTHEST_ASIDE = math.radians(80.0)
"""Largest angle from straight behind or in front, for positions more than three steps aside."""

PropCount = Annotated[int, Quantity("", 0, 12)]


@dataclass(frozen=True, slots=True)
class CameraRule:
    """How the camera is drawn.

    - ``radius``: metres; the horizontal distance from the centre is this times the square root
      of 2, since the official rule moves the camera by (radius, radius).
    - ``angle_deg``: degrees; the azimuth is this plus 45.
    - ``height``: metres above the floor. Officially it may be 2 cm, from where
      a flat zone cannot be seen.
    - ``mirror``: probability that x changes its sign (left and right are swapped).
    """

    radius: Distances = (1.75, 1.75)
    angle_deg: Angles = (45.0, 225.0)
    height: Lengths = (0.75, 2.0)
    mirror: Fraction = 0.0


@dataclass(frozen=True, slots=True)
class SceneryRule:
    """How many props stand behind (``distractors``) and in front (``occluders``), and which.

    - Distances: fractions of the camera's radius. Spacings: degrees between neighbours.
    - Sizes: metres of the largest side. ``yaw_deg``: largest rotation about z.
    - ``occlusion``: height of an occluder as a fraction of the height of the line of sight there.
    """

    distractors: PropCount = 0
    occluders: PropCount = 0
    distractor_props: Props = ("full",)
    occluder_props: Props = ("vase", "plant", "lamp", "globe")
    distractor_distance: Fractions = (0.4, 1.0)
    occluder_distance: Fractions = (0.6, 0.8)
    distractor_spacing_deg: Angle = 15.0
    occluder_spacing_deg: Angle = 10.0
    yaw_deg: Angle = 30.0
    distractor_size: Sides = (0.5, 1.5)
    occluder_size: Sides = (0.25, 1.5)
    occlusion: Fraction = 0.75


def world_corners(body: Body) -> NDArray[np.float64]:
    """Return the vertices (V, 3) of a body's mesh in world coordinates, metres."""
    corners = shape(body.shape).mesh.vertices * body.scale
    return np.asarray(rotate_vectors(body.rotation, corners) + np.array(body.position))


def world_bounds(body: Body) -> NDArray[np.float64]:
    """Return the smallest and largest world coordinates (2, 3) of a body, metres."""
    corners = world_corners(body)
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def project_to_image(camera: Camera, point: ArrayLike) -> tuple[float, float]:
    """Project ``point`` to a square image: (right, up) in -1..1, infinite if out of depth range."""
    forward = unit(np.subtract(camera.target, camera.position))
    right = unit(np.cross(forward, [0.0, 0.0, 1.0]))
    ray = np.subtract(point, camera.position)
    depth = float(dot(ray, forward))
    if not camera.near < depth < camera.far:
        return (math.inf, math.inf)
    size = depth * tan(camera.fov / 2)
    return (float(dot(ray, right)) / size, float(dot(ray, np.cross(right, forward))) / size)


def place_camera(
    rng: np.random.Generator, rule: CameraRule, aim_height: float, seen: Sequence[Body]
) -> Camera:
    """Draw a camera that looks at the centre of the scene and shows the centres of all ``seen``.

    Raises `BadSceneError` if none of `CAMERA_TRIES` draws does.
    """
    centers = [ordered_mean(world_bounds(body), axis=0) for body in seen]
    for _ in range(CAMERA_TRIES):
        distance = uniform(rng, rule.radius) * math.sqrt(2)
        azimuth = math.radians(uniform(rng, rule.angle_deg) + 45.0)
        x, y = distance * cos(azimuth), distance * sin(azimuth)
        if rule.mirror and rng.random() < rule.mirror:
            x = -x
        camera = Camera((x, y, uniform(rng, rule.height)), (0.0, 0.0, aim_height))
        if all(max(map(abs, project_to_image(camera, center))) < 0.98 for center in centers):
            return camera
    names = " and ".join(body.name for body in seen)
    raise BadSceneError(
        f"no camera shows {names}: widen the ranges of the camera or increase its radius"
    )


def place_scenery(
    rule: SceneryRule,
    camera: Camera,
    bodies: Sequence[Body],
    distractors: np.random.Generator,
    occluders: np.random.Generator,
) -> tuple[Body, ...]:
    """Draw props behind and in front of ``bodies``; each kind has a random stream of its own."""
    bounds = np.array([world_bounds(body) for body in bodies])
    keep_out = np.stack([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])
    placed: list[Body] = []
    for i in range(rule.distractors):
        props = rule.distractor_props, rule.distractor_size, rule.distractor_distance
        drawn = _draw_prop(distractors, f"distractor_{i}", *props, rule.yaw_deg)
        spacing = math.radians(rule.distractor_spacing_deg)
        angle = math.pi + (i - (rule.distractors - 1) / 2) * spacing
        placed.append(_first_free(drawn, camera, keep_out, angle, spacing, placed))
    for i in range(rule.occluders):
        props = rule.occluder_props, rule.occluder_size, rule.occluder_distance
        drawn = _draw_prop(occluders, f"occluder_{i}", *props, rule.yaw_deg)
        spacing = math.radians(rule.occluder_spacing_deg)
        angle = (i - (rule.occluders - 1) / 2) * spacing
        size = _occluding_size(drawn, camera, keep_out, angle, rule)
        drawn = replace(drawn, size=size)
        placed.append(_first_free(drawn, camera, keep_out, angle, spacing, placed))
    return tuple(placed)


@dataclass(frozen=True)
class _DrawnProp:
    """Random properties of a prop; its position then depends on camera and bodies as well."""

    name: str
    shape: str
    size: NDArray[np.float64]
    yaw: float
    fraction: float
    look: Look


def _draw_prop(
    rng: np.random.Generator,
    name: str,
    props: Sequence[str],
    limits: Range,
    distance: Range,
    yaw_deg: float,
) -> _DrawnProp:
    prop = pick(rng, expand_props(props))
    size = np.array(NATURAL_SIZES[prop])
    largest = float(size.max())
    size = size * float(np.clip(largest, *limits)) / largest
    angle = math.radians(uniform(rng, (-yaw_deg, yaw_deg)))
    return _DrawnProp(
        name, f"prop:{prop}", size, angle, uniform(rng, distance), prop_look(rng, f"prop:{prop}")
    )


def _first_free(
    drawn: _DrawnProp,
    camera: Camera,
    keep_out: NDArray[np.float64],
    angle: float,
    spacing: float,
    placed: Sequence[Body],
) -> Body:
    """Return the prop at the first position, at or next to its angle, free of other props."""
    for times, step in itertools.product(FARTHER, STEPS_ASIDE):
        at = angle + step * spacing
        if abs(step) > 3 and abs(cos(at)) < cos(FARTHEST_ASIDE):
            continue
        body = _place_prop(replace(drawn, fraction=drawn.fraction * times), camera, keep_out, at)
        if not any(_footprints_overlap(body, other) for other in placed):
            return body
    raise BadSceneError(
        f"no room for {drawn.name} next to {placed[-1].name}: use fewer or smaller props, or "
        "increase the spacing of the scenery"
    )


def _place_prop(
    drawn: _DrawnProp, camera: Camera, keep_out: NDArray[np.float64], angle: float
) -> Body:
    position = _position(drawn, camera, keep_out, angle)
    azimuth = arctan2(camera.position[1], camera.position[0])
    return Body(
        name=drawn.name,
        shape=drawn.shape,
        position=(float(position[0]), float(position[1]), 0.0),
        scale=(float(drawn.size[0]), float(drawn.size[1]), float(drawn.size[2])),
        rotation=yaw(azimuth + angle + drawn.yaw),
        kinematic=True,
        scenery=True,
        look=drawn.look,
    )


def _position(
    drawn: _DrawnProp, camera: Camera, keep_out: NDArray[np.float64], angle: float
) -> NDArray[np.float64]:
    """Return the position (2,) of a prop: outside the bodies, and not too near to the camera."""
    x, y, _ = camera.position
    azimuth, reach = arctan2(y, x) + angle, math.sqrt(x * x + y * y)
    direction = np.array([cos(azimuth), sin(azimuth)])
    position = _position_outside(
        direction, drawn.fraction * reach / math.sqrt(2), drawn.size, keep_out
    )
    if cos(angle) > 0:
        position *= min(1.0, NEAREST_OCCLUDER * reach / float(norm(position)))
    return position


def _occluding_size(
    drawn: _DrawnProp,
    camera: Camera,
    keep_out: NDArray[np.float64],
    angle: float,
    rule: SceneryRule,
) -> NDArray[np.float64]:
    """Return the size with which an occluder covers its fraction of the line of sight.

    Width and depth scale with the height, within the limits of the rule.
    """
    position = _position(drawn, camera, keep_out, angle)
    along = float(norm(position) / norm(camera.position[:2]))
    sight = camera.target[2] + (camera.position[2] - camera.target[2]) * along
    top = max(rule.occlusion * sight, 0.05)
    factor = min(top / drawn.size[2], rule.occluder_size[1] / max(drawn.size))
    return np.array([drawn.size[0] * factor, drawn.size[1] * factor, top])


def _footprints_overlap(body: Body, other: Body) -> bool:
    """Return whether the circles around the footprints of two props overlap."""
    reach = (norm(body.scale[:2]) + norm(other.scale[:2])) / 2
    return bool(norm(np.subtract(body.position[:2], other.position[:2])) < reach)


def _position_outside(
    direction: NDArray[np.float64],
    distance: float,
    size: NDArray[np.float64],
    keep_out: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the first position along ``direction``, from ``distance`` on, outside the scene."""
    margin = CLEARANCE + float(norm(size[:2])) / 2
    low, high = keep_out[0, :2] - margin, keep_out[1, :2] + margin
    with np.errstate(divide="ignore"):
        exits = np.where(direction > 0, high / direction, low / direction)
    inside = bool(((direction * distance > low) & (direction * distance < high)).all())
    return np.asarray(direction * (float(exits.min()) if inside else distance))


# Rules by which all scenarios draw bodies, zones and pushes.

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
