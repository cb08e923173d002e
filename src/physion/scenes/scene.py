"""Description of a trial, independent of engine and renderer: bodies, cloth, pushes, camera, roles.

Units are metres, kilograms, seconds and radians; z is up, axes are right-handed, quaternions are
(w, x, y, z) of unit length. A body's position is the position of its pivot: for every primitive the
centre of its bottom face. All classes are frozen dataclasses; a `Scene` is written to JSON and read
back without loss.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError, BadSceneError
from physion.core.files import digest_of
from physion.core.settings import parse_json, read_settings, shown

Vec3: TypeAlias = tuple[float, float, float]
Quat: TypeAlias = tuple[float, float, float, float]


def vec3(values: NDArray[np.float64]) -> Vec3:
    """Return an array (3,) as a tuple of floats."""
    return (float(values[0]), float(values[1]), float(values[2]))


FRAME_TIME = 0.01
"""Seconds of physics per frame (docs/official-system.md, section 1)."""
PLAYBACK_RATE = 30
"""Frames per second of the official movies, which play 3.33 times slower than the physics."""
OBSERVED_FRAMES = 45
"""Number of frames that people and models see: 1.5 s of movie, 0.45 s of physics."""
EVENT_KINDS = ("appear", "vanish", "move")
"""Kinds of `BodyEvent`."""
MAX_THINGS = 10_000
"""Largest number of bodies and cloths of a scene; sampled and official ones have less than 50."""
GRAVITY = 9.81
"""Metres per second squared, downwards."""
FLOORS = {"box": 0.0, "bright": 0.0043, "empty": 0.0}
"""Rooms of this package with the height of their floors, metres; the floor of other rooms is at 0.
In the official ``tdw_room`` (here ``bright``) bodies placed at 0 come to rest 4 to 5 mm higher than
in ``box_room_2018`` (here ``box``), as the recorded displacements of the targets show."""


@dataclass(frozen=True, slots=True)
class SurfaceMaterial:
    """Friction and restitution of a surface; a contact uses the means of both bodies' values."""

    static_friction: float = 0.5
    dynamic_friction: float = 0.5
    restitution: float = 0.0


@dataclass(frozen=True, slots=True)
class Look:
    """Appearance of a body: sRGB colour (red, green, blue in 0..1) and the name of a texture."""

    color: Vec3 = (0.8, 0.8, 0.8)
    texture: str = "plain"


@dataclass(frozen=True, slots=True)
class Body:
    """Rigid body: a named shape, scaled along its own axes, at a pose.

    - ``shape``: name of a primitive (``cube``, ``bowl``, ...) or of a prop (``prop:vase``).
    - ``position``: of the pivot, metres. ``scale``: factors of the unit shape. ``mass``: kg.
    - ``contact``: the surface material.
    - ``kinematic``: the body never moves, but others collide with it.
    - ``scenery``: the body is drawn, but takes no part in the physics.
    - ``drag``, ``angular_drag``: as in Unity, the fraction of the velocity lost per second.
    """

    name: str
    shape: str
    position: Vec3
    scale: Vec3 = (1.0, 1.0, 1.0)
    rotation: Quat = (1.0, 0.0, 0.0, 0.0)
    mass: float = 1.0
    # The surface material. The field keeps its first name: it is a key of the scene's JSON, which
    # decides the physics digest and thereby the split that a scene belongs to.
    contact: SurfaceMaterial = SurfaceMaterial()
    kinematic: bool = False
    scenery: bool = False
    drag: float = 0.0
    angular_drag: float = 0.05
    look: Look = Look()


@dataclass(frozen=True, slots=True)
class Cloth:
    """Square sheet of cloth, released flat with its centre at ``position``.

    - ``size``: metres along each side.
    - ``stretch``, ``bend``, ``tether``: stiffnesses in 0..1, as in NVIDIA Flex.
    - ``resolution``: number of vertices along a side. A finer sheet stretches more. Among 41 to 61
      vertices for 2 m, 51 reproduces the outcomes of the official trials best.
    """

    name: str
    position: Vec3
    size: Vec3 = (2.0, 2.0, 0.0)
    rotation: Quat = (1.0, 0.0, 0.0, 0.0)
    mass: float = 0.5
    resolution: int = 51
    stretch: float = 0.5
    bend: float = 0.5
    tether: float = 0.5
    look: Look = Look()


@dataclass(frozen=True, slots=True)
class Push:
    """Impulse (newton seconds) on a body, applied just before the step that leads to ``frame``.

    ``point`` is in world coordinates, metres; None is the centre of mass, which causes no rotation.
    """

    body: str
    impulse: Vec3
    point: Vec3 | None = None
    frame: int = 0


@dataclass(frozen=True, slots=True)
class BodyEvent:
    """Body that appears, vanishes or moves, just before the step that leads to ``frame``.

    Events come before the pushes of the same frame, in the order of `Scene.events`.

    - ``kind``: ``appear``: the body is absent before ``frame``; ``vanish``: it is absent from
      ``frame`` on; ``move``: it is put at a pose. It starts from its pose at rest.
    - ``position`` (metres, of the pivot), ``rotation``: the new pose; None keeps the present one,
      which is the pose in `Body` for a body that appears first.

    An absent body touches nothing, is not drawn and rests: before it appears at the pose in `Body`,
    after it vanished at its last pose. Joints hold between bodies that are there.
    """

    frame: int
    body: str
    kind: str
    position: Vec3 | None = None
    rotation: Quat | None = None


@dataclass(frozen=True, slots=True)
class Joint:
    """Rigid connection of two bodies from frame 0 on."""

    parent: str
    child: str


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole camera at ``position`` that looks at ``target``, with z upwards in the image.

    ``fov`` is the vertical field of view in radians; ``near`` and ``far`` are the distances of the
    clipping planes in metres.
    """

    position: Vec3
    target: Vec3 = (0.0, 0.0, 0.5)
    fov: float = math.radians(55.0)
    near: float = 0.1
    far: float = 100.0


@dataclass(frozen=True, slots=True)
class Ending:
    """When a trial ends: all bodies at rest and ``min_frames`` reached, or ``max_frames`` reached.

    Counts include frame 0. Bodies below the height ``floor`` (metres) need not be at rest.
    """

    min_frames: int = 151
    max_frames: int = 302
    floor: float = -1.0

    def frame_limits(self, frames: int | None = None) -> tuple[int, int]:
        """Return the fewest and the most frames of a simulation.

        Both are ``frames``, if given; `BadInputError` if that is less than 1.
        """
        if frames is None:
            return self.min_frames, self.max_frames
        if frames < 1:
            raise BadInputError(f"frames must be at least 1, not {frames}")
        return frames, frames


@dataclass(frozen=True, slots=True)
class Roles:
    """Bodies of the question: will ``agent`` touch ``patient``? ``probe`` is the body pushed."""

    agent: str
    patient: str
    probe: str | None = None


@dataclass(frozen=True, slots=True)
class Scene:
    """Complete description of a trial.

    - ``name``: stimulus name, unique in its data set.
    - ``floor``: height of the room's floor, metres.
    - ``settle_frames``: frames simulated before frame 0 while the cloth is held still, so that
      bodies come to rest (100 in the official cloth trials).
    - ``parameters``: the parameters that the scene was sampled or imported with, as JSON values;
      kept as a record, without effect.
    - ``events``: bodies that appear, vanish or move later, sorted by frame. A trial does not end
      before its last event.
    """

    name: str
    scenario: str
    bodies: tuple[Body, ...]
    roles: Roles
    camera: Camera
    cloths: tuple[Cloth, ...] = ()
    pushes: tuple[Push, ...] = ()
    joints: tuple[Joint, ...] = ()
    room: str = "box"
    floor: float = 0.0
    ending: Ending = Ending()
    settle_frames: int = 0
    parameters: Mapping[str, Any] = field(default_factory=dict)
    events: tuple[BodyEvent, ...] = ()

    def __post_init__(self) -> None:
        names = self.names()
        if len(names) > MAX_THINGS:
            raise BadSceneError(_too_many(f"scene {self.name!r}", len(names)))
        repeated = sorted(name for name, count in Counter(names).items() if count > 1)
        if repeated:
            raise BadSceneError(
                f"scene {self.name!r}: two things are called {shown(repeated)}; bodies and cloths "
                "need different names"
            )
        used = [self.roles.agent, self.roles.patient, *(push.body for push in self.pushes)]
        used += [name for joint in self.joints for name in (joint.parent, joint.child)]
        used += [self.roles.probe] if self.roles.probe else []
        missing = sorted(set(used) - set(names))
        if missing:
            raise BadSceneError(
                f"scene {self.name!r}: roles, pushes or joints name {shown(missing)}, "
                f"but its bodies and cloths are {shown(names)}"
            )
        for body in self.bodies:
            if not (body.mass > 0 and min(body.scale) > 0):
                scale = ", ".join(f"{side:g}" for side in body.scale)
                raise BadSceneError(
                    f"scene {self.name!r}: body {body.name!r} needs a mass and scales above zero, "
                    f"not {body.mass:g} kg and ({scale})"
                )
        self._check_events()

    def _check_events(self) -> None:
        """Raise `BadSceneError` for events out of order, or of a kind that makes no sense."""
        bodies = {body.name for body in self.bodies}
        absent = bodies & self._appearing()
        before = 0
        for event in self.events:
            where = f"scene {self.name!r}: event {event.kind!r} of {event.body!r}"
            if event.body not in bodies:
                raise BadSceneError(f"{where}: there is no such body; its bodies: {shown(bodies)}")
            if event.kind not in EVENT_KINDS:
                raise BadSceneError(f"{where}: kinds are {', '.join(EVENT_KINDS)}")
            if event.frame < max(before, 1):
                raise BadSceneError(
                    f"{where} at frame {event.frame}: events are sorted by frame, the first of "
                    "which is 1; what holds from frame 0 on belongs to the body"
                )
            if (event.kind == "appear") != (event.body in absent):
                there = "is absent" if event.body in absent else "is already there"
                raise BadSceneError(f"{where} at frame {event.frame}: the body {there}")
            before = event.frame
            if event.kind != "move":
                absent ^= {event.body}

    def _appearing(self) -> set[str]:
        """Return the bodies that are absent in frame 0, because they appear later."""
        first: dict[str, str] = {}
        for event in self.events:
            if event.kind != "move":
                first.setdefault(event.body, event.kind)
        return {name for name, kind in first.items() if kind == "appear"}

    def present(self, frame: int) -> tuple[bool, ...]:
        """Return which bodies and cloths are there in ``frame``, in the order of `names`.

        The same ones take part in the step that leads to it.
        """
        last = {e.body: e.kind for e in self.events if e.kind != "move" and e.frame <= frame}
        absent = self._appearing()
        return tuple(
            last[name] == "appear" if name in last else name not in absent for name in self.names()
        )

    def names(self) -> list[str]:
        """Return the names of all bodies, then of all cloths: the order of every per-body array."""
        return [body.name for body in self.bodies] + [cloth.name for cloth in self.cloths]

    def index(self, name: str) -> int:
        """Return the index of a body or cloth in per-body arrays; `BadSceneError` if unknown."""
        try:
            return self.names().index(name)
        except ValueError:
            raise BadSceneError(f"scene {self.name!r} has no body or cloth {name!r}") from None

    def physics_digest(self) -> str:
        """Return the SHA-256 of all that affects the motion; appearance and names do not count."""
        scenery = {body.name for body in self.bodies if body.scenery}
        plain = dataclasses.replace(
            self,
            name="",
            room="",
            camera=Camera((0.0, 0.0, 0.0)),
            parameters={},
            bodies=tuple(
                dataclasses.replace(body, look=Look()) for body in self.bodies if not body.scenery
            ),
            cloths=tuple(dataclasses.replace(cloth, look=Look()) for cloth in self.cloths),
            events=tuple(event for event in self.events if event.body not in scenery),
        )
        return digest_of(plain.to_json())

    def to_json(self) -> str:
        """Return the scene as one line of JSON, from which `from_json` builds an equal scene."""
        values = _fields(self)
        # Scenes without events keep the text that they had before events were known: it decides
        # their digest, and thereby their split.
        if not self.events:
            del values["events"]
        return json.dumps(values, default=_fields, separators=(",", ":"), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Scene:
        """Read what `to_json` wrote; `BadSceneError` names the field that is wrong."""
        return cls.from_values(parse_json(text, "scene", BadSceneError))

    @classmethod
    def from_values(cls, data: Any) -> Scene:
        """Read parsed JSON as `from_json` does."""
        # Before every one of them is read.
        for name in ("bodies", "cloths", "events", "pushes", "joints"):
            values = data.get(name) if isinstance(data, dict) else None
            if isinstance(values, list) and len(values) > MAX_THINGS:
                raise BadSceneError(_too_many("scene", len(values), name))
        return read_settings(cls, data, "scene", BadSceneError)


def _fields(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass with slots."""
    return {name: getattr(value, name) for name in value.__slots__}


def _too_many(scene: str, count: int, what: str = "bodies and cloths") -> str:
    return f"{scene} has {count} {what}, more than {MAX_THINGS}"
