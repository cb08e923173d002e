"""What every official command does to the objects of a trial.

`CommandReader` carries commands out, one method each; `read_logs` makes the scene of it.
Vectors and turns are brought into our axes here: (x, y, z) of Unity is (x, z, y) of ours.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

from physion.errors import BadInputError, PhysionError
from physion.numerics.rotations import multiply_quaternions
from physion.scenes.sampling.parameters import as_quaternion, euler_rotation
from physion.scenes.scene import Push, Quat, SurfaceMaterial, Vec3
from physion.scenes.tdw.log_lines import Command

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
"""Commands that change nothing here: output requests, picture settings, and engine settings that
are the same in every published log and are the defaults of our engine."""


ROOMS = {"box_room_2018": "box", "tdw_room": "bright", "archviz_house": "bright"}
TEXTURES = {"wood_european_ash": "wood_ash", "parquet_wood_red_cedar": "wood_cedar"}
VANISHING_SCALE = 1e-4
"""Bodies scaled below this are placeholders of the official generator (no attachment, an empty
end of the size gradient); they are left out and noted."""

UNSET_MATERIAL = SurfaceMaterial(0.6, 0.6, 0.0)
"""Unity's default material, for objects that were given none."""


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
    # Swapping y and z mirrors space, so that turns go the other way; two whole turns are none.
    x, y, z = (-math.fmod(angle, 720.0) for angle in vector(degrees))
    return euler_rotation(x, y, z)


def _to_our_axes(unity: Quat) -> Quat:
    # As in `quaternion_from_euler`, the direction of the turn flips.
    w, x, y, z = unity
    return (w, -x, -z, -y)


@dataclass
class LoggedObject:
    """An object of the log while its commands are read."""

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

    @property
    def name(self) -> str:
        return f"{self.model}_{self.id}"

    @property
    def vanishing(self) -> bool:
        return min(self.scale) < VANISHING_SCALE or (self.mass is not None and self.mass <= 0)


class CommandReader:
    """The state of a trial while its commands are carried out, in our axes."""

    def __init__(self, unknown: Counter[str]) -> None:
        self.unknown = unknown
        self.objects: dict[int, LoggedObject] = {}
        self.pushes: list[tuple[int, Push]] = []
        self.joints: list[tuple[int, int]] = []
        self.eye: Vec3 = (0.0, -3.0, 1.0)
        self.target: Vec3 = (0.0, 0.0, 0.5)
        self.fov = math.radians(55.0)
        self.room = "empty"
        self.frame = 0
        self.settles = False
        self.notes: list[str] = []

    def read(self, setup: list[Command], frames: list[tuple[int, list[Command]]]) -> None:
        """Carry out the set-up, then (line, commands) of every frame."""
        for command in setup:
            self._carry_out(command, "the set-up before the first trial")
        for frame, (line, commands) in enumerate(frames):
            self.frame = frame
            # The last lists only clean up for the next trial.
            if frame and commands and all("destroy" in c["$type"] for c in commands):
                break
            for command in commands:
                self._carry_out(command, f"line {line}")

    def _carry_out(self, command: Command, where: str) -> None:
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

    def _object(self, command: Command, key: str = "id") -> LoggedObject:
        thing = self.objects.get(command[key])
        if thing is None:
            raise BadInputError(f"object {command[key]} was never created")
        return thing

    def _at_start(self) -> None:
        if self.frame:
            raise BadInputError(f"comes at frame {self.frame}; only pushes may come later than 0")

    # Commands, one method each.

    def do_add_scene(self, command: Command) -> None:
        name = command["name"]
        if name not in ROOMS:
            self.notes.append(f"room {name!r} is not modelled; the empty room stands in")
        self.room = ROOMS.get(name, "empty")

    def do_set_field_of_view(self, command: Command) -> None:
        self.fov = math.radians(float(command["field_of_view"]))

    def do_teleport_avatar_to(self, command: Command) -> None:
        self.eye = vector(command["position"])

    def do_look_at_position(self, command: Command) -> None:
        self.target = vector(command["position"])

    def do_add_object(self, command: Command) -> None:
        self._at_start()
        self.objects[int(command["id"])] = LoggedObject(
            int(command["id"]),
            str(command["name"]),
            str(command.get("category", "")),
            vector(command["position"]),
            quaternion_from_euler(command["rotation"]),
        )

    def do_destroy_object(self, command: Command) -> None:
        self._at_start()
        self._object(command).gone = True

    do_destroy_flex_object = do_destroy_object

    def do_scale_object(self, command: Command) -> None:
        self._at_start()
        thing, factor = self._object(command), vector(command["scale_factor"])
        thing.scale = tuple(a * b for a, b in zip(thing.scale, factor, strict=True))  # type: ignore[assignment]

    def do_teleport_object(self, command: Command) -> None:
        self._at_start()
        self._object(command).position = vector(command["position"])

    def do_rotate_object_to(self, command: Command) -> None:
        self._at_start()
        q = command["rotation"]
        unity = (float(q["w"]), float(q["x"]), float(q["y"]), float(q["z"]))
        self._object(command).rotation = _to_our_axes(unity)

    def do_rotate_object_to_euler_angles(self, command: Command) -> None:
        self._at_start()
        self._object(command).rotation = quaternion_from_euler(command["euler_angles"])

    def do_rotate_object_by(self, command: Command) -> None:
        self._at_start()
        axis = {"pitch": "x", "yaw": "y", "roll": "z"}[command.get("axis", "yaw")]
        angles = {"x": 0.0, "y": 0.0, "z": 0.0, axis: float(command["angle"])}
        thing, by = self._object(command), quaternion_from_euler(angles)
        world = bool(command.get("is_world", True))
        factors = (by, thing.rotation) if world else (thing.rotation, by)
        thing.rotation = as_quaternion(multiply_quaternions(*factors))

    def do_set_mass(self, command: Command) -> None:
        self._at_start()
        self._object(command).mass = float(command["mass"])

    def do_set_physic_material(self, command: Command) -> None:
        self._at_start()
        self._object(command).contact = SurfaceMaterial(
            float(command["static_friction"]),
            float(command["dynamic_friction"]),
            float(command["bounciness"]),
        )

    def do_set_kinematic_state(self, command: Command) -> None:
        self._at_start()
        self._object(command).kinematic = bool(command.get("is_kinematic", False))

    def do_set_object_drag(self, command: Command) -> None:
        self._at_start()
        thing = self._object(command)
        thing.drag, thing.angular_drag = float(command["drag"]), float(command["angular_drag"])

    def do_apply_force_at_position(self, command: Command) -> None:
        self._push(command, vector(command["position"]))

    def do_apply_force_to_object(self, command: Command) -> None:
        self._push(command, None)

    def _push(self, command: Command, point: Vec3 | None) -> None:
        thing, impulse = self._object(command), vector(command["force"])
        if any(impulse):
            self.pushes.append((thing.id, Push(thing.name, impulse, point, self.frame)))

    def do_add_fixed_joint(self, command: Command) -> None:
        self._at_start()
        self.joints.append((self._object(command, "parent_id").id, self._object(command).id))

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
        thing.flex = True
        thing.cloth = (
            float(command["stretch_stiffness"]),
            float(command["bend_stiffness"]),
            float(command["tether_stiffness"]),
        )

    def do_set_flex_object_mass(self, command: Command) -> None:
        self._object(command).mass = float(command["mass"])


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
