"""Command logs of the official simulator: reading of their lines, execution of their commands.

`CommandReader` has one method per command, and `physion.scenes.tdw.read_logs` builds a scene from
the result. Vectors and rotations are converted to our axes here: (x, y, z) of Unity is (x, z, y) of
ours.
"""

from __future__ import annotations

import gzip
import json
import math
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from physion.core.errors import BadInputError, PhysionError
from physion.core.files import read_plain
from physion.core.settings import shown
from physion.numerics.rotations import multiply_quaternions
from physion.scenes.sampling.parameters import as_quaternion, euler_rotation
from physion.scenes.scene import MAX_THINGS, BodyEvent, Push, Quat, SurfaceMaterial, Vec3

# Reading of command logs: lines are grouped by trial, and errors are reported with their line.

Command: TypeAlias = dict[str, Any]

MAX_LOG_BYTES = 1 << 27
"""Largest size of an uncompressed log, and of metadata; the largest official one has a few MB."""
MAX_LINE_BYTES = 1 << 24
"""Longest line of a log that is decompressed; its parsed commands take some hundred MB."""


@dataclass(frozen=True)
class ImportFailure:
    """Trial that could not be imported, with file, trial (None for all of the file) and reason."""

    file: str
    trial: str | None
    message: str

    def __str__(self) -> str:
        where = self.file if self.trial is None else f"{self.file}, trial {self.trial}"
        return f"{where}: {self.message}"


@dataclass
class CommandLog:
    """Content of a command log.

    - ``setup``: commands before the first trial.
    - ``trials``: by trial tag, the (line number, commands) of every frame.
    - ``failures``: trials with a broken line; they are not in ``trials``.
    """

    setup: list[Command] = field(default_factory=list)
    trials: dict[str, list[tuple[int, list[Command]]]] = field(default_factory=dict)
    failures: list[ImportFailure] = field(default_factory=list)


def find_logs(root: Path) -> list[Path]:
    """Return all command logs in the folder ``root`` and in all folders in it, sorted by path."""
    if not root.exists():
        raise BadInputError(
            f"{root} does not exist; give official (the packaged scenes), a folder that "
            "physion import made from a checkout, or one with official command logs"
        )
    if not root.is_dir():
        raise BadInputError(f"{root} is a file; give the folder that holds the command logs")
    found = [*root.rglob("tdw_commands.json"), *root.rglob("tdw_commands.json.gz")]
    logs = sorted(path for path in found if path.is_file())
    if not logs:
        raise BadInputError(f"{root} holds no tdw_commands.json or tdw_commands.json.gz")
    return logs


def read_metadata(path: Path) -> dict[str, dict[str, Any]]:
    """Read the records of ``metadata.json`` by trial number (as text).

    The number is the end of the stimulus name (``..._0012`` is trial 12), or the index of the
    record in the file if the name has none.
    """
    try:
        data = json.loads(read_plain(path, MAX_LOG_BYTES, follow_links=True).decode())
    except BadInputError:
        if not path.exists():
            raise BadInputError(f"{path} is missing; it holds the outcomes of the trials") from None
        raise
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{path} cannot be read: {error}") from error
    if not isinstance(data, list) or not all(isinstance(record, dict) for record in data):
        raise BadInputError(f"{path} must be a list with one object per trial")
    records = {}
    for position, record in enumerate(data):
        match = re.search(r"_(\d{4,})$", str(record.get("stimulus_name")))
        records[str(int(match.group(1)) if match else position)] = record
    return records


def read_command_log(path: Path) -> CommandLog:
    """Read a log, compressed or not; `BadInputError` if it cannot be read to its end."""
    log, broken, last = CommandLog(), set(), ""
    try:
        for number, line in enumerate(_lines(path), 1):
            if not line.strip():
                continue
            # A line whose end is missing belongs to the same trial as the line before.
            tag = _tag(line) or last
            last = tag
            try:
                commands = _parse_line(line)
            except BadInputError as error:
                broken.add(tag)
                message = f"line {number}: {error}"
                log.failures.append(ImportFailure(str(path), tag or None, message))
                continue
            if tag == "None":
                log.setup += commands
            else:
                log.trials.setdefault(tag, []).append((number, commands))
    except (OSError, EOFError, UnicodeDecodeError, zlib.error) as error:
        raise BadInputError(f"{path} cannot be read to its end: {error}") from error
    if not (log.trials or log.failures):
        raise BadInputError(f"{path} holds no trial")
    for tag in broken:
        log.trials.pop(tag, None)
    return log


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a log; `BadInputError` before more than the limits is decompressed."""
    opener: Callable[..., Any] = gzip.open if path.suffix == ".gz" else open
    size = 0
    with opener(path, "rb") as file:
        while line := file.readline(MAX_LINE_BYTES + 1):
            size += len(line)
            if len(line) > MAX_LINE_BYTES:
                raise BadInputError(f"{path} has a line of more than {MAX_LINE_BYTES} bytes")
            if size > MAX_LOG_BYTES:
                raise BadInputError(f"{path} has more than {MAX_LOG_BYTES} bytes uncompressed")
            yield line.decode("utf-8")


def _tag(line: str) -> str:
    match = re.search(r"trial (\S+)\s*$", line[-40:])
    return match.group(1) if match else ""


def _parse_line(line: str) -> list[Command]:
    try:
        value, _ = json.JSONDecoder().raw_decode(line.lstrip())
    except (json.JSONDecodeError, RecursionError) as error:
        raise BadInputError(f"is not JSON: {error}") from error
    commands = value if isinstance(value, list) else [value]
    if not all(isinstance(c, dict) and isinstance(c.get("$type"), str) for c in commands):
        raise BadInputError('holds something that is not a command with a "$type"')
    if not _tag(line):
        raise BadInputError('does not end in "trial N"')
    return commands


IGNORED_COMMANDS = frozenset(
    {
        "add_material",
        "assign_flex_container",
        "create_avatar",
        "create_flex_container",
        "send_bounds",
        "send_camera_matrices",
        "send_collisions",
        "send_flex_particles",
        "send_images",
        "send_meshes",
        "send_rigidbodies",
        "send_segmentation_colors",
        "send_transforms",
        "set_ambient_occlusion_intensity",
        "set_ambient_occlusion_thickness_modifier",
        "set_aperture",
        "set_focus_distance",
        "set_object_collision_detection_mode",
        "set_pass_masks",
        "set_physics_solver_iterations",
        "set_post_exposure",
        "set_render_quality",
        "set_screen_size",
        "set_shadow_strength",
        "set_sleep_threshold",
        "set_target_framerate",
        "set_vignette",
        "step_physics",
        "terminate",
        "unload_asset_bundles",
    }
)
"""Commands without effect here: requests for output, image settings, and engine settings that are
equal in all published logs and are the defaults of our engine."""


ROOMS = {"box_room_2018": "box", "tdw_room": "bright", "archviz_house": "bright"}
TEXTURES = {"wood_european_ash": "wood_ash", "parquet_wood_red_cedar": "wood_cedar"}
VANISHING_SCALE = 1e-4
"""Bodies with a smaller scale are placeholders of the official generator (a missing attachment, or
the end of a size gradient). They are left out, with a note."""

MAX_CHANGES = 100_000
"""Most pushes, joints and events of a trial; the official ones have a few hundred."""
MAX_NAME = 200
"""Longest name of a model."""
UNSET_MATERIAL = SurfaceMaterial(0.6, 0.6, 0.0)
"""Unity's default material, for objects without one."""


def vector(value: Any) -> Vec3:
    """Convert an official vector (x right, y up, z forward) to our axes (z up)."""
    try:
        x, y, z = float(value["x"]), float(value["y"]), float(value["z"])
    except (TypeError, KeyError, ValueError):
        raise BadInputError(f"expected numbers x, y and z, not {shown(value)}") from None
    if not all(map(math.isfinite, (x, y, z))):
        raise BadInputError(f"expected finite numbers, not {shown(value)}")
    return (x, z, y)


def quaternion_from_euler(degrees: Any) -> Quat:
    """Convert Unity's Euler angles (about z, then x, then y) to a quaternion in our axes."""
    # Swapping y and z is a reflection, which changes the sign of rotations. 720 degrees are the
    # identity also for quaternions.
    x, y, z = (-math.fmod(angle, 720.0) for angle in vector(degrees))
    return euler_rotation(x, y, z)


def _to_our_axes(unity: Quat) -> Quat:
    # The sign of the rotation changes, as in `quaternion_from_euler`.
    w, x, y, z = unity
    return (w, -x, -z, -y)


@dataclass
class LoggedObject:
    """Object of a command log, as changed by the commands read so far.

    ``position`` and ``rotation`` are those at its creation, in frame ``created``. ``gone``: it was
    destroyed in that frame and never was in the trial; ``destroyed``: the later frame in which it
    was. ``put``: the position and rotation that the log gave last, after which forces may have
    moved it. ``earlier``: number of objects with its id that it replaced.
    """

    id: int
    model: str
    category: str
    position: Vec3
    rotation: Quat
    scale: Vec3 = (1.0, 1.0, 1.0)
    mass: float | None = None
    contact: SurfaceMaterial = UNSET_MATERIAL
    kinematic: bool = False
    drag: float = 0.0
    angular_drag: float = 0.05
    color: Vec3 | None = None
    texture: str = "plain"
    flex: bool = False
    cloth: tuple[float, float, float] | None = None
    gone: bool = False
    created: int = 0
    destroyed: int | None = None
    put: tuple[Vec3, Quat] | None = None
    earlier: int = 0

    @property
    def name(self) -> str:
        """Name of the body: model and id, and a number if objects with the id came before."""
        return f"{self.model}_{self.id}" + (f"_{self.earlier + 1}" if self.earlier else "")

    @property
    def free(self) -> bool:
        """Return whether forces move it; if not, the pose that the log gave last is its pose."""
        return not (self.kinematic or self.flex or self.mass is None)

    @property
    def vanishing(self) -> bool:
        return min(self.scale) < VANISHING_SCALE or (self.mass is not None and self.mass <= 0)


class CommandReader:
    """State of a trial while its commands are executed, in our axes.

    ``objects`` are the present ones by their ids; ``replaced`` those whose id was given again at a
    later frame. Pushes, events and joints name the objects.
    """

    def __init__(self, unknown: Counter[str]) -> None:
        self.unknown = unknown
        self.objects: dict[int, LoggedObject] = {}
        self.replaced: list[LoggedObject] = []
        self.pushes: list[Push] = []
        self.events: list[BodyEvent] = []
        self.joints: list[tuple[str, str]] = []
        self.eye: Vec3 = (0.0, -3.0, 1.0)
        self.target: Vec3 = (0.0, 0.0, 0.5)
        self.fov = math.radians(55.0)
        self.room = "empty"
        self.frame = 0
        self.settles = False
        self.notes: list[str] = []

    def read(self, setup: list[Command], frames: list[tuple[int, list[Command]]]) -> None:
        """Execute the set-up commands, then each frame's: (line number, commands)."""
        for command in setup:
            self._execute(command, "the set-up before the first trial")
        for frame, (line, commands) in enumerate(frames[_start(frames) : _count_frames(frames)]):
            self.frame = frame
            for command in commands:
                self._execute(command, f"line {line}")

    def _execute(self, command: Command, where: str) -> None:
        kind = command["$type"]
        if kind in IGNORED_COMMANDS:
            return
        method = getattr(self, f"do_{kind}", None)
        if method is None:
            self.unknown[kind] += 1
            return
        try:
            method(command)
            if len(self.pushes) + len(self.events) + len(self.joints) > MAX_CHANGES:
                raise BadInputError(f"there are more than {MAX_CHANGES} pushes, joints and events")
        except PhysionError as error:
            raise BadInputError(f"{where}: {kind}: {error}") from error
        except KeyError as error:
            raise BadInputError(f"{where}: {kind} has no {error}") from error
        except (TypeError, ValueError, AttributeError) as error:
            raise BadInputError(f"{where}: {kind}: {error}") from error

    def _object(self, command: Command, key: str = "id") -> LoggedObject:
        thing = self.objects.get(command[key])
        if thing is None:
            raise BadInputError(f"object {shown(command[key])} was never created")
        if thing.destroyed is not None:
            raise BadInputError(
                f"object {shown(command[key])} was destroyed at frame {thing.destroyed}"
            )
        return thing

    def _new(self, command: Command, key: str = "id") -> LoggedObject:
        """Return the object of a command that sets what cannot change later in a scene."""
        thing = self._object(command, key)
        if thing.created != self.frame:
            raise BadInputError(
                f"is at frame {self.frame}, but {thing.name} was created at frame "
                f"{thing.created}; later it may only move, be pushed or vanish"
            )
        return thing

    def _move(
        self, thing: LoggedObject, position: Vec3 | None = None, rotation: Quat | None = None
    ) -> None:
        """Give an object another pose: its first one, or an event if it was created earlier."""
        old_position, old_rotation = thing.put or (thing.position, thing.rotation)
        pose = (position or old_position, rotation or old_rotation)
        if thing.created == self.frame:
            thing.position, thing.rotation = pose
            return
        thing.put = pose
        if not thing.free:
            position, rotation = pose
        event = self.events[-1] if self.events else None
        if event and (event.body, event.frame, event.kind) == (thing.name, self.frame, "move"):
            self.events.pop()
            position, rotation = position or event.position, rotation or event.rotation
        self.events.append(BodyEvent(self.frame, thing.name, "move", position, rotation))

    # One method per command.

    def do_add_scene(self, command: Command) -> None:
        name = command["name"]
        if name not in ROOMS:
            self.notes.append(f"room {name!r} is not available; the empty room is used")
        self.room = ROOMS.get(name, "empty")

    def do_set_field_of_view(self, command: Command) -> None:
        self.fov = math.radians(float(command["field_of_view"]))

    def do_teleport_avatar_to(self, command: Command) -> None:
        self.eye = vector(command["position"])

    def do_look_at_position(self, command: Command) -> None:
        self.target = vector(command["position"])

    def do_add_object(self, command: Command) -> None:
        id_ = int(command["id"])
        if len(self.objects) + len(self.replaced) >= MAX_THINGS:
            raise BadInputError(f"there are more than {MAX_THINGS} objects")
        if len(str(command["name"])) > MAX_NAME:
            raise BadInputError(f"a name of a model has more than {MAX_NAME} characters")
        old = self.objects.get(id_)
        if old is not None and old.created == self.frame:
            self.events = [event for event in self.events if event.body != old.name]
        elif old is not None:
            if not old.gone and old.destroyed is None:
                self._vanish(old)
            self.replaced.append(old)
        thing = LoggedObject(
            id_,
            str(command["name"]),
            str(command.get("category", "")),
            vector(command["position"]),
            quaternion_from_euler(command["rotation"]),
            created=self.frame,
            earlier=[other.id for other in self.replaced].count(id_),
        )
        self.objects[id_] = thing
        if self.frame:
            self.events.append(BodyEvent(self.frame, thing.name, "appear"))

    def do_destroy_object(self, command: Command) -> None:
        thing = self._object(command)
        if thing.created == self.frame:
            thing.gone = True
            return
        self._vanish(thing)

    def _vanish(self, thing: LoggedObject) -> None:
        thing.destroyed = self.frame
        self.events.append(BodyEvent(self.frame, thing.name, "vanish"))

    do_destroy_flex_object = do_destroy_object

    def do_scale_object(self, command: Command) -> None:
        thing, factor = self._new(command), vector(command["scale_factor"])
        thing.scale = tuple(a * b for a, b in zip(thing.scale, factor, strict=True))  # type: ignore[assignment]

    def do_teleport_object(self, command: Command) -> None:
        self._move(self._object(command), position=vector(command["position"]))

    def do_rotate_object_to(self, command: Command) -> None:
        q = command["rotation"]
        unity = (float(q["w"]), float(q["x"]), float(q["y"]), float(q["z"]))
        self._move(self._object(command), rotation=_to_our_axes(unity))

    def do_rotate_object_to_euler_angles(self, command: Command) -> None:
        self._move(self._object(command), rotation=quaternion_from_euler(command["euler_angles"]))

    def do_rotate_object_by(self, command: Command) -> None:
        thing = self._object(command)
        if thing.created != self.frame and thing.free:
            raise BadInputError(
                f"rotates {thing.name} by an angle at frame {self.frame}, but its rotation then "
                "is not in the log; give the rotation itself"
            )
        axis = {"pitch": "x", "yaw": "y", "roll": "z"}[command.get("axis", "yaw")]
        angles = {"x": 0.0, "y": 0.0, "z": 0.0, axis: float(command["angle"])}
        by, old = quaternion_from_euler(angles), thing.put[1] if thing.put else thing.rotation
        world = bool(command.get("is_world", True))
        factors = (by, old) if world else (old, by)
        self._move(thing, rotation=as_quaternion(multiply_quaternions(*factors)))

    def do_set_mass(self, command: Command) -> None:
        self._new(command).mass = float(command["mass"])

    def do_set_physic_material(self, command: Command) -> None:
        self._new(command).contact = SurfaceMaterial(
            float(command["static_friction"]),
            float(command["dynamic_friction"]),
            float(command["bounciness"]),
        )

    def do_set_kinematic_state(self, command: Command) -> None:
        self._new(command).kinematic = bool(command.get("is_kinematic", False))

    def do_set_object_drag(self, command: Command) -> None:
        thing = self._new(command)
        thing.drag, thing.angular_drag = float(command["drag"]), float(command["angular_drag"])

    def do_apply_force_at_position(self, command: Command) -> None:
        self._push(command, vector(command["position"]))

    def do_apply_force_to_object(self, command: Command) -> None:
        self._push(command, None)

    def _push(self, command: Command, point: Vec3 | None) -> None:
        thing, impulse = self._object(command), vector(command["force"])
        if any(impulse):
            self.pushes.append(Push(thing.name, impulse, point, self.frame))

    def do_add_fixed_joint(self, command: Command) -> None:
        parent, child = self._object(command, "parent_id"), self._object(command)
        if self.frame not in (parent.created, child.created):
            raise BadInputError(
                f"joins {parent.name} and {child.name} at frame {self.frame}, but both were "
                "created before; joints hold from then on"
            )
        self.joints.append((parent.name, child.name))

    def do_set_color(self, command: Command) -> None:
        c = command["color"]
        color = tuple(min(max(float(c[channel]), 0.0), 1.0) for channel in "rgb")
        self._object(command).color = color  # type: ignore[assignment]

    def do_set_visual_material(self, command: Command) -> None:
        self._object(command).texture = _texture(str(command["material_name"]))

    def do_set_flex_solid_actor(self, command: Command) -> None:
        self._object(command).flex = True
        self.settles = True

    def do_set_flex_cloth_actor(self, command: Command) -> None:
        thing = self._object(command)
        if thing.created:
            raise BadInputError(f"{thing.name} is cloth, which must be there from frame 0 on")
        thing.flex = True
        thing.cloth = (
            float(command["stretch_stiffness"]),
            float(command["bend_stiffness"]),
            float(command["tether_stiffness"]),
        )

    def do_set_flex_object_mass(self, command: Command) -> None:
        self._object(command).mass = float(command["mass"])


def _start(frames: list[tuple[int, list[Command]]]) -> int:
    """Return the list with which a trial starts: the last one that creates all its objects again.

    The first list was written twice where the official program repeated the set-up of a trial.
    """
    start, known = 0, set[Any]()
    for index, (_, commands) in enumerate(frames):
        made = {c.get("id") for c in commands if c["$type"] == "add_object"}
        if known and known <= made:
            start = index
        known |= made
    return start


def _count_frames(frames: list[tuple[int, list[Command]]]) -> int:
    """Return the number of frames, without the last lists that only destroy objects.

    These clean up for the next trial. At least one frame is left.
    """
    count = len(frames)
    while count > 1 and _cleans_up(frames[count - 1][1]):
        count -= 1
    return count


def _cleans_up(commands: list[Command]) -> bool:
    """Return whether a list of commands only destroys objects, or ends the program."""
    kinds = [command["$type"] for command in commands]
    return bool(kinds) and all("destroy" in kind or kind == "terminate" for kind in kinds)


def _texture(material: str) -> str:
    if material in TEXTURES:
        return TEXTURES[material]
    families = {
        "wood_cedar": ("wood", "parquet", "spruce", "koto"),
        "metal": ("metal", "titanium", "chrome", "steel", "gold", "copper", "iron", "alumin"),
        "plastic": ("plastic", "resin", "polystyrene", "vinyl", "paint", "wax"),
        "cloth": ("fabric", "weave", "leather", "carpet"),
    }
    for texture, words in families.items():
        if any(word in material for word in words):
            return texture
    return "plain"
