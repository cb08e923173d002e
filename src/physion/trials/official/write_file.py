"""Export of one trial as an official HDF5 file: static group, frames, and additional fields.

Names, shapes, types and encodings follow docs/official-system.md, section 4, with gzip only. Static
arrays have one entry per object, but masses and frictions end before scenery, which comes last. Ids
and counts are int64, texts of variable length; colours, masses, frictions and contacts are float64,
other measures float32, as the official writer makes them. What the official layout does not provide
is stored under ``physion/``: the scene, labels and metadata as JSON, the record for
``metadata.json``, and the flow in pixels (``flow``: (frames, rows, columns, 2), right and down,
half precision).
"""

from __future__ import annotations

import dataclasses
import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from physion.core.names import CONTROLLERS
from physion.core.version import __version__
from physion.physics.labels import contact_frames
from physion.physics.rigid.bodies import center_of_mass
from physion.rendering.camera import axes
from physion.rendering.renderer import Frame, Renderer
from physion.scenes.scene import Cloth
from physion.trials.official.names import (
    CLOTH_DISTANCE,
    RAMPS,
    ROOMS,
    encode_depth,
    encode_flow,
    encode_normals,
    rotation_matrices,
    segmentation_colors,
    shown_name,
    swap_angular_velocity,
    swap_axes,
    to_official_camera,
    to_official_euler,
    to_official_rotation,
)
from physion.trials.official.write_objects import (
    GZIP_LEVEL,
    ContactRecords,
    OfficialObjects,
    ParticleArrays,
    flex_groups,
    link,
    model_name,
    new_group,
    put,
    put_bytes,
    put_picture,
)
from physion.trials.trial_file import Trial

# Pictures of one frame, encoded as in the official files.

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_RGB8 = (8, 2, 0, 0, 0)
"""PNG header: 8 bits, red green blue, deflate, adaptive filters, not interlaced."""
_UP = 2
"""PNG filter that stores the difference to the pixel above."""


def write_pictures(
    group: Any,
    images: Frame,
    ids: NDArray[np.int16],
    colors: NDArray[np.uint8],
    view: NDArray[np.float64],
) -> None:
    """Write the group ``images`` of a frame.

    - ``group``: group of h5py's lower layer.
    - ``images``: passes color, depth, normals and flow of the frame.
    - ``ids``: official object ids (H, W), 0 the room.
    - ``colors``: colours (objects + 1, 3) by official object id.
    - ``view``: axes of the camera (3, 3), see `encode_normals`.
    """
    assert images.color is not None and images.depth is not None
    assert images.normals is not None and images.flow is not None
    pictures = {
        "_img": images.color,
        "_id": colors[ids],
        "_normals": encode_normals(images.normals, view),
        "_flow": encode_flow(images.flow),
    }
    for name, picture in pictures.items():
        put_bytes(group, name, encode_rgb(picture))
    put_picture(group, "_depth", encode_depth(images.depth))


def encode_rgb(picture: NDArray[np.uint8]) -> bytes:
    """Return the bytes of a PNG file of ``picture`` (H, W, 3), made fast.

    One filter for all rows takes half the time of the choice of a filter for each row that
    `physion.trials.files.encode_png` makes, for 10 % more bytes.
    """
    height, width, channels = picture.shape
    rows = np.ascontiguousarray(picture).reshape(height, width * channels)
    filtered = np.empty((height, 1 + rows.shape[1]), np.uint8)
    filtered[:, 0] = _UP
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
    header = struct.pack(">IIBBBBB", width, height, *_RGB8)
    body = zlib.compress(filtered.tobytes(), 1)
    chunks = ((b"IHDR", header), (b"IDAT", body), (b"IEND", b""))
    return _SIGNATURE + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    checksum = zlib.crc32(data, zlib.crc32(kind))
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)


# Groups ``frames/%04d/`` of an official file: objects, contacts, labels, camera and pictures.
#
# All arrays are computed for the whole trial at once, and then written frame by frame.

PASSES = ("color", "depth", "normals", "ids", "flow")
MOVED = 0.01
"""Displacement in metres from which a target counts as moved."""
FALLEN = 0.5
"""Fraction of its initial height below which the top of a tower counts as fallen."""

Labels = Mapping[str, NDArray[Any]]


class FrameWriter:
    """Writer of the frames of one trial; ``labels`` has the values of every frame by name."""

    def __init__(self, objects: OfficialObjects, width: int, height: int) -> None:
        self.objects = objects
        self._contacts = ContactRecords(objects)
        self._arrays = _object_arrays(objects)
        self.labels: Labels = _labels(objects, self._contacts.on_floor)
        self._particles = ParticleArrays(objects) if objects.scene.cloths else None
        self._colors = np.concatenate(
            [np.zeros((1, 3), np.uint8), segmentation_colors(len(objects))]
        )
        self._view = axes(objects.scene.camera)
        camera, projection = to_official_camera(objects.scene.camera, width, height)
        self._written: dict[str, tuple[bytes, Any]] = {}
        self._matrices = {
            "camera_matrix": camera.astype(np.float32).ravel(),
            "projection_matrix": projection.astype(np.float32).ravel(),
        }

    def add(self, frames: h5py.Group, frame: int, images: Frame | None) -> None:
        """Write ``frames/<frame>``; ``images`` holds all of `PASSES`, None leaves pictures out."""
        group = new_group(frames.id, f"{frame:04d}")
        if images is not None:
            assert images.ids is not None
            pictures = new_group(group, "images")
            ids = self.objects.official_ids(images.ids)
            write_pictures(pictures, images, ids, self._colors, self._view)
        objects = new_group(group, "objects")
        for name, values in self._arrays.items():
            self._put(objects, name, values[frame])
        self._contacts.write(group, frame)
        matrices = new_group(group, "camera_matrices")
        for name, matrix in self._matrices.items():
            self._put(matrices, name, matrix)
        labels = new_group(group, "labels")
        for name, values in self.labels.items():
            self._put(labels, name, values[frame])
        if self._particles is not None:
            self._particles.write(group, frame)

    def _put(self, group: Any, name: str, values: NDArray[Any]) -> None:
        """Write an array, or link the array of the last frame if it has the same bytes.

        A link takes a fourth of the time. Objects rest, the camera always does, labels hardly ever
        change.
        """
        data = values.tobytes()
        last = self._written.get(name)
        if last is not None and last[0] == data:
            link(group, name, last[1])
        else:
            self._written[name] = (data, put(group, name, values))


def _object_arrays(objects: OfficialObjects) -> dict[str, NDArray[np.float32]]:
    """Return the arrays (F, N, 3 or 4) of the group ``objects`` by name."""
    positions, rotations = objects.poses
    velocities, angular_velocities = objects.motions
    arrays = {
        "positions": swap_axes(positions),
        "rotations": to_official_rotation(rotations),
        "forwards": swap_axes(rotation_matrices(rotations)[..., 1]),
        "velocities": swap_axes(velocities),
        "angular_velocities": swap_angular_velocity(angular_velocities),
        **{side: swap_axes(at) for side, at in objects.boxes.items()},
    }
    return {name: values.astype(np.float32) for name, values in arrays.items()}


def _labels(objects: OfficialObjects, on_floor: NDArray[np.bool_]) -> Labels:
    """Return the labels of all frames (F, ...) by name."""
    scene, trajectory = objects.scene, objects.trajectory
    frames = len(trajectory)
    last = np.arange(frames) == frames - 1
    completed, always = bool(trajectory.completed), np.ones(frames, bool)
    touching = np.zeros(frames, bool)
    touching[contact_frames(scene, trajectory)] = True
    found: dict[str, NDArray[Any]] = {
        "trial_end": last,
        "trial_timeout": last & (not completed),
        "trial_complete": last & completed,
        "has_target": always,
        "has_zone": always,
        "target_contacting_zone": touching,
    }
    target = scene.index(scene.roles.agent)
    if target < len(scene.bodies):
        # As in the originals, cloths have no such labels.
        moved = trajectory.positions[:, target] - trajectory.positions[0, target]
        found["target_delta_position"] = swap_axes(moved).astype(np.float32)
        found["target_has_moved"] = np.linalg.norm(moved, axis=1) > MOVED
        found["target_on_ground"] = on_floor
    if scene.cloths:
        gaps = trajectory.cloth_distance + CLOTH_DISTANCE
        found["minimum_distance_target_to_zone"] = gaps.astype(np.float32)
    if scene.scenario == "support":
        tops = _tower_tops(objects)
        found["did_fall"] = tops < FALLEN * tops[0]
    return found


def _tower_tops(objects: OfficialObjects) -> NDArray[np.float64]:
    """Return the heights (F,) in metres of the top of the tower on the zone, without the probe."""
    scene = objects.scene
    stack = [*objects.middle, *(b for b in scene.bodies if b.name == scene.roles.agent)]
    rows = [objects.ids[body.name] - 1 for body in stack]
    if not rows:
        return np.zeros(len(objects.trajectory))
    boxes = {side: heights[:, rows, 2] for side, heights in objects.boxes.items()}
    center = boxes["center"]
    reach = sum(np.abs(boxes[side] - center) for side in ("front", "left", "top"))
    return np.asarray((center + reach).max(axis=1))


# Records of trials for ``metadata.json`` and ``trial_stats.json``.
#
# Keys, definitions and roundings are the official ones (docs/official-system.md, section 4.3),
# except that a room is called by its name (``box``, not ``b'box'``) and that where an object is
# not to be seen its place in the picture is null.

HIDDEN = 0.005
"""Fraction of the picture, rounded to 3 digits as officially, below which an object counts as fully
occluded."""


def trial_record(
    objects: OfficialObjects,
    labels: Labels,
    first: NDArray[np.int16],
    last: NDArray[np.int16] | None,
    static: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the record of one trial.

    - ``objects``, ``labels``: objects of the trial, and the labels of all frames (F, ...) by name.
    - ``first``, ``last``: official object ids by pixel (H, W), 0 the room, of the first and the
      last frame; the last may be None, if nothing was rendered.
    - ``static``: scalars of the static group.
    """
    scene, frames = objects.scene, len(objects.trajectory)
    ids, roles = objects.ids, scene.roles
    target = ids[roles.agent]
    moves = _any(labels, "target_has_moved")
    contact = _any(labels, "target_contacting_zone")
    record: dict[str, Any] = {
        "stimulus_name": static["stimulus_name"],
        "controller_name": CONTROLLERS.get(scene.scenario, scene.scenario),
        "git_commit": static["git_commit"],
        "num_frames": frames,
        "is_trial_valid": _any(labels, "trial_end"),
        "does_target_move": moves,
        "does_target_contact_zone": contact,
        "does_target_miss_zone": None if moves is None else moves and not contact,
        "does_target_hit_ground": _any(labels, "target_on_ground"),
        "first_target_move_frame": _first(labels, "target_has_moved"),
        "first_target_contact_zone_frame": _first(labels, "target_contacting_zone"),
        "first_target_hit_ground_frame": _first(labels, "target_on_ground"),
        "final_target_displacement": _displacement(labels),
        "final_target_mask_displacement": None
        if last is None
        else _shift(first == target, last == target),
        "target_visible_area": _area(first == target),
        "zone_visible_area": _area(first == ids[roles.patient]),
        "probe_visible_area": _area(first == ids[roles.probe]) if roles.probe else None,
        "is_any_object_fully_occluded": any(_area(first == id_) < HIDDEN for id_ in ids.values()),
        "room": ROOMS.get(scene.room, scene.room),
        "trial_seed": static["trial_seed"],
        "trial_num": static["trial_num"],
        "push_time": static["push_time"],
        "num_distractors": len(objects.scenery["distractors"]),
        "num_occluders": len(objects.scenery["occluders"]),
    }
    if scene.scenario in ("dominoes", "support"):
        record["num_middle_objects"] = len(objects.middle)
    if scene.scenario == "dominoes":
        record["remove_middle"] = bool(scene.parameters.get("remove_middle", False))
    if scene.scenario == "support":
        record["did_tower_fall"] = _any(labels, "did_fall")
    if scene.cloths:
        gaps = [gap for gap in labels["minimum_distance_target_to_zone"] if np.isfinite(gap)]
        record["minimum_distance_target_to_zone"] = float(min(gaps)) if gaps else None
    return record


def trial_stats(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return means over the trials of a configuration; of texts the first and the last value."""
    keys = dict.fromkeys(key for record in records for key in record if key != "trial_num")
    found: dict[str, Any] = {
        f"{key}/avg_label": _average([record.get(key) for record in records]) for key in keys
    }
    return {**found, "num_trials": len(records)}


def _average(values: Sequence[Any]) -> Any:
    known = [value for value in values if value is not None]
    if not known:
        return None
    if isinstance(known[0], str):
        return known[0] if len(set(known)) == 1 else f"{min(known)}-{max(known)}"
    if isinstance(known[0], dict):
        return {
            axis: _three_decimals(np.mean([value[axis] for value in known])) for axis in known[0]
        }
    if isinstance(known[0], list):
        return [_three_decimals(mean) for mean in np.mean(np.array(known, float), axis=0)]
    return _three_decimals(np.mean(np.array(known, float)))


def _three_decimals(value: Any) -> float:
    return round(float(value), 3)


def _any(labels: Labels, name: str) -> bool | None:
    return bool(np.any(labels[name])) if name in labels else None


def _first(labels: Labels, name: str) -> int | None:
    frames = np.flatnonzero(labels.get(name, []))
    return int(frames[0]) if len(frames) else None


def _displacement(labels: Labels) -> dict[str, float] | None:
    if "target_delta_position" not in labels:
        return None
    last = labels["target_delta_position"][-1]
    return {axis: _three_decimals(value) for axis, value in zip("xyz", last, strict=True)}


def _area(mask: NDArray[np.bool_]) -> float:
    return _three_decimals(mask.mean())


def _shift(first: NDArray[np.bool_], last: NDArray[np.bool_]) -> list[float] | None:
    """Return the shift (down, right) of the centre of the target's pixels; pictures are 2 wide."""
    if not (first.any() and last.any()):
        return None
    height, width = first.shape
    middles = []
    for mask in (first, last):
        row, column = (indices.mean() for indices in np.nonzero(mask))
        middles.append((2 * row / max(height - 1, 1) - 1, 2 * column / max(width - 1, 1) - 1))
    return [_three_decimals(after - before) for before, after in zip(*middles, strict=True)]


NONE = -1
"""Id that stands for an object that a trial does not have."""
_UNSET_CONTACT = (0.5, 0.5, 0.0)
_SEED_BITS = 2**63


def official_file(
    trial: Trial, *, look: str | None = None, images: bool = True
) -> tuple[bytes, dict[str, Any]]:
    """Return the bytes of a trial's official file and its record for metadata.json.

    - ``trial``: the trial; its pictures are rendered from its state.
    - ``look``: colours of objects and pictures; by default the trial's own look.
    - ``images``: whether to write pictures and flow. The file is built in memory and has about 0.3
      MB per frame at 256 x 256 pixels with them, and 10 KB without. Without them nothing is
      rendered, and ``final_target_mask_displacement`` of the record is None.
    """
    meta, scene = trial.metadata, trial.shown(look)
    objects = OfficialObjects(scene, trial.trajectory)
    # In memory, because a full disk would crash the HDF5 library.
    with h5py.File("official", "w", driver="core", backing_store=False, block_size=2**22) as file:
        static = _static(trial, objects, look or meta.look)
        _write_static(file.create_group("static"), static, objects)
        frames = file.create_group("frames")
        writer = FrameWriter(objects, meta.width, meta.height)
        extra = file.create_group("physion")
        if images:
            last = _write_frames(writer, frames, extra, trial, trial.renderer(look=look))
        else:
            for frame in range(meta.frames):
                writer.add(frames, frame, None)
            last = None
        first = objects.official_ids(trial.ids)
        last = None if last is None else objects.official_ids(last)
        record = {**trial_record(objects, writer.labels, first, last, static), "split": meta.split}
        texts = {"scene": scene.to_json(), "record": json.dumps(record)}
        texts |= {"labels": json.dumps(dataclasses.asdict(trial.known_labels()))}
        texts |= {"metadata": json.dumps(dataclasses.asdict(meta) | {"look": look or meta.look})}
        for name, text in texts.items():
            put(extra.id, name, np.array(text.encode()))
        file.flush()
        return bytes(file.id.get_file_image()), record


def _write_frames(
    writer: FrameWriter, frames: h5py.Group, extra: h5py.Group, trial: Trial, renderer: Renderer
) -> NDArray[np.int16] | None:
    """Write all frames with pictures, and the flow in pixels; return the ids of the last frame."""
    meta = trial.metadata
    flow = extra.create_dataset(
        "flow",
        (meta.frames, meta.height, meta.width, 2),
        np.float16,
        chunks=(1, meta.height, meta.width, 2),
        compression="gzip",
        compression_opts=GZIP_LEVEL,
        shuffle=True,
    )
    ids = None
    for frame in range(meta.frames):
        images = renderer.render(frame, PASSES)
        writer.add(frames, frame, images)
        assert images.flow is not None
        with np.errstate(over="ignore"):
            flow[frame] = images.flow.astype(np.float16)
        ids = images.ids
    return ids


def _static(trial: Trial, objects: OfficialObjects, look: str) -> dict[str, Any]:
    """Return scalars and lists of the static group by name."""
    scene, meta = objects.scene, trial.metadata
    ids, roles = objects.ids, scene.roles
    ramps = [body for body in scene.bodies if body.shape in RAMPS]
    things = dict(zip(ids, objects.things, strict=True))
    found: dict[str, Any] = {
        "git_commit": f"physion {__version__}",
        "stimulus_name": shown_name(meta.trial, meta.split, look),
        "room": ROOMS.get(scene.room, scene.room),
        "seed": 0,
        "randomize": 0,
        "trial_seed": _trial_seed(trial),
        "trial_num": meta.index,
        "zone_id": ids[roles.patient],
        "target_id": ids[roles.agent],
        "probe_id": ids[roles.probe] if roles.probe else NONE,
        "ramp_id": ids[ramps[0].name] if ramps else NONE,
        "ramp_base_id": NONE,
        "ramp_base_height": float(ramps[0].position[2] - scene.floor if ramps else 0.0),
        "target_type": model_name(things[roles.agent]),
        "target_rotation": to_official_euler(things[roles.agent].rotation).astype(np.float32),
        "probe_type": model_name(things[roles.probe]) if roles.probe else "",
        "probe_mass": float(things[roles.probe].mass if roles.probe else 0.0),
        **_push(objects),
        **{
            kind: [model_name(things[name]) for name in names]
            for kind, names in objects.scenery.items()
        },
    }
    return found | _of_scenario(objects)


def _trial_seed(trial: Trial) -> int:
    """Return the low 63 bits of the trial's seed, or the seed that an imported scene had."""
    if trial.metadata.seed is not None:
        return int(trial.metadata.seed, 16) % _SEED_BITS
    seed = trial.scene.parameters.get("trial_seed")
    return seed if isinstance(seed, int) and 0 <= seed < _SEED_BITS else NONE


def _push(objects: OfficialObjects) -> dict[str, Any]:
    """Return impulse, point and frame of the first push; zeros without push."""
    scene = objects.scene
    if not scene.pushes:
        return {
            **dict.fromkeys(("push_force", "push_position"), np.zeros(3, np.float32)),
            "push_time": 0,
        }
    push = scene.pushes[0]
    point = push.point
    if point is None:
        center = center_of_mass(scene, push.body)
        point = (float(center[0]), float(center[1]), float(center[2]))
    return {
        "push_force": swap_axes(push.impulse).astype(np.float32),
        "push_position": swap_axes(point).astype(np.float32),
        "push_time": push.frame,
    }


def _of_scenario(objects: OfficialObjects) -> dict[str, Any]:
    """Return the fields that only the files of the trial's scenario have."""
    scene, ids = objects.scene, objects.ids
    agent = objects.things[ids[scene.roles.agent] - 1]
    middle = [body.shape for body in objects.middle]
    if scene.scenario == "dominoes":
        return {
            "remove_middle": bool(scene.parameters.get("remove_middle", False)),
            "middle_objects": middle,
            "middle_type": middle[0] if middle else "",
        }
    if scene.scenario == "support":
        cap = {"cap_type": model_name(agent), "use_cap": True}
        return cap | {"num_blocks": len(middle)}
    if scene.scenario == "drop":
        return {
            "drop_type": model_name(agent),
            "drop_position": swap_axes(agent.position).astype(np.float32),
            "drop_rotation": to_official_euler(agent.rotation).astype(np.float32),
        }
    if scene.scenario in ("contain", "link"):
        return _of_stack(objects)
    return {}


def _of_stack(objects: OfficialObjects) -> dict[str, Any]:
    """Return the fields of Contain and Link; ``attachent_type`` has the official spelling."""
    scene, ids = objects.scene, objects.ids
    parts = {}
    for part in ("base", "attachment"):
        found = [body for body in scene.bodies if body.name.split("_")[0] == part]
        parts[part] = found[0] if found else None
    base, attachment = parts["base"], parts["attachment"]
    taken = {part.name for part in (base, attachment) if part is not None}
    taken |= {scene.roles.patient, scene.roles.probe or ""}
    # From the lowest to the highest.
    links = sorted(
        (body for body in scene.bodies if body.name not in taken and not body.scenery),
        key=lambda body: body.position[2],
    )
    caps = [body for body in links if body.name.split("_")[0] == "cap"]
    links = [body for body in links if body not in caps]
    names = [body.name for body in links]
    agent = scene.roles.agent
    fixed = {name for joint in scene.joints for name in (joint.parent, joint.child)}
    return {
        "base_id": ids[base.name] if base else NONE,
        "use_base": base is not None,
        "base_type": base.shape if base else "",
        "attachment_id": ids[attachment.name] if attachment else NONE,
        "use_attachment": attachment is not None,
        "attachent_type": attachment.shape if attachment else "",
        "attachment_fixed": attachment is not None and attachment.name in fixed,
        "link_type": links[0].shape if links else "",
        "num_links": len(links),
        "target_link_idx": names.index(agent) if agent in names else NONE,
        "use_cap": bool(caps),
    }


def _write_static(group: h5py.Group, static: dict[str, Any], objects: OfficialObjects) -> None:
    for name, value in static.items():
        put(group.id, name, _plain(value))
    things, count, physical = objects.things, len(objects), objects.physical
    contacts = np.array(
        [
            _UNSET_CONTACT
            if isinstance(thing, Cloth)
            else (
                thing.contact.static_friction,
                thing.contact.dynamic_friction,
                thing.contact.restitution,
            )
            for thing in physical
        ]
    )
    scale = swap_axes(objects.scales)
    arrays: dict[str, Any] = {
        "object_ids": np.arange(1, count + 1, dtype=np.int64),
        "model_names": _plain(objects.models),
        "object_segmentation_colors": segmentation_colors(count),
        "initial_position": swap_axes([t.position for t in things]).astype(np.float32),
        "initial_rotation": to_official_euler([t.rotation for t in things]).astype(np.float32),
        "scale": scale.astype(np.float32),
        **{f"scale_{axis}": scale[:, index] for index, axis in enumerate("xyz")},
        "color": np.array([thing.look.color for thing in things], np.float64),
        "mass": np.array([thing.mass for thing in physical], np.float64),
        "static_friction": contacts[:, 0],
        "dynamic_friction": contacts[:, 1],
        "bounciness": contacts[:, 2],
    }
    for name, values in arrays.items():
        put(group.id, name, values)
    for name, values in flex_groups(objects).items():
        actors = group.create_group(name)
        for key, value in values.items():
            put(actors.id, key, value)
    mesh = group.create_group("mesh")
    for index in range(count):
        vertices, faces = objects.mesh(index)
        put(mesh.id, f"vertices_{index}", vertices.astype(np.float32))
        put(mesh.id, f"faces_{index}", faces.astype(np.int32))


def _plain(value: Any) -> Any:
    """Return a value for HDF5: texts and lists of texts as texts of variable length."""
    if isinstance(value, str | list):
        return np.array(value, dtype=h5py.string_dtype())
    return value
