"""The glTF file of a trial, read by hand and by trimesh, has the vertices of the trial."""

from __future__ import annotations

import dataclasses
import io
import json
import struct
from typing import Any

import numpy as np
import pytest
import trimesh

from physion.cli.main import main
from physion.core.errors import BadInputError
from physion.numerics.rotations import rotate_vectors
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import GRAVITY, BodyEvent, Scene
from physion.scenes.shapes.primitives import shape
from physion.trials.dataset import Dataset
from physion.trials.share.gltf import export_gltf, motion_gltf, trial_gltf
from physion.trials.trial_file import Trial
from support.viewer_dataset import FRAMES, PLANS, make_dataset, make_scene, make_trajectory

KINDS = {5126: "<f4", 5123: "<u2", 5125: "<u4", 5122: "<i2"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
BALL, SHEET = PLANS[0], PLANS[3]


class File:
    """A GLB file, read by hand."""

    def __init__(self, data: bytes) -> None:
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON" and size % 4 == 0
        self.json: dict[str, Any] = json.loads(data[20 : 20 + size])
        rest, kind = struct.unpack_from("<I4s", data, 20 + size)
        self.binary = data[28 + size :]
        assert kind == b"BIN\0" and rest == len(self.binary) and rest % 4 == 0

    def array(self, accessor: int) -> np.ndarray:
        """The values of an accessor (n, k); its bounds must be those of the values."""
        about = self.json["accessors"][accessor]
        view = self.json["bufferViews"][about["bufferView"]]
        kind, width = np.dtype(KINDS[about["componentType"]]), WIDTHS[about["type"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == about["count"] * width * kind.itemsize
        assert view["byteOffset"] + view["byteLength"] <= len(self.binary)
        flat = np.frombuffer(self.binary, kind, about["count"] * width, view["byteOffset"])
        values = flat.reshape(-1, width)
        if "min" in about:
            np.testing.assert_array_equal(values.min(axis=0), np.float32(about["min"]))
            np.testing.assert_array_equal(values.max(axis=0), np.float32(about["max"]))
        return values

    def node(self, name: str) -> dict[str, Any]:
        return next(node for node in self.json["nodes"] if node["name"] == name)

    def motion(self, name: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Times and values of the animated properties of a node."""
        (animation,) = self.json["animations"]
        number = self.json["nodes"].index(self.node(name))
        found = {}
        for channel in animation["channels"]:
            if channel["target"]["node"] == number:
                sampler = animation["samplers"][channel["sampler"]]
                times, values = self.array(sampler["input"]), self.array(sampler["output"])
                found[channel["target"]["path"]] = (times[:, 0], values)
        return found

    def points(self, name: str) -> np.ndarray:
        mesh = self.json["meshes"][self.node(name)["mesh"]]
        return self.array(mesh["primitives"][0]["attributes"]["POSITION"])


def made(plan: Any = BALL, **options: Any) -> tuple[Scene, Trajectory, File]:
    scene = make_scene(plan)
    trajectory = make_trajectory(scene, plan)
    return scene, trajectory, File(motion_gltf(scene, trajectory, **options))


def y_up(points: np.ndarray) -> np.ndarray:
    """Points with z upwards in the axes of glTF."""
    return points[..., [0, 2, 1]] * [1, 1, -1]


def test_bodies_lie_where_the_trial_has_them_in_every_frame() -> None:
    scene, trajectory, file = made()
    for index, body in enumerate(scene.bodies):
        node, motion = file.node(body.name), file.motion(body.name)
        still = np.float32(node["translation"]), np.float32(node["rotation"])
        vertices = file.points(body.name) * np.float32(node["scale"])
        for frame in range(FRAMES):
            place, turn = (
                motion[path][1][frame] if path in motion else value
                for path, value in zip(("translation", "rotation"), still, strict=True)
            )
            found = rotate_vectors(turn[[3, 0, 1, 2]].astype(float), vertices) + place
            own = file.points(body.name) * body.scale
            expected = rotate_vectors(trajectory.rotations[frame, index].astype(float), own)
            expected = expected + trajectory.positions[frame, index]
            np.testing.assert_allclose(found, expected, atol=1e-5)
    assert set(file.motion("ball")) == {"translation", "rotation"}
    assert file.motion("plate") == {} == file.motion("vase")
    times = file.motion("ball")["translation"][0]
    np.testing.assert_allclose(times, np.arange(FRAMES) * 0.01, atol=1e-6)


@pytest.mark.parametrize("side", [None, 16])
def test_cloths_have_the_vertices_of_the_trial_at_the_key_frames(side: int | None) -> None:
    _, trajectory, file = made(SHEET, cloth_side=side, cloth_keys=12)
    mesh = file.json["meshes"][file.node("sheet")["mesh"]]
    (primitive,) = mesh["primitives"]
    base = file.array(primitive["attributes"]["POSITION"])
    targets = np.stack([file.array(target["POSITION"]) for target in primitive["targets"]])
    times, weights = file.motion("sheet")["weights"]
    weights = weights.reshape(len(times), len(targets))
    keys = np.rint(times / 0.01).astype(int)
    assert len(keys) == 12 and (keys[0], keys[-1]) == (0, FRAMES - 1)
    assert mesh["weights"] == [0] * len(targets) and len(targets) == 11
    found = base + np.tensordot(weights, targets, 1)
    step = 1 if side is None else 2
    grid = trajectory.cloth_vertices.reshape(FRAMES, 31, 31, 3)[keys][:, ::step, ::step]
    np.testing.assert_allclose(found, grid.reshape(len(keys), -1, 3), atol=1e-5)
    corners = file.array(primitive["indices"]).reshape(-1, 3)
    cells = (31 if side is None else 16) - 1
    assert len(corners) == 2 * cells**2 and corners.max() == (cells + 1) ** 2 - 1
    # Each triangle faces up, as the flat sheet does.
    a, b, c = (base[corners[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


@pytest.mark.parametrize("plan", [BALL, SHEET], ids=["bodies", "cloth"])
def test_trimesh_reads_the_same_scene(plan: Any) -> None:
    scene, trajectory, _ = made(plan)
    data = motion_gltf(scene, trajectory)
    read = trimesh.load(io.BytesIO(data), file_type="glb")
    for index, body in enumerate(scene.bodies):
        matrix, name = read.graph[body.name]
        found = trimesh.transform_points(read.geometry[name].vertices, matrix)
        own = np.asarray(shape(body.shape).mesh.vertices) * body.scale
        own = rotate_vectors(trajectory.rotations[0, index].astype(float), own)
        expected = y_up(own + trajectory.positions[0, index])
        # The file repeats vertices on creases, in an order of its own.
        gaps = np.linalg.norm(found[:, None] - expected[None], axis=2)
        assert gaps.min(axis=1).max() < 1e-5 and gaps.min(axis=0).max() < 1e-5
        assert read.geometry[name].volume == pytest.approx(shape(body.shape).volume, rel=1e-4)
    if scene.cloths:
        matrix, name = read.graph["sheet"]
        found = trimesh.transform_points(read.geometry[name].vertices, matrix)
        np.testing.assert_allclose(found, y_up(trajectory.cloth_vertices[0]), atol=1e-5)


def test_the_camera_looks_at_its_target_upright() -> None:
    scene, _, file = made(aspect=1.5)
    lens = file.json["cameras"][file.node("camera")["camera"]]["perspective"]
    assert (lens["yfov"], lens["aspectRatio"]) == (scene.camera.fov, 1.5)
    node = file.node("camera")
    turn = np.array(node["rotation"])[[3, 0, 1, 2]]
    forward, up = rotate_vectors(turn, np.array([[0.0, 0, -1], [0, 1, 0]]))
    wanted = np.subtract(scene.camera.target, scene.camera.position)
    np.testing.assert_allclose(forward, wanted / np.linalg.norm(wanted), atol=1e-9)
    assert abs(up @ forward) < 1e-9 and up[2] > 0


def test_extras_say_time_units_roles_and_contacts() -> None:
    scene, trajectory, file = made(facts={"trial": "drop_0"})
    (top,) = file.json["scenes"]
    extras = top["extras"]
    assert extras["gravity"] == [0, 0, -GRAVITY] and extras["frame_time"] == 0.01
    assert extras["frames"] == FRAMES and extras["trial"] == "drop_0"
    assert "metres" in extras["units"] and extras["roles"] == {"agent": "ball", "patient": "plate"}
    assert extras["things"] == scene.names()
    for name, accessor in extras["contacts"].items():
        own = getattr(trajectory.contacts, name)
        np.testing.assert_array_equal(file.array(accessor).reshape(own.shape), own)
    assert file.node("ball")["extras"]["role"] == "agent"
    assert file.node("ball")["extras"]["mass"] == 1.25
    world = file.json["nodes"][top["nodes"][0]]
    assert len(world["children"]) == len(file.json["nodes"]) - 1 == 4
    _, _, bare = made(contacts=False)
    assert "contacts" not in bare.json["scenes"][0]["extras"]


def test_turns_take_the_short_way_and_what_is_absent_has_no_size() -> None:
    scene = make_scene(BALL)
    trajectory = make_trajectory(scene, BALL)
    flipped = trajectory.rotations.copy()
    flipped[10:20, 0] *= -1
    trajectory = dataclasses.replace(trajectory, rotations=flipped)
    scene = dataclasses.replace(scene, events=(BodyEvent(30, "vase", "vanish"),))
    file = File(motion_gltf(scene, trajectory))
    turns = file.motion("ball")["rotation"][1]
    assert ((turns[1:] * turns[:-1]).sum(axis=1) > 0.99).all()
    scales = file.motion("vase")["scale"][1]
    assert (scales[:30] > 0).all() and (scales[30:] == 0).all()


def test_a_trial_of_a_dataset_is_written_with_its_outcome(tmp_path: Any) -> None:
    folder = make_dataset(tmp_path / "set", (BALL,))
    trial = Trial.open(folder / "testing" / "drop" / "drop_0.h5")
    file = File(trial_gltf(trial))
    extras = file.json["scenes"][0]["extras"]
    assert (extras["contact"], extras["first_contact"], extras["observed_frames"]) == (True, 50, 45)
    material = file.json["meshes"][file.node("ball")["mesh"]]["primitives"][0]["material"]
    red, green, blue, alpha = file.json["materials"][material]["pbrMetallicRoughness"][
        "baseColorFactor"
    ]
    assert red > 4 * max(green, blue) and alpha == 1, "the agent is red in the movie"


def test_export_writes_one_file_for_each_trial(
    tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_dataset(tmp_path / "set", (BALL, SHEET))
    command = ["export", str(folder), str(tmp_path / "out"), "--layout", "gltf"]
    assert main([*command, "--scenario", "drape"]) == 0
    (path,) = (tmp_path / "out").rglob("*.glb")
    assert path == tmp_path / "out" / "testing" / "drape" / "drape_0.glb"
    readme = tmp_path / "out" / "README.md"
    assert capsys.readouterr().out.split() == [str(path), str(readme)]
    assert "computed by the engine" in readme.read_text()
    assert path.read_bytes() == trial_gltf(Dataset(folder).trial("drape_0"))
    with pytest.raises(BadInputError, match="no trial of split readout"):
        export_gltf(folder, tmp_path / "none", split="readout")
    readme.write_text("my own")
    with pytest.raises(BadInputError, match="would be lost"):
        export_gltf(folder, tmp_path / "out")
    assert readme.read_text() == "my own"


def test_a_cloth_without_all_vertices_is_refused() -> None:
    scene = make_scene(SHEET)
    trajectory = make_trajectory(scene, SHEET)
    cut = dataclasses.replace(trajectory, cloth_vertices=trajectory.cloth_vertices[:, :-1])
    with pytest.raises(BadInputError, match="'sheet' lacks vertices"):
        motion_gltf(scene, cut)
