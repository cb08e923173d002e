"""Export of one trial as an official HDF5 file: static group, frames, and additional fields.

Names, shapes and encodings are those of docs/official-system.md, section 4, with gzip alone.
All static arrays have one entry per object (in the originals, masses and frictions lack scenery
and so do not align with the other arrays). Ids and counts are int64, measures float32. What the
official layout does not provide is stored under ``physion/``: the scene, labels and metadata as
JSON, the record for ``metadata.json``, the flow in pixels (``flow``: (frames, rows, columns, 2),
right and down, half precision), and the bytes of the trial file without passes (``trial_file``),
from which an import restores the same trial.
"""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from physion.physics.rigid.actors import center_of_mass
from physion.rendering.renderer import Renderer
from physion.scenes.scene import Cloth
from physion.trials.official.axes import swap_axes, to_official_euler
from physion.trials.official.names import RAMPS, ROOMS, TRIAL_FILE, segmentation_colors, split_name
from physion.trials.official.writing.arrays import GZIP_LEVEL, in_memory_file, put, put_bytes
from physion.trials.official.writing.flex import flex_groups
from physion.trials.official.writing.frames import PASSES, FrameWriter
from physion.trials.official.writing.metadata import trial_record
from physion.trials.official.writing.objects import OfficialObjects, model_name
from physion.trials.trial_file import Trial, TrialWriter
from physion.version import __version__

NONE = -1
"""Id that stands for an object that a trial does not have."""
_UNSET_CONTACT = (0.5, 0.5, 0.0)
_SEED_BITS = 2**63


def official_file(
    trial: Trial, *, look: str | None = None, images: bool = True
) -> tuple[bytes, dict[str, Any]]:
    """Return the bytes of a trial's official file and its record for metadata.json.

    Parameters
    ----------
    trial
        The trial; its pictures are rendered from its state.
    look
        Colours of objects and pictures; by default the trial's own look.
    images
        Whether to write pictures and flow. The file is built in memory and has about 0.3 MB per
        frame at 256 x 256 pixels with them, and 10 KB without. Without them nothing is rendered,
        and ``final_target_mask_displacement`` of the record is None.
    """
    meta, scene = trial.metadata, trial.shown(look)
    objects = OfficialObjects(scene, trial.trajectory)
    with in_memory_file() as file:
        static = _static(trial, objects)
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
        texts |= {"labels": json.dumps(dataclasses.asdict(trial.labels))}
        texts |= {"metadata": json.dumps(dataclasses.asdict(meta) | {"look": look or meta.look})}
        for name, text in texts.items():
            put(extra.id, name, np.array(text.encode()))
        whole = TrialWriter(meta, trial.scene, trial.trajectory, trial.labels, trial.ids).finish()
        # Without compression: its arrays are compressed already.
        put_bytes(file.id, TRIAL_FILE, whole)
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


def _static(trial: Trial, objects: OfficialObjects) -> dict[str, Any]:
    """Return scalars and lists of the static group by name."""
    scene, meta = objects.scene, trial.metadata
    ids, roles = objects.ids, scene.roles
    config, number = split_name(meta.trial)
    ramps = [body for body in scene.bodies if body.shape in RAMPS]
    things = dict(zip(ids, objects.things, strict=True))
    found: dict[str, Any] = {
        "git_commit": f"physion {__version__}",
        "stimulus_name": f"{config}_{number}",
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
        "ramp_base_height": np.float32(ramps[0].position[2] - scene.floor if ramps else 0.0),
        "target_type": model_name(things[roles.agent]),
        "target_rotation": to_official_euler(things[roles.agent].rotation).astype(np.float32),
        "probe_type": model_name(things[roles.probe]) if roles.probe else "",
        "probe_mass": np.float32(things[roles.probe].mass if roles.probe else 0.0),
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
    things, count = objects.things, len(objects)
    contacts = np.array(
        [
            _UNSET_CONTACT
            if isinstance(thing, Cloth)
            else (
                thing.contact.static_friction,
                thing.contact.dynamic_friction,
                thing.contact.restitution,
            )
            for thing in things
        ]
    )
    scale = swap_axes(objects.scales).astype(np.float32)
    arrays: dict[str, Any] = {
        "object_ids": np.arange(1, count + 1, dtype=np.int64),
        "model_names": np.array([name.encode() for name in objects.models]),
        "object_segmentation_colors": segmentation_colors(count),
        "initial_position": swap_axes([t.position for t in things]).astype(np.float32),
        "initial_rotation": to_official_euler([t.rotation for t in things]).astype(np.float32),
        "scale": scale,
        **{f"scale_{axis}": scale[:, index] for index, axis in enumerate("xyz")},
        "color": np.array([thing.look.color for thing in things], np.float32),
        "mass": np.array([thing.mass for thing in things], np.float32),
        "static_friction": contacts[:, 0].astype(np.float32),
        "dynamic_friction": contacts[:, 1].astype(np.float32),
        "bounciness": contacts[:, 2].astype(np.float32),
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
    """Return a value for HDF5: texts as bytes, lists of texts as arrays of bytes."""
    if isinstance(value, str):
        return np.array(value.encode() or b"\0")
    if isinstance(value, list):
        return np.array([text.encode() for text in value], dtype="S64" if not value else None)
    return value
