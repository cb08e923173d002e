"""Official command logs become scenes: the one door through which left-handed, y-up data comes in.

A configuration is a folder with ``tdw_commands.json`` (or ``.json.gz``) and ``metadata.json``.
The log holds one JSON list of commands a line, followed by ``trial N``; the lists of one trial are
its frames, ``trial None`` prepares the room (reference/engines-and-rendering.md, "Format facts").
"""

from __future__ import annotations

import gzip
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from physion.errors import BadInputError, PhysionError
from physion.scenes.props import ModelBounds, prop_for, read_model_bounds
from physion.scenes.scene import (
    Body,
    Camera,
    Cloth,
    Contact,
    Ending,
    Joint,
    Look,
    Push,
    Quat,
    Roles,
    Scene,
    Vec3,
)
from physion.scenes.shapes import shapes

IGNORED_COMMANDS = frozenset(
    """
    add_material assign_flex_container create_avatar create_flex_container send_bounds
    send_camera_matrices send_collisions send_flex_particles send_images send_meshes
    send_rigidbodies send_segmentation_colors send_transforms set_ambient_occlusion_intensity
    set_ambient_occlusion_thickness_modifier set_aperture set_focus_distance
    set_object_collision_detection_mode set_pass_masks set_physics_solver_iterations
    set_post_exposure set_render_quality set_screen_size set_shadow_strength set_sleep_threshold
    set_target_framerate set_vignette step_physics terminate unload_asset_bundles
    """.split()
)
"""Commands that change nothing here: output requests, picture settings, and engine settings that
are the same in every published log and are the defaults of our engine."""

SCENARIOS = {
    "MultiDominoes": "dominoes",
    "Tower": "support",
    "Collision": "collide",
    "Containment": "contain",
    "Drop": "drop",
    "Linking": "link",
    "RollingSliding": "roll",
    "ClothSagging": "drape",
}
"""Controller names of the official metadata. Some Roll trials were made by the Collide controller:
a folder whose name says ``rolling`` is Roll."""

MAX_FRAMES = {"collide": 152, "contain": 452, "link": 452, "support": 602, "drape": 151}
"""Longest trial by scenario, frame 0 counted; 302 for the others (reference section 2.6)."""

ROOMS = {"box_room_2018": "box", "tdw_room": "bright", "archviz_house": "bright"}
TEXTURES = {"wood_european_ash": "wood_ash", "parquet_wood_red_cedar": "wood_cedar"}
FLEX_SETTLE_FRAMES = 100
VANISHING_SCALE = 1e-4
"""Bodies scaled below this are placeholders of the official generator (no attachment, an empty
end of the size gradient); they are left out and noted."""
MAX_LOG_BYTES = 1 << 30


@dataclass(frozen=True)
class Outcome:
    """What the official simulator recorded for a trial (its ``metadata.json``).

    Frames are counted from 0. ``displacement`` is the agent's final position minus its reference
    position, in our axes; ``min_distance`` belongs to cloth trials.
    """

    contact: bool
    first_frame: int | None
    frames: int
    displacement: Vec3 | None = None
    min_distance: float | None = None


@dataclass(frozen=True)
class ImportedTrial:
    """A scene with what really happened in it. ``notes`` say what was left out."""

    scene: Scene
    outcome: Outcome
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ImportFailure:
    """A trial that could not be imported: which file, which trial (None: all), and why."""

    file: str
    trial: str | None
    message: str

    def __str__(self) -> str:
        where = self.file if self.trial is None else f"{self.file}, trial {self.trial}"
        return f"{where}: {self.message}"


@dataclass
class TrialSet:
    """Everything found under a folder: trials, failures, and unknown commands by name."""

    trials: list[ImportedTrial] = field(default_factory=list)
    failures: list[ImportFailure] = field(default_factory=list)
    unknown: Counter[str] = field(default_factory=Counter)

    def unique(self) -> tuple[list[ImportedTrial], int]:
        """Trials with different physics, and how many were left out as copies of another."""
        first: dict[str, ImportedTrial] = {}
        for trial in self.trials:
            first.setdefault(trial.scene.physics_digest(), trial)
        return list(first.values()), len(self.trials) - len(first)


def find_logs(root: Path) -> list[Path]:
    """Every command log under ``root`` in the order of their paths."""
    if not root.exists():
        raise BadInputError(f"{root} does not exist; give a folder with official command logs")
    if not root.is_dir():
        raise BadInputError(f"{root} is a file; give the folder that holds the command logs")
    logs = sorted([*root.rglob("tdw_commands.json"), *root.rglob("tdw_commands.json.gz")])
    if not logs:
        raise BadInputError(f"{root} holds no tdw_commands.json or tdw_commands.json.gz")
    return logs


def read_scenes(root: Path, scenario: str | None = None, limit: int | None = None) -> TrialSet:
    """Import every log under ``root``; ``limit`` keeps the first trials of each scenario.

    A broken log or trial becomes a failure of the result and the others go on;
    `BadInputError` only where there is no log at all.
    """
    found = TrialSet()
    bounds = _bounds_beside(root)
    taken: Counter[str] = Counter()
    for log in find_logs(root):
        for trial in read_log(log, found, bounds):
            name = trial.scene.scenario
            if scenario not in (None, name) or (limit is not None and taken[name] >= limit):
                continue
            taken[name] += 1
            found.trials.append(trial)
    return found


def read_log(
    log: Path, found: TrialSet, bounds: Mapping[str, ModelBounds] | None = None
) -> Iterator[ImportedTrial]:
    """Yield the trials of one log; failures and unknown commands are added to ``found``."""
    file = str(log)
    try:
        records = _read_metadata(log.parent / "metadata.json")
        setup, frames = _group_lines(log, found)
    except PhysionError as error:
        found.failures.append(ImportFailure(file, None, str(error)))
        return
    for tag, lists in frames.items():
        try:
            if not tag.isdigit() or int(tag) >= len(records):
                raise BadInputError(f"metadata.json has {len(records)} entries and none for it")
            yield _Reader(records[int(tag)], log.parent, bounds or {}, found.unknown).read(
                setup, lists
            )
        except PhysionError as error:
            found.failures.append(ImportFailure(file, tag, str(error)))


def vector(value: Any) -> Vec3:
    """An official vector (x right, y up, z forward) in our axes (z up)."""
    try:
        x, y, z = float(value["x"]), float(value["y"]), float(value["z"])
    except (TypeError, KeyError, ValueError):
        raise BadInputError(f"expected x, y and z numbers, found {value!r}") from None
    if not all(map(math.isfinite, (x, y, z))):
        raise BadInputError(f"expected finite numbers, found {value!r}")
    return (x, z, y)


def quaternion_from_euler(degrees: Any) -> Quat:
    """Unity's Euler angles (turn about z, then x, then y) as a quaternion in our axes."""
    x, z, y = (math.radians(angle) / 2 for angle in vector(degrees))
    qx: Quat = (math.cos(x), math.sin(x), 0.0, 0.0)
    qy: Quat = (math.cos(y), 0.0, math.sin(y), 0.0)
    qz: Quat = (math.cos(z), 0.0, 0.0, math.sin(z))
    return _to_our_axes(_multiply(_multiply(qy, qx), qz))


def _to_our_axes(unity: Quat) -> Quat:
    # Swapping y and z mirrors space, so that the turn's direction flips as well.
    w, x, y, z = unity
    return (w, -x, -z, -y)


def _multiply(a: Quat, b: Quat) -> Quat:
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _rotate(q: Quat, v: Vec3) -> Vec3:
    w, x, y, z = q
    turned = _multiply(_multiply(q, (0.0, *v)), (w, -x, -y, -z))
    return turned[1:]


def _bounds_beside(root: Path) -> Mapping[str, ModelBounds]:
    for folder in (root, *root.resolve().parents[:3]):
        if (folder / "model_bounds.json").is_file():
            return read_model_bounds(folder / "model_bounds.json")
    return {}


def _read_metadata(path: Path) -> list[dict[str, Any]]:
    try:
        data = json.loads(path.read_text())
    except FileNotFoundError:
        raise BadInputError(f"{path} is missing; it holds the outcomes of the trials") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise BadInputError(f"{path} cannot be read: {error}") from error
    if not isinstance(data, list) or not all(isinstance(record, dict) for record in data):
        raise BadInputError(f"{path} is not a list with one object a trial")
    return data


_Command = dict[str, Any]
_Lists = list[tuple[int, list[_Command]]]


def _group_lines(log: Path, found: TrialSet) -> tuple[list[_Command], dict[str, _Lists]]:
    """The commands before the first trial, and (line, commands) of every frame by trial tag."""
    setup: list[_Command] = []
    frames: dict[str, _Lists] = {}
    broken: set[str] = set()
    size = 0
    opener: Callable[..., Any] = gzip.open if log.suffix == ".gz" else open
    try:
        with opener(log, "rt", encoding="utf-8") as lines:
            for number, line in enumerate(lines, 1):
                size += len(line)
                if size > MAX_LOG_BYTES:
                    raise BadInputError(f"{log} is larger than {MAX_LOG_BYTES} bytes unpacked")
                tag = _tag(line)
                try:
                    commands = _parse_line(line)
                except BadInputError as error:
                    if not line.strip():
                        continue
                    broken.add(tag)
                    found.failures.append(
                        ImportFailure(str(log), tag or None, f"line {number}: {error}")
                    )
                    continue
                if tag == "None":
                    setup += commands
                else:
                    frames.setdefault(tag, []).append((number, commands))
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise BadInputError(f"{log} cannot be read to its end: {error}") from error
    if not frames:
        raise BadInputError(f"{log} holds no trial")
    for tag in broken:
        frames.pop(tag, None)
    return setup, frames


def _tag(line: str) -> str:
    match = re.search(r"trial (\S+)\s*$", line[-40:])
    return match.group(1) if match else ""


def _parse_line(line: str) -> list[_Command]:
    try:
        value, end = json.JSONDecoder().raw_decode(line.lstrip())
    except (json.JSONDecodeError, RecursionError) as error:
        raise BadInputError(f"is not JSON: {error}") from error
    commands = value if isinstance(value, list) else [value]
    if not all(isinstance(c, dict) and isinstance(c.get("$type"), str) for c in commands):
        raise BadInputError('holds something that is not a command with a "$type"')
    if not _tag(line):
        raise BadInputError('does not end in "trial N"')
    return commands


@dataclass
class _Object:
    """An object of the log while its commands are read."""

    id: int
    model: str
    category: str
    position: Vec3
    rotation: Quat
    scale: Vec3 = (1.0, 1.0, 1.0)
    mass: float | None = None
    contact: Contact = Contact(0.6, 0.6, 0.0)
    kinematic: bool = False
    drag: float = 0.0
    angular_drag: float = 0.05
    color: Vec3 | None = None
    texture: str = "plain"
    flex: bool = False
    cloth: tuple[float, float, float] | None = None
    gone: bool = False

    @property
    def name(self) -> str:
        return f"{self.model}_{self.id}"

    @property
    def vanishing(self) -> bool:
        return min(self.scale) < VANISHING_SCALE or (self.mass is not None and self.mass <= 0)


class _Reader:
    """Reads the commands of one trial. Every method named like a command carries it out."""

    def __init__(
        self,
        record: dict[str, Any],
        folder: Path,
        bounds: Mapping[str, ModelBounds],
        unknown: Counter[str],
    ) -> None:
        self.record, self.folder, self.bounds, self.unknown = record, folder, bounds, unknown
        self.objects: dict[int, _Object] = {}
        self.pushes: list[tuple[int, Push]] = []
        self.joints: list[tuple[int, int]] = []
        self.eye: Vec3 = (0.0, -3.0, 1.0)
        self.target: Vec3 = (0.0, 0.0, 0.5)
        self.fov = math.radians(55.0)
        self.room = "empty"
        self.frame = 0
        self.settles = False
        self.notes: list[str] = []

    def read(self, setup: list[_Command], lists: _Lists) -> ImportedTrial:
        for command in setup:
            self._carry_out(command, "the set-up before the first trial")
        for frame, (line, commands) in enumerate(lists):
            self.frame = frame
            # The last lists only clean up for the next trial.
            if frame and commands and all("destroy" in c["$type"] for c in commands):
                break
            for command in commands:
                self._carry_out(command, f"line {line}")
        return ImportedTrial(self._scene(), self._outcome(), tuple(self.notes))

    def _carry_out(self, command: _Command, where: str) -> None:
        kind = command["$type"]
        if kind in IGNORED_COMMANDS:
            return
        method = getattr(self, f"do_{kind}", None)
        if method is None:
            self.unknown[kind] += 1
            return
        try:
            method(command)
        except PhysionError as error:
            raise BadInputError(f"{where}: {kind}: {error}") from error
        except KeyError as error:
            raise BadInputError(f"{where}: {kind} has no {error}") from error
        except (TypeError, ValueError, AttributeError) as error:
            raise BadInputError(f"{where}: {kind}: {error}") from error

    def _object(self, command: _Command, key: str = "id") -> _Object:
        thing = self.objects.get(command[key])
        if thing is None:
            raise BadInputError(f"object {command[key]} was never created")
        return thing

    def _at_start(self) -> None:
        if self.frame:
            raise BadInputError(f"comes at frame {self.frame}; only pushes may come later than 0")

    # Commands, one method each.

    def do_add_scene(self, command: _Command) -> None:
        name = command["name"]
        if name not in ROOMS:
            self.notes.append(f"room {name!r} is not modelled; the empty room stands in")
        self.room = ROOMS.get(name, "empty")

    def do_set_field_of_view(self, command: _Command) -> None:
        self.fov = math.radians(float(command["field_of_view"]))

    def do_teleport_avatar_to(self, command: _Command) -> None:
        self.eye = vector(command["position"])

    def do_look_at_position(self, command: _Command) -> None:
        self.target = vector(command["position"])

    def do_add_object(self, command: _Command) -> None:
        self._at_start()
        self.objects[int(command["id"])] = _Object(
            int(command["id"]),
            str(command["name"]),
            str(command.get("category", "")),
            vector(command["position"]),
            quaternion_from_euler(command["rotation"]),
        )

    def do_destroy_object(self, command: _Command) -> None:
        self._at_start()
        self._object(command).gone = True

    do_destroy_flex_object = do_destroy_object

    def do_scale_object(self, command: _Command) -> None:
        self._at_start()
        thing, factor = self._object(command), vector(command["scale_factor"])
        thing.scale = tuple(a * b for a, b in zip(thing.scale, factor, strict=True))  # type: ignore[assignment]

    def do_teleport_object(self, command: _Command) -> None:
        self._at_start()
        self._object(command).position = vector(command["position"])

    def do_rotate_object_to(self, command: _Command) -> None:
        self._at_start()
        q = command["rotation"]
        unity = (float(q["w"]), float(q["x"]), float(q["y"]), float(q["z"]))
        self._object(command).rotation = _to_our_axes(unity)

    def do_rotate_object_to_euler_angles(self, command: _Command) -> None:
        self._at_start()
        self._object(command).rotation = quaternion_from_euler(command["euler_angles"])

    def do_rotate_object_by(self, command: _Command) -> None:
        self._at_start()
        axis = {"pitch": "x", "yaw": "y", "roll": "z"}[command.get("axis", "yaw")]
        turn = {"x": 0.0, "y": 0.0, "z": 0.0, axis: float(command["angle"])}
        thing, by = self._object(command), quaternion_from_euler(turn)
        world = bool(command.get("is_world", True))
        thing.rotation = _multiply(by, thing.rotation) if world else _multiply(thing.rotation, by)

    def do_set_mass(self, command: _Command) -> None:
        self._at_start()
        self._object(command).mass = float(command["mass"])

    def do_set_physic_material(self, command: _Command) -> None:
        self._at_start()
        self._object(command).contact = Contact(
            float(command["static_friction"]),
            float(command["dynamic_friction"]),
            float(command["bounciness"]),
        )

    def do_set_kinematic_state(self, command: _Command) -> None:
        self._at_start()
        self._object(command).kinematic = bool(command.get("is_kinematic", False))

    def do_set_object_drag(self, command: _Command) -> None:
        self._at_start()
        thing = self._object(command)
        thing.drag, thing.angular_drag = float(command["drag"]), float(command["angular_drag"])

    def do_apply_force_at_position(self, command: _Command) -> None:
        self._push(command, vector(command["position"]))

    def do_apply_force_to_object(self, command: _Command) -> None:
        self._push(command, None)

    def _push(self, command: _Command, point: Vec3 | None) -> None:
        thing, impulse = self._object(command), vector(command["force"])
        if any(impulse):
            self.pushes.append((thing.id, Push(thing.name, impulse, point, self.frame)))

    def do_add_fixed_joint(self, command: _Command) -> None:
        self._at_start()
        self.joints.append((self._object(command, "parent_id").id, self._object(command).id))

    def do_set_color(self, command: _Command) -> None:
        c = command["color"]
        color = tuple(min(max(float(c[channel]), 0.0), 1.0) for channel in "rgb")
        self._object(command).color = color  # type: ignore[assignment]

    def do_set_visual_material(self, command: _Command) -> None:
        self._object(command).texture = _texture(str(command["material_name"]))

    def do_set_flex_solid_actor(self, command: _Command) -> None:
        self._object(command).flex = True
        self.settles = True

    def do_set_flex_cloth_actor(self, command: _Command) -> None:
        thing = self._object(command)
        thing.flex = True
        thing.cloth = (
            float(command["stretch_stiffness"]),
            float(command["bend_stiffness"]),
            float(command["tether_stiffness"]),
        )

    def do_set_flex_object_mass(self, command: _Command) -> None:
        self._object(command).mass = float(command["mass"])

    # The scene.

    def _scene(self) -> Scene:
        kept: list[_Object] = []
        for thing in self.objects.values():
            if thing.gone:
                continue
            if thing.vanishing:
                self.notes.append(f"{thing.name} has no size or no mass and is left out")
                continue
            kept.append(thing)
        ids = {thing.id for thing in kept}
        scenario = self._scenario()
        pushes = tuple(push for id_, push in self.pushes if id_ in ids)
        names = {thing.id: thing.name for thing in kept}
        index = self.record.get("trial_num", self.record.get("stimulus_name"))
        return Scene(
            name=str(self.record.get("stimulus_name") or f"{self.folder.name}_{index}"),
            scenario=scenario,
            bodies=tuple(self._body(thing) for thing in kept if thing.cloth is None),
            cloths=tuple(self._cloth(thing) for thing in kept if thing.cloth is not None),
            pushes=pushes,
            joints=tuple(
                Joint(names[a], names[b]) for a, b in self.joints if a in ids and b in ids
            ),
            roles=self._roles(kept, pushes),
            camera=Camera(self.eye, self.target, self.fov),
            room=self.room,
            ending=Ending(151, self._max_frames(scenario)),
            settle_frames=FLEX_SETTLE_FRAMES if self.settles else 0,
            parameters={
                "source": "official command log",
                "configuration": self.folder.name,
                "trial_seed": self.record.get("trial_seed"),
            },
        )

    def _scenario(self) -> str:
        controller = str(self.record.get("controller_name"))
        if "rolling" in self.folder.name.lower():
            return "roll"
        if controller not in SCENARIOS:
            raise BadInputError(
                f"metadata.json names the controller {controller!r}; known: {sorted(SCENARIOS)}"
            )
        return SCENARIOS[controller]

    def _max_frames(self, scenario: str) -> int:
        by_collision = self.record.get("controller_name") == "Collision"
        return MAX_FRAMES["collide"] if by_collision else MAX_FRAMES.get(scenario, 302)

    def _roles(self, kept: list[_Object], pushes: tuple[Push, ...]) -> Roles:
        """Lowest id: the zone. Id 2: the target, or, where it is gone, the last of its colour."""
        by_id = {thing.id: thing for thing in kept}
        if not kept:
            raise BadInputError("no object is left in the trial")
        zone = by_id[min(by_id)]
        first = self.objects.get(2)
        if first is None or zone.id == 2:
            raise BadInputError("there is no object 2, the target")
        agent: _Object | None = first
        if first.gone:
            alike = [t for t in kept if t.id > 2 and t.color == first.color]
            agent = max(alike, key=lambda t: t.id) if alike else None
        if agent is None or agent.id not in by_id:
            raise BadInputError("the target was removed and no other object has its colour")
        probe = pushes[0].body if pushes else None
        return Roles(agent=agent.name, patient=zone.name, probe=probe)

    def _look(self, thing: _Object) -> Look:
        return Look(thing.color or (0.8, 0.8, 0.8), thing.texture)

    def _body(self, thing: _Object) -> Body:
        primitive = thing.model in shapes
        shape, scale, position = thing.model, thing.scale, thing.position
        if not primitive:
            shape, scale, position = self._prop(thing)
        return Body(
            name=thing.name,
            shape=shape,
            position=position,
            scale=scale,
            rotation=thing.rotation,
            mass=1.0 if thing.mass is None else thing.mass,
            contact=thing.contact,
            # Flex solids carry their weight on the floor and do not move once settled.
            kinematic=thing.kinematic or thing.mass is None or thing.flex,
            scenery=thing.mass is None,
            drag=thing.drag,
            angular_drag=thing.angular_drag,
            look=self._look(thing),
        )

    def _prop(self, thing: _Object) -> tuple[str, Vec3, Vec3]:
        """A stand-in that fills the bounds of a library model: shape, scale, pivot."""
        bounds = self.bounds.get(thing.model)
        if bounds is None:
            self.notes.append(f"no bounds are known for {thing.model!r}; it is drawn half a metre")
            bounds = ModelBounds((0.0, 0.0, 0.0), (0.5, 0.5, 0.5))
        size = tuple(a * b for a, b in zip(bounds.size, thing.scale, strict=True))
        shift = tuple(a * b for a, b in zip(bounds.bottom, thing.scale, strict=True))
        x, y, z = _rotate(thing.rotation, shift)  # type: ignore[arg-type]
        px, py, pz = thing.position
        return prop_for(thing.category), size, (px + x, py + y, pz + z)  # type: ignore[return-value]

    def _cloth(self, thing: _Object) -> Cloth:
        assert thing.cloth is not None
        stretch, bend, tether = thing.cloth
        return Cloth(
            name=thing.name,
            position=thing.position,
            size=(2.0 * thing.scale[0], 2.0 * thing.scale[1], 0.0),
            rotation=thing.rotation,
            mass=0.5 if thing.mass is None else thing.mass,
            stretch=stretch,
            bend=bend,
            tether=tether,
            look=replace(self._look(thing), texture="cloth"),
        )

    def _outcome(self) -> Outcome:
        record = self.record
        contact = record.get("does_target_contact_zone")
        if not isinstance(contact, bool):
            raise BadInputError("metadata.json does not say does_target_contact_zone for it")
        first = record.get("first_target_contact_zone_frame")
        moved = record.get("final_target_displacement")
        return Outcome(
            contact=contact,
            first_frame=int(first) if isinstance(first, int) else None,
            frames=int(record.get("num_frames") or 0),
            displacement=vector(moved) if isinstance(moved, dict) else None,
            min_distance=record.get("minimum_distance_target_to_zone"),
        )


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
