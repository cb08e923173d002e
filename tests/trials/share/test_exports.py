"""Exports to glTF, LeRobot and the tables of the study, read by hand and by the libraries."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import trimesh

from physion.cli.main import main
from physion.core.errors import BadInputError, MissingExtraError
from physion.numerics.rotations import rotate_vectors
from physion.physics.engine import simulate
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import GRAVITY, Body, BodyEvent, Camera, Ending, Push, Roles, Scene
from physion.scenes.shapes.primitives import shape
from physion.trials.dataset import Dataset
from physion.trials.share.card import about_states
from physion.trials.share.gltf import export_gltf, motion_gltf, trial_gltf
from physion.trials.share.lance import export_lance
from physion.trials.share.lerobot import CAMERA, actions_of, export_lerobot, states_of
from physion.trials.share.result_tables import _OURS, export_result_tables
from physion.trials.state import centroids
from physion.trials.trial_file import Trial
from support.programs import find_program
from support.viewer_dataset import FRAMES, PLANS, make_dataset, make_scene, make_trajectory

# --- glTF, read by hand and by trimesh ------------------------------------------------------------


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


# --- LeRobot, read with pyarrow as its format says ------------------------------------------------


ORDER = ["drape_0", "drop_0", "drop_1", "drop_2"]
"""Names in the order of their splits: the last one is for training."""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_dataset(tmp_path_factory.mktemp("lerobot") / "trials")


@pytest.fixture(scope="module")
def exported(source: Path) -> Path:
    out = source.parent / "out"
    assert main(["export", str(source), str(out), "--layout", "lerobot"]) == 0
    return out


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def test_episodes_are_trials_in_the_order_of_splits(source: Path, exported: Path) -> None:
    info = read(exported / "meta" / "info.json")
    assert info["codebase_version"] == "v3.0" and info["fps"] == 30
    assert (info["total_episodes"], info["total_frames"]) == (4, 4 * FRAMES)
    assert info["splits"] == {"testing": "0:3", "training": "3:4"}
    episodes = pq.read_table(exported / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["trial"] for row in episodes] == ORDER
    assert [row["contact"] for row in episodes] == [True, True, False, True]
    assert [row["first_contact_frame"] for row in episodes] == [55, 50, -1, 20]
    tasks = pq.read_table(exported / "meta/tasks.parquet").to_pandas()
    assert tasks.index.tolist() == episodes[0]["tasks"]
    for number, row in enumerate(episodes):
        assert (row["episode_index"], row["length"]) == (number, FRAMES)
        assert row["dataset_from_index"] == number * FRAMES == row["dataset_to_index"] - FRAMES
        assert row[f"videos/{CAMERA}/to_timestamp"] == pytest.approx(FRAMES / 30)
        movie = exported / info["video_path"].format(
            video_key=CAMERA,
            chunk_index=row[f"videos/{CAMERA}/chunk_index"],
            file_index=row[f"videos/{CAMERA}/file_index"],
        )
        assert movie.read_bytes() == Dataset(source).paths(row["trial"]).movie.read_bytes()


def test_the_readme_says_where_states_come_from(source: Path, exported: Path) -> None:
    text = (exported / "README.md").read_text()
    assert text.startswith("# Physion trials as a LeRobot dataset\n")
    assert text.endswith(f"\n{about_states(Dataset(source).index['engine'])}\n")


def test_frames_hold_states_pushes_and_the_outcome(source: Path, exported: Path) -> None:
    table = pq.read_table(exported / "data/chunk-000/file-000.parquet")
    info = read(exported / "meta" / "info.json")
    assert set(table.column_names) == set(info["features"]) - {CAMERA}
    rows = table.to_pandas()
    assert rows["index"].tolist() == list(range(4 * FRAMES))
    names = info["features"]["observation.state"]["names"]
    states = np.stack(rows["observation.state"]).reshape(4, FRAMES, 3, 13)
    assert names[13:17] == ["patient.x", "patient.y", "patient.z", "patient.qw"]
    path = Dataset(source).trial("drop_0").trajectory
    assert np.array_equal(states[1, :, 0, :3], path.positions[:, 0])
    assert np.array_equal(states[1, :, 0, 3:7], path.rotations[:, 0])
    assert np.array_equal(states[1, :, 1, :3], path.positions[:, 1])
    # The cloth falls from 1.2 m by a metre in 59 frames of a hundredth of a second.
    assert states[0, 0, 0, 2] == pytest.approx(1.2)
    assert states[0, 9, 0, 9] == pytest.approx(-1 / 0.59, rel=1e-4)
    actions = np.stack(rows["action"]).reshape(4, FRAMES, 7)
    center = centroids(Dataset(source).trial("drop_0"))[6, 0]
    pushed = [3.0, 4.0, 0.0, *center, 0.0]
    assert actions[1, 7] == pytest.approx(pushed)
    others = np.delete(actions[1], 7, axis=0)
    assert (others[:, :6] == 0).all() and (others[:, 6] == -1).all()
    success = rows["next.success"].to_numpy().reshape(4, FRAMES)
    assert success.sum(axis=1).tolist() == [5, 10, 0, 40]
    assert success[1].tolist() == [False] * 50 + [True] * 10
    done = rows["next.done"].to_numpy().reshape(4, FRAMES)
    assert done[:, -1].all() and done.sum() == 4
    stats = read(exported / "meta" / "stats.json")
    assert stats["observation.state"]["mean"] == pytest.approx(
        states.reshape(-1, 39).mean(axis=0, dtype=np.float64)
    )
    assert stats[CAMERA]["mean"][0][0][0] == pytest.approx(40 / 255, abs=0.01)


def test_pushes_of_one_frame_act_on_centres_after_events() -> None:
    ball, other = (
        Body(name, "sphere", (x, 0.0, 0.0), (0.2,) * 3) for name, x in (("a", 0), ("b", 2))
    )
    there = BodyEvent(3, "a", "move", (1.0, 0.0, 0.0))
    scene = Scene(
        "s", "collide", (ball, other), Roles("a", "b"), Camera((3.0, 0.0, 1.0)),
        pushes=(Push("b", (0.0, 1.0, 0.0), frame=3), Push("a", (1.0, 0.0, 0.0), frame=3),
                Push("a", (0.0, 0.0, 2.0))),
        events=(there,), ending=Ending(10, 10),
    )  # fmt: skip
    found = actions_of(scene, simulate(scene), pushes=2).reshape(-1, 2, 7)
    assert found[3, 0] == pytest.approx([0, 1, 0, 2, 0, 0.1, 1], abs=1e-5)
    assert found[3, 1] == pytest.approx([1, 0, 0, 1, 0, 0.1, 0], abs=1e-5)
    assert found[0, 0] == pytest.approx([0, 0, 2, 0, 0, 0.1, 0], abs=1e-5)
    assert (found[:, :, 6] >= 0).sum() == 3


def test_what_cannot_be_exported_is_one_line(source: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no trial of split readout"):
        export_lerobot(source, tmp_path / "out", split="readout")
    still = make_dataset(tmp_path / "still", (dataclasses.replace(PLANS[0], movies=False),))
    with pytest.raises(BadInputError, match="has no movie"):
        export_lerobot(still, tmp_path / "out")
    assert not (tmp_path / "out" / "meta").exists()


# --- tables of predictions for the notebooks of the study -----------------------------------------


DATASET_COLUMNS = ("Encoder Training Dataset", "Dynamics Training Dataset", "Readout Train Data")
NOTEBOOK_SCENARIOS = {
    "collide": "collision",
    "contain": "containment",
    "dominoes": "dominoes",
    "drape": "clothiness",
    "drop": "drop",
    "link": "linking",
    "roll": "rollingsliding",
    "support": "towers",
}


def table(path: Path) -> Path:
    rows = [
        {
            "model": "m",
            "readout": "full",
            "protocol": ("only", "all-but")[number % 2],
            "seed": "0",
            "stimulus": f"{ours}_testing_0000",
            "scenario": ours,
            "p_contact": "0.6666666666666666",
            "outcome": number % 2 == 0,
            "train_accuracy": "0.5",
            "decision": "logistic",
        }
        for number, ours in enumerate(NOTEBOOK_SCENARIOS)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_csv(path, index=False)
    return path


def test_a_training_on_one_scenario_has_its_official_name(tmp_path: Path) -> None:
    rows = pd.read_csv(table(tmp_path / "in" / "one.csv"))
    rows = rows.assign(protocol="one", dynamics_training_dataset="drape")
    rows.to_csv(tmp_path / "in" / "one.csv", index=False)
    (path,) = export_result_tables(tmp_path / "in", tmp_path / "out")
    found = pd.read_csv(path)
    same = found["Readout Test Data"] == found["Dynamics Training Dataset"]
    assert found["Dynamics Training Dataset"].nunique() == 1 and same.sum() == 1
    assert rows["scenario"][same].item() == "drape"


def test_a_predicted_outcome_that_is_given_is_kept(tmp_path: Path) -> None:
    rows = pd.read_csv(table(tmp_path / "in" / "m.csv"))
    rows["predicted"] = ["False", ""] * 4  # empty: P(contact) of .67 decides
    rows.to_csv(tmp_path / "in" / "m.csv", index=False)
    (path,) = export_result_tables(tmp_path / "in", tmp_path / "out")
    assert pd.read_csv(path)["Predicted Outcome"].tolist() == [False, True] * 4


def process_model_dataframe(frame: pd.DataFrame) -> pd.DataFrame:
    """``process_model_dataframe`` of ``analysis/analysis_helpers.py`` of the study, its selections.

    cogtoolslab/physics-benchmarking-neurips2021 at commit fd02f3f.
    """
    frame["correct"] = frame["Actual Outcome"] == frame["Predicted Outcome"]
    frame = frame.replace("rollslide", "rollingsliding").replace("cloth", "clothiness")
    frame["Canon Stimulus Name"] = frame["Stimulus Name"].apply(
        lambda name: "".join(name.split("-redyellow"))
    )
    for col in DATASET_COLUMNS:
        frame[col + " Type"] = frame[col]
        frame.loc[frame[col] == frame["Readout Test Data"], col + " Type"] = "same"
        others = ["no_" + name for name in frame["Readout Test Data"]]
        frame.loc[frame[col] == others, col + " Type"] = "all_but_this"
    return frame


def test_the_notebooks_find_every_scenario(tmp_path: Path) -> None:
    table(tmp_path / "evaluated/predictions/m.csv")
    (made,) = export_result_tables(tmp_path / "evaluated", tmp_path / "models")
    frame = pd.read_csv(made)
    assert frame["Encoder Training Dataset"].unique().tolist() == ["none"]
    found = process_model_dataframe(frame.copy())  # pandas 3 refuses texts in an empty column
    for number, (ours, theirs) in enumerate(NOTEBOOK_SCENARIOS.items()):
        (row,) = found[found["Readout Test Data"] == theirs].to_dict("records")
        assert row["Canon Stimulus Name"] == f"{ours}_testing_0000"
        assert row["Readout Train Data Type"] == "same"
        wanted = "all_but_this" if number % 2 else "same"
        assert row["Dynamics Training Dataset Type"] == wanted
        assert row["correct"] == (number % 2 == 0)
        assert (row["Readout Type"], row["Model"], row["Train Accuracy"]) == ("A", "m", 0.5)
        assert row["Predicted Prob_false"] + row["Predicted Prob_true"] == 1
    assert list(frame) == list(_OURS)
    assert "0.6666666666666666" in made.read_text()  # digits stay


def test_other_files_are_left_out_and_clashes_named(tmp_path: Path) -> None:
    (tmp_path / "e").mkdir()
    (tmp_path / "e/other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(BadInputError, match="no table of predictions"):
        export_result_tables(tmp_path / "e", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    table(tmp_path / "e/one/m.csv")
    table(tmp_path / "e/two/m.csv")
    with pytest.raises(BadInputError, match="same name"):
        export_result_tables(tmp_path / "e", tmp_path / "out")
    with pytest.raises(BadInputError, match="outside"):
        export_result_tables(tmp_path / "e", tmp_path / "e/out")
    (tmp_path / "e/empty.csv").write_text("")
    with pytest.raises(BadInputError, match=r"empty\.csv is not a table"):
        export_result_tables(tmp_path / "e", tmp_path / "out")


def test_the_verb_of_result_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table(tmp_path / "e/predictions/m.csv")
    words = ["export", str(tmp_path / "e"), str(tmp_path / "out"), "--layout", "result-tables"]
    assert main(words) == 0
    assert "m.csv" in capsys.readouterr().out and (tmp_path / "out/m.csv").is_file()
    assert main([*words, "--split", "testing"]) == 2


# --- read by the libraries, in environments of their own ------------------------------------------


SCRIPT = Path(__file__).parents[2] / "support" / "read_back.py"


def read_back(python: str, layout: str, folder: Path, home: Path) -> dict[str, Any]:
    """What the library reads of an export."""
    homes = {"HF_HOME": str(home), "HF_HUB_OFFLINE": "1", "STABLEWM_HOME": str(home)}
    done = subprocess.run(
        [python, SCRIPT, layout, folder],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | homes,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def states(folder: Path, trial: str) -> np.ndarray:
    known = Dataset(folder).trial(trial)
    return states_of(known.scene, known.trajectory, 3)


@pytest.mark.nightly
@pytest.mark.slow
def test_lerobot_reads_what_was_exported(tmp_path: Path) -> None:
    python = find_program(variable="PHYSION_LEROBOT", what="LeRobot")
    source = make_dataset(tmp_path / "trials")
    export_lerobot(source, tmp_path / "out")
    found = read_back(python, "lerobot", tmp_path / "out", tmp_path / "home")
    assert (found["episodes"], found["frames"], found["fps"]) == (4, 4 * FRAMES, 30)
    assert found["task"] == "Will the red object touch the yellow object?"
    assert found["episode"] == [0, 1, 3] and found["success"] == [False, False, True]
    for values, (trial, frame) in zip(
        found["states"], (("drape_0", 0), ("drop_0", 7), ("drop_2", FRAMES - 1)), strict=True
    ):
        assert np.array_equal(np.float32(values), states(source, trial)[frame])
    assert found["actions"][1][:2] == [3.0, 4.0] and found["actions"][1][-1] == 0
    assert found["actions"][0] == [0, 0, 0, 0, 0, 0, -1]
    movie = Dataset(source).frames("drop_2")
    assert found["picture"] == [3, *movie.shape[1:3]]
    assert found["color"][2] == pytest.approx(movie[-1].mean() / 255, abs=0.01)


@pytest.mark.nightly
@pytest.mark.slow
def test_stable_worldmodel_reads_what_was_exported(tmp_path: Path) -> None:
    python = find_program(variable="PHYSION_STABLE_WORLDMODEL", what="stable-worldmodel")
    source = make_dataset(tmp_path / "trials")
    found = read_back(python, "lance", source, tmp_path / "home")
    assert found["broken"] == [2, 0], "a damaged movie is refused, and leaves no table"
    assert found["again"] == [0, 2], "tables that are there are not replaced"
    assert found["lengths"] == [FRAMES] * 4 and found["clips"] == 4 * (FRAMES - 3)
    assert found["names"] == ["action", "done", "pixels", "state", "success"]
    for values, (trial, frame) in zip(
        found["states"], (("drape_0", 0), ("drop_0", 6), ("drop_2", FRAMES - 4)), strict=True
    ):
        assert np.array_equal(np.float32(values), states(source, trial)[frame])
    assert found["actions"][1][1][:2] == [3.0, 4.0] and found["actions"][1][0][0] == 0
    assert found["success"] == [[0] * 4, [0] * 4, [1] * 4] and found["done"] == [0, 0, 0, 1]
    assert found["picture"] == [4, 3, 64, 64]
    movie = Dataset(source).frames("drop_2")
    assert found["color"][2] == pytest.approx(movie[-4].mean(), abs=3)
    assert found["trials"][2] == {
        "episode_idx": 2, "trial": "drop_1", "scenario": "drop", "split": "testing",
        "contact": False, "first_contact_frame": -1,
    }  # fmt: skip


def test_without_pylance_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lance", None)
    with pytest.raises(MissingExtraError, match="extra 'lance'"):
        export_lance(tmp_path, tmp_path / "out")
