"""What is in a trial, before any engine or pixel: bodies, cloth, pushes, joints, camera, roles.

Units are metres, kilograms, seconds and radians; z is up, axes are right-handed, quaternions are
(w, x, y, z) of unit length. A body's position is its pivot: for every primitive the centre of its
bottom face. Everything is frozen and serialises to JSON and back without loss.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from physion.dataclass_json import parse_json, read_dataclass, shown
from physion.errors import BadSceneError

Vec3: TypeAlias = tuple[float, float, float]
Quat: TypeAlias = tuple[float, float, float, float]

FRAME_TIME = 0.01
"""Seconds of physics in one frame (reference/official-system.md, section 1)."""
PLAYBACK_RATE = 30
"""Frames a second of the official movies, so that they play 3.33 times slower than the physics."""
OBSERVED_FRAMES = 45
"""Frames that people and models see: 1.5 s of movie, 0.45 s of physics."""
GRAVITY = 9.81
"""Metres per second squared, downwards."""


@dataclass(frozen=True, slots=True)
class SurfaceMaterial:
    """Friction and restitution of a surface; a contact uses the means of both bodies' values."""

    static_friction: float = 0.5
    dynamic_friction: float = 0.5
    restitution: float = 0.0


@dataclass(frozen=True, slots=True)
class Look:
    """Colour (red, green, blue in 0..1, as a person names it: sRGB) and a texture by name."""

    color: Vec3 = (0.8, 0.8, 0.8)
    texture: str = "plain"


@dataclass(frozen=True, slots=True)
class Body:
    """A rigid body: a shape by name, scaled along its own axes, at a pose.

    ``shape`` names a primitive (``cube``, ``bowl``, ...), or a prop. ``kinematic`` bodies never
    move but are touched; ``scenery`` bodies are drawn only. ``angular_drag`` and ``drag`` are
    Unity's: a share of the velocity lost each second.
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
    """A square sheet, ``size`` metres a side, flat at ``position`` (its centre) when released.

    ``stretch``, ``bend`` and ``tether`` are stiffnesses in 0..1, as NVIDIA Flex takes them.
    ``resolution`` counts the vertices along a side; the solver's finer sheets stretch more. Of 41
    to 61 vertices, 51 tell the outcomes of the official trials apart best (2 m a side).
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
    """An impulse (newton seconds) at a point of the world, just before the step after ``frame``.

    Without a ``point`` it acts on the centre of mass and gives no spin.
    """

    body: str
    impulse: Vec3
    point: Vec3 | None = None
    frame: int = 0


@dataclass(frozen=True, slots=True)
class Joint:
    """Two bodies held together rigidly from frame 0."""

    parent: str
    child: str


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole that looks from ``position`` to ``target`` with z upright in the picture.

    ``fov`` is the vertical field of view in radians; ``near`` and ``far`` are metres.
    """

    position: Vec3
    target: Vec3 = (0.0, 0.0, 0.5)
    fov: float = math.radians(55.0)
    near: float = 0.1
    far: float = 100.0


@dataclass(frozen=True, slots=True)
class Ending:
    """A trial ends once every body sleeps, after ``min_frames``, or at ``max_frames`` anyway.

    Counts include frame 0. A body below ``floor`` metres is ignored when asking who sleeps.
    """

    min_frames: int = 151
    max_frames: int = 302
    floor: float = -1.0


@dataclass(frozen=True, slots=True)
class Roles:
    """Who is asked about: will the ``agent`` touch the ``patient``? ``probe`` gets the push."""

    agent: str
    patient: str
    probe: str | None = None


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything that decides a trial. ``name`` is the stimulus name, unique in its set.

    ``floor`` is the height of the room's floor in metres.
    ``settle_frames`` is how long bodies come to rest before frame 0, with the cloth held still
    (the official cloth trials let every solid settle for 100 steps).
    ``parameters`` keeps what the sampler or the importer drew, for the record: JSON values only.
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

    def __post_init__(self) -> None:
        names = self.names()
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

    def names(self) -> list[str]:
        """Names of all bodies, then of all cloths: the order of every per-body array."""
        return [body.name for body in self.bodies] + [cloth.name for cloth in self.cloths]

    def index(self, name: str) -> int:
        """Position of a body or cloth in per-body arrays; `BadSceneError` if there is none."""
        try:
            return self.names().index(name)
        except ValueError:
            raise BadSceneError(f"scene {self.name!r} holds no {name!r}") from None

    def physics_digest(self) -> str:
        """SHA-256 of all that decides the motion: equal for two scenes that only look different."""
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
        )
        return hashlib.sha256(plain.to_json().encode()).hexdigest()

    def to_json(self) -> str:
        """One line of JSON that `Scene.from_json` turns back into an equal scene."""
        return json.dumps(dataclasses.asdict(self), separators=(",", ":"), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Scene:
        """Read what `to_json` wrote; `BadSceneError` says which field is missing or unknown."""
        return read_dataclass(cls, parse_json(text, "scene", BadSceneError), "scene", BadSceneError)
