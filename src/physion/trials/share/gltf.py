"""A trial as one binary glTF 2.0 file (GLB): meshes, colours, camera, and motion as an animation.

Blender, browsers and most 3D programs read it. All nodes hang below the node ``world``, which turns
the coordinates of the package (metres, z upwards) into the coordinates of glTF (y upwards):

- each body is a node with its mesh at unit scale, its scale, and, if it moves, its translation and
  rotation at every frame; while it is absent its scale is 0;
- a cloth is a mesh with one morph target for each key frame after the first; the animation sets
  their weights, so that the vertices are interpolated linearly between key frames;
- the camera is a node with a perspective camera.

Times are seconds of physics. ``extras`` of the glTF scene hold the time of a frame, gravity, units,
roles and, as accessors, the contacts.

References
----------
Khronos Group (2021). glTF 2.0 Specification. ISO/IEC 12113:2022.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError
from physion.core.files import write_atomic
from physion.core.version import MADE_WITH
from physion.physics.trajectory import Trajectory
from physion.rendering.triangles import solid, surface_of
from physion.scenes.scene import FRAME_TIME, GRAVITY, Camera, Look, Scene
from physion.trials.dataset import Dataset
from physion.trials.share.card import check_readme, refuse_movies, write_readme
from physion.trials.trial_file import Trial

CLOTH_KEYS = 60
"""Largest number of key frames of a cloth."""
TITLE = "# Physion trials as glTF files"
README = "One GLB file for each trial; `extras` of its scene hold the contacts and more."
UNITS = "metres, kilograms, seconds; below the node world z points upwards"

_Array = NDArray[Any]
_COMPONENTS = {"<f4": 5126, "<u2": 5123, "<u4": 5125, "<i2": 5122}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963
_TO_Y_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""Quaternion (x, y, z, w) of the quarter turn that takes z to y."""


def trial_gltf(trial: Trial) -> bytes:
    """Return a trial as a GLB file, in the colours of its movie."""
    meta, labels = trial.metadata, trial.labels
    facts = {
        "trial": meta.trial,
        "scenario": meta.scenario,
        "observed_frames": meta.observed_frames,
        "playback_rate": meta.playback_rate,
        **({"contact": labels.contact, "first_contact": labels.first_frame} if labels else {}),
    }
    return motion_gltf(
        trial.shown(),
        trial.trajectory,
        frame_time=meta.frame_time,
        aspect=meta.width / meta.height,
        facts=facts,
    )


def export_gltf(
    folder: Path,
    out: Path,
    *,
    split: str | None = None,
    scenario: str | None = None,
    verify: bool = True,
    progress: Progress | None = None,
) -> list[Path]:
    """Write trials of a dataset as ``SPLIT/SCENARIO/TRIAL.glb`` below ``out``, and a README.

    Return the paths of all files.

    ``split``, ``scenario``: only these. ``verify``: whether trial files are compared with the
    index. Raises `BadInputError` if no trial is chosen, or one is damaged or has no motion.
    """
    dataset = Dataset(folder, verify=verify)
    trials = dataset.chosen(split, scenario)
    refuse_movies(dataset.index.set_index("trial").loc[trials])
    check_readme(out, TITLE)
    made = []
    for name in tracked(trials, "glTF files", len(trials), progress):
        trial = dataset.trial(name)
        place = out / trial.metadata.split / trial.metadata.scenario
        place.mkdir(parents=True, exist_ok=True)
        write_atomic(place / f"{name}.glb", trial_gltf(trial))
        made.append(place / f"{name}.glb")
    engines = dataset.index.set_index("trial").loc[trials, "engine"]
    return [*made, write_readme(out, TITLE, README, engines)]


def motion_gltf(
    scene: Scene,
    trajectory: Trajectory,
    *,
    frame_time: float = FRAME_TIME,
    aspect: float = 1.0,
    cloth_keys: int = CLOTH_KEYS,
    cloth_side: int | None = None,
    contacts: bool = True,
    facts: Mapping[str, Any] | None = None,
) -> bytes:
    """Return a scene and its motion as a GLB file.

    Parameters
    ----------
    scene
        Bodies and cloths with the colours to show.
    trajectory
        The motion.
    frame_time
        Seconds of physics between two frames.
    aspect
        Width over height of the camera's picture.
    cloth_keys
        Largest number of key frames of a cloth; they lie evenly, with the first and last frame.
    cloth_side
        Largest number of vertices along a side of a cloth; by default all.
    contacts
        Whether the contacts are written.
    facts
        Further entries of ``extras`` of the glTF scene.

    Raises
    ------
    BadInputError
        If the trajectory does not match the cloths of the scene.
    """
    writer = _Writer()
    times = writer.add(np.arange(len(trajectory)) * frame_time, "<f4", bounds=True)
    nodes = [
        *(writer.body(scene, index, trajectory, times) for index in range(len(scene.bodies))),
        *writer.cloths(scene, trajectory, frame_time, cloth_keys, cloth_side),
        writer.camera(scene.camera, aspect),
    ]
    extras: dict[str, Any] = {
        "units": UNITS,
        "frames": len(trajectory),
        "frame_time": frame_time,
        "gravity": [0.0, 0.0, -GRAVITY],
        "floor": scene.floor,
        "roles": {"agent": scene.roles.agent, "patient": scene.roles.patient},
        **(facts or {}),
    }
    if contacts:
        extras |= {"things": scene.names(), "contacts": writer.contacts(trajectory)}
    world = writer.node({"name": "world", "rotation": _TO_Y_UP, "children": nodes})
    return writer.file(world, scene.name, extras)


@dataclass
class _Writer:
    """Binary data of a file and the lists of its parts, which refer to each other by number."""

    data: bytearray = field(default_factory=bytearray)
    parts: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    channels: list[dict[str, Any]] = field(default_factory=list)
    samplers: list[dict[str, Any]] = field(default_factory=list)
    shapes: dict[str, dict[str, Any]] = field(default_factory=dict)

    def part(self, kind: str, value: dict[str, Any]) -> int:
        """Append to the list of the name ``kind``, and return the number of what was added."""
        members = self.parts.setdefault(kind, [])
        members.append(value)
        return len(members) - 1

    def node(self, value: dict[str, Any]) -> int:
        return self.part("nodes", value)

    def add(
        self, values: _Array, kind: str, *, target: int | None = None, bounds: bool = False
    ) -> int:
        """Append an array (n,) or (n, k) and return the number of its accessor.

        ``target``: what a graphics card uses the data for; ``bounds``: whether smallest and
        largest values are written, as glTF asks for positions and times.
        """
        array = np.ascontiguousarray(values, np.dtype(kind))
        columns = array.reshape(len(array), -1)
        self.data += bytes(-len(self.data) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data)}
        view["byteLength"] = array.nbytes
        if target is not None:
            view["target"] = target
        self.data += array.tobytes()
        accessor: dict[str, Any] = {
            "bufferView": self.part("bufferViews", view),
            "componentType": _COMPONENTS[kind],
            "count": len(array),
            "type": _TYPES[columns.shape[1]],
        }
        if bounds:
            accessor["min"] = columns.min(axis=0).tolist()
            accessor["max"] = columns.max(axis=0).tolist()
        return self.part("accessors", accessor)

    def animate(
        self, node: int, path: str, times: int, values: _Array, *, steps: bool = False
    ) -> None:
        """Add a channel with values of a node at the times of an accessor: linear between them, or
        in steps.
        """
        sampler: dict[str, Any] = {"input": times, "output": self.add(values, "<f4")}
        self.samplers.append(sampler | ({"interpolation": "STEP"} if steps else {}))
        target = {"node": node, "path": path}
        self.channels.append({"sampler": len(self.samplers) - 1, "target": target})

    def material(self, look: Look, *, two_sided: bool = False) -> int:
        """Add a material; the file holds linear colours."""
        value: dict[str, Any] = {
            "pbrMetallicRoughness": {
                "baseColorFactor": [*(_linear(part) for part in look.color), 1.0],
                "metallicFactor": 0.0,
                "roughnessFactor": 0.8,
            }
        }
        return self.part("materials", value | ({"doubleSided": True} if two_sided else {}))

    def shape(self, name: str) -> dict[str, Any]:
        """Return a primitive with the mesh of a shape at unit scale, added once."""
        if name not in self.shapes:
            part = solid(surface_of(name), np.ones(3), 0)
            # A vertex on a crease occurs once for each side.
            normals = part.normals.reshape(-1, 3).astype(np.float32)
            corners = np.column_stack([part.faces.reshape(-1, 1), np.round(normals, 5)])
            _, first, index = np.unique(corners, axis=0, return_index=True, return_inverse=True)
            points = part.vertices[part.faces.reshape(-1)[first]]
            attributes = {
                "POSITION": self.add(points, "<f4", target=_VERTICES, bounds=True),
                "NORMAL": self.add(normals[first], "<f4", target=_VERTICES),
            }
            indices = self.add(index.reshape(-1), "<u4", target=_INDICES)
            self.shapes[name] = {"attributes": attributes, "indices": indices}
        return self.shapes[name]

    def body(self, scene: Scene, index: int, trajectory: Trajectory, times: int) -> int:
        """Add a body with its motion, and return its node."""
        body = scene.bodies[index]
        primitive = self.shape(body.shape) | {"material": self.material(body.look)}
        positions = np.nan_to_num(trajectory.positions[:, index])
        rotations = _turns(trajectory.rotations[:, index])
        node = self.node(
            {
                "name": body.name,
                "mesh": self.part("meshes", {"name": body.shape, "primitives": [primitive]}),
                "translation": positions[0].tolist(),
                "rotation": rotations[0].tolist(),
                "scale": [float(value) for value in body.scale],
                "extras": {
                    "shape": body.shape, "mass": body.mass, "fixed": body.kinematic,
                    "scenery": body.scenery, "role": role_of(scene, body.name),
                },
            }
        )  # fmt: skip
        for path, values in (("translation", positions), ("rotation", rotations)):
            if np.any(values != values[0]):
                self.animate(node, path, times, values)
        events = scene.events
        there = np.array([not events or scene.present(at)[index] for at in range(len(trajectory))])
        if not there.all():
            # glTF has no visibility: what is absent has no size.
            self.animate(node, "scale", times, np.outer(there, body.scale), steps=True)
        return node

    def cloths(
        self, scene: Scene, trajectory: Trajectory, frame_time: float, most: int, side: int | None
    ) -> list[int]:
        """Add all cloths, and return their nodes."""
        keys = evenly(len(trajectory), most)
        times = self.add(keys * frame_time, "<f4", bounds=True) if scene.cloths else 0
        nodes, first = [], 0
        for cloth in scene.cloths:
            whole = cloth.resolution
            sheet = trajectory.cloth_vertices[:, first : first + whole * whole]
            first += whole * whole
            if sheet.shape[1] != whole * whole:
                raise BadInputError(f"scene {scene.name!r}: cloth {cloth.name!r} lacks vertices")
            kept = evenly(whole, side or whole)
            grid = sheet.reshape(len(trajectory), whole, whole, 3)[keys][:, kept][:, :, kept]
            points = np.nan_to_num(grid.reshape(len(keys), -1, 3).astype(np.float32))
            # Without normals a viewer shades each triangle by itself, also while it moves.
            primitive: dict[str, Any] = {
                "attributes": {
                    "POSITION": self.add(points[0], "<f4", target=_VERTICES, bounds=True)
                },
                "indices": self.add(_grid_faces(len(kept)), "<u4", target=_INDICES),
                "material": self.material(cloth.look, two_sided=True),
                "targets": [
                    {"POSITION": self.add(later - points[0], "<f4", target=_VERTICES, bounds=True)}
                    for later in points[1:]
                ],
            }
            mesh: dict[str, Any] = {"name": cloth.name, "primitives": [primitive]}
            if len(keys) == 1:
                del primitive["targets"]
            else:
                mesh["weights"] = [0.0] * (len(keys) - 1)
            extras = {"mass": cloth.mass, "cloth": True, "role": role_of(scene, cloth.name)}
            node = self.node(
                {"name": cloth.name, "mesh": self.part("meshes", mesh), "extras": extras}
            )
            if len(keys) > 1:
                weights = np.eye(len(keys), dtype=np.float32)[:, 1:]
                self.animate(node, "weights", times, weights.reshape(-1))
            nodes.append(node)
        return nodes

    def camera(self, camera: Camera, aspect: float) -> int:
        """Add the camera, and return its node, which looks along its own -z."""
        lens = {"yfov": camera.fov, "znear": camera.near, "zfar": camera.far, "aspectRatio": aspect}
        value = {"type": "perspective", "perspective": lens}
        return self.node(
            {
                "name": "camera",
                "camera": self.part("cameras", value),
                "translation": [float(part) for part in camera.position],
                "rotation": _looking(camera).tolist(),
                "extras": {"target": [float(part) for part in camera.target]},
            }
        )

    def contacts(self, trajectory: Trajectory) -> dict[str, int]:
        """Add the contacts, and return the accessors by name, or nothing without contacts."""
        rows = trajectory.contacts
        if not len(rows.frame):
            return {}
        kinds = {"frame": "<u4", "bodies": "<i2", "point": "<f4", "normal": "<f4", "impulse": "<f4"}
        return {name: self.add(getattr(rows, name), kind) for name, kind in kinds.items()}

    def file(self, root: int, name: str, extras: Mapping[str, Any]) -> bytes:
        """Return the whole file: header, JSON chunk, binary chunk."""
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": MADE_WITH},
            "scene": 0,
            "scenes": [{"name": name, "nodes": [root], "extras": dict(extras)}],
            **self.parts,
            "buffers": [{"byteLength": len(self.data)}],
        }
        if self.channels:
            motion = {"name": "motion", "channels": self.channels, "samplers": self.samplers}
            document["animations"] = [motion]
        try:
            text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        except ValueError as error:
            raise BadInputError(f"scene {name!r}: a number is not finite: {error}") from error
        text += b" " * (-len(text) % 4)
        data = bytes(self.data) + bytes(-len(self.data) % 4)
        chunks = [
            struct.pack("<II", len(part), kind) + part
            for part, kind in ((text, 0x4E4F534A), (data, 0x004E4942))
        ]
        return struct.pack("<4sII", b"glTF", 2, 12 + sum(map(len, chunks))) + b"".join(chunks)


def role_of(scene: Scene, name: str) -> str | None:
    """Return ``agent``, ``patient``, ``probe``, or None for all other bodies."""
    roles = {scene.roles.probe: "probe", scene.roles.patient: "patient", scene.roles.agent: "agent"}
    return roles.get(name)


def evenly(count: int, most: int) -> NDArray[np.int64]:
    """Return at most ``most`` of the rows 0 to ``count`` - 1, with the first and the last."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.rint(np.linspace(0, count - 1, most)).astype(np.int64))


def _turns(rotations: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return quaternions (F, 4) from (w, x, y, z) to (x, y, z, w), of length 1, each on the side of
    the one before, so that a linear path between them is the short one.
    """
    turns = np.nan_to_num(np.roll(rotations.astype(np.float64), -1, axis=1))
    length = np.linalg.norm(turns, axis=1, keepdims=True)
    turns = np.where(length > 0, turns / np.where(length > 0, length, 1.0), [0.0, 0.0, 0.0, 1.0])
    same_side = np.einsum("ij,ij->i", turns[1:], turns[:-1]) >= 0
    signs = np.cumprod(np.concatenate([[1.0], np.where(same_side, 1.0, -1.0)]))
    return np.asarray(turns * signs[:, None])


def _looking(camera: Camera) -> NDArray[np.float64]:
    """Return the rotation (x, y, z, w) of a camera that looks at its target, upright in z."""
    back = np.subtract(camera.position, camera.target).astype(np.float64)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    # Straight up or down there is no upright: y is taken.
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-9 else np.eye(3)[0]
    axes = np.column_stack([right, np.cross(back, right), back])
    return np.asarray(Rotation.from_matrix(axes).as_quat())


def _grid_faces(side: int) -> NDArray[np.int64]:
    """Return the corners of the triangles of a square grid of vertices, one after the other."""
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1, 1)
    return np.asarray((corner + np.array([0, side, side + 1, 0, side + 1, 1])).reshape(-1))


def _linear(value: float) -> float:
    """Return a part of a colour of a picture (sRGB, 0..1) as a linear one."""
    value = min(max(float(value), 0.0), 1.0)
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
