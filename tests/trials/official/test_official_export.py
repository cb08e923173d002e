"""Export to the official layout: fields, axes, layouts and pushes."""

from __future__ import annotations

import colorsys
import csv
import gzip
import io
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from physion.cli import export as export_verb
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError
from physion.core.names import CONTROLLERS, guess_scenario, plain_name
from physion.numerics.rotations import rotation_matrix
from physion.physics.cloth.simulate import ClothSettings
from physion.physics.engine import simulate
from physion.physics.trajectory import Contacts, Trajectory
from physion.rendering.camera import View, axes
from physion.scenes.scene import Body, Camera, Joint, Push, Roles, Scene
from physion.scenes.shapes.primitives import shape
from physion.scenes.tdw.commands import quaternion_from_euler, vector
from physion.trials.dataset import Dataset
from physion.trials.files import encode_png
from physion.trials.official.export_folder import export_official
from physion.trials.official.names import (
    CLOTH_DISTANCE,
    decode_depth,
    decode_picture,
    encode_depth,
    encode_flow,
    encode_normals,
    from_official_camera,
    from_official_rotation,
    redyellow_name,
    rotation_matrices,
    segmentation_colors,
    split_name,
    swap_angular_velocity,
    swap_axes,
    to_official_camera,
    to_official_euler,
    to_official_rotation,
)
from physion.trials.official.write_file import FrameWriter, _of_stack, _push, trial_stats
from physion.trials.official.write_objects import OfficialObjects
from physion.trials.trial_file import Trial
from physion.trials.video import count_frames
from support.official_hand_made import CLOTH, FRAMES, PART, RIGID, SIZE, TOUCH, make_dataset

CONFIGS = {
    "collide": "configurations/Collide/collide_testing/0003",
    "drape": "configurations/Drape/drape_testing/0000",
}


@pytest.fixture(scope="module")
def rigid(dataset: Path) -> Trial:
    return Dataset(dataset).trial(RIGID)


@pytest.fixture(scope="module")
def cloth(dataset: Path) -> Trial:
    return Dataset(dataset).trial(CLOTH)


# An official reader: what one finds in the code of others, in short.


def read_label(path: Path) -> bool:
    with h5py.File(path, "r") as f:
        labels = [np.array(f["frames"][k]["labels"]["target_contacting_zone"]) for k in f["frames"]]
        return bool(np.any(labels))


def read_state(path: Path) -> dict[str, np.ndarray]:
    with h5py.File(path, "r") as f:
        keys = sorted(f["frames"].keys())
        assert keys == [f"{i:04d}" for i in range(len(keys))]
        names = ("positions", "rotations", "velocities", "angular_velocities", "forwards")
        return {
            name: np.stack([f["frames"][key]["objects"][name][:] for key in keys]) for name in names
        }


def read_image(path: Path, frame: int, name: str) -> np.ndarray:
    with h5py.File(path, "r") as f:
        return np.array(Image.open(io.BytesIO(f["frames"][f"{frame:04d}"]["images"][name][:])))


def read_depth(path: Path, frame: int) -> np.ndarray:
    with h5py.File(path, "r") as f:
        image = f["frames"][f"{frame:04d}"]["images"]["_depth"][:].astype(float)
    value = image[..., 0] + image[..., 1] / 256 + image[..., 2] / 65536
    return value * ((100 - 0.1) / 256)


def official_turn(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    t = 2 * np.cross(q[..., :3], v)
    return v + q[..., 3:] * t + np.cross(q[..., :3], t)


def static(path: Path, name: str) -> Any:
    with h5py.File(path, "r") as f:
        return f["static"][name][()]


def order(path: Path, trial: Trial) -> list[int]:
    """Where the objects of a file are in our scene, by their positions, which all differ."""
    things = [*trial.scene.bodies, *trial.scene.cloths]
    starts = [np.float32(thing.position)[[0, 2, 1]].tolist() for thing in things]
    return [starts.index(start) for start in static(path, "initial_position").tolist()]


@pytest.mark.slow
def test_motion_is_the_same_in_the_other_axes(exported: Path, rigid: Trial) -> None:
    path = exported / f"{CONFIGS['collide']}.hdf5"
    state, ours, at = read_state(path), rigid.trajectory, order(path, rigid)
    assert len(state["positions"]) == FRAMES
    np.testing.assert_array_equal(state["positions"], ours.positions[:, at][..., [0, 2, 1]])
    np.testing.assert_array_equal(state["velocities"], ours.velocities[:, at][..., [0, 2, 1]])
    np.testing.assert_array_equal(
        state["angular_velocities"], -ours.angular_velocities[:, at][..., [0, 2, 1]]
    )
    np.testing.assert_allclose(np.linalg.norm(state["rotations"], axis=-1), 1, atol=1e-6)
    forwards = official_turn(state["rotations"], np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(state["forwards"], forwards, atol=1e-6)


def test_static_arrays_follow_the_official_order_and_masses_end_before_scenery(
    exported: Path, rigid: Trial
) -> None:
    path = exported / f"{CONFIGS['collide']}.hdf5"
    names = [name.decode() for name in static(path, "model_names").tolist()]
    assert names == ["cube", "cone", "sphere", "prop:vase"]  # zone, target, probe, the rest
    ids = static(path, "object_ids").tolist()
    assert ids == [1, 2, 3, 4]
    roles = [static(path, f"{role}_id") for role in ("zone", "target", "probe", "ramp")]
    assert roles == [1, 2, 3, -1]
    assert static(path, "distractors").tolist() == [b"prop:vase"]
    assert static(path, "occluders").tolist() == []
    np.testing.assert_allclose(static(path, "scale")[0], [0.5, 0.01, 0.9], atol=1e-7)
    assert static(path, "mass").tolist() == [500, 1, 3]
    for name in ("static_friction", "dynamic_friction", "bounciness"):
        assert len(static(path, name)) == 3
    assert static(path, "static_friction")[1] == 0.3
    assert static(path, "dynamic_friction")[1] == 0.2
    assert static(path, "bounciness")[1] == 0.1
    # A name without -redyellow shows the natural colours, though the trial's own look is red.
    natural = [rigid.scene.bodies[index].look.color for index in order(path, rigid)]
    np.testing.assert_allclose(static(path, "color"), natural)
    np.testing.assert_allclose(static(path, "push_force"), [2.0, 0.1, 0.5])
    np.testing.assert_allclose(static(path, "push_position"), [-1.1, 0.2, 0.2])
    assert static(path, "push_time") == 4
    assert static(path, "stimulus_name") == RIGID.encode()


def test_meshes_boxes_and_poses_belong_together(exported: Path, rigid: Trial) -> None:
    path, frame = exported / f"{CONFIGS['collide']}.hdf5", 20
    at = order(path, rigid)
    with h5py.File(path, "r") as f:
        state = {k: v[:] for k, v in f[f"frames/{frame:04d}/objects"].items()}
        for place, index in enumerate(at):
            body = rigid.scene.bodies[index]
            vertices = f["static"]["mesh"][f"vertices_{place}"][:]
            faces = f["static"]["mesh"][f"faces_{place}"][:]
            world = (
                official_turn(state["rotations"][place], vertices * f["static"]["scale"][place])
                + state["positions"][place]
            )
            # The renderer draws the same surface.
            mesh = shape(body.shape).mesh
            ours = (mesh.vertices * body.scale) @ rotation_matrix(
                rigid.trajectory.rotations[frame, index]
            ).T + rigid.trajectory.positions[frame, index]
            np.testing.assert_allclose(world, ours[:, [0, 2, 1]], atol=1e-5)
            corners = vertices[faces].astype(float)
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            volume = np.einsum("ij,ij->", corners.mean(1), normals) / 6
            assert volume > 0  # outwards, as a cross product of the numbers
            for side, axis in (("front", 2), ("right", 0), ("top", 1)):
                away = state[side][place] - state["center"][place]
                reach = (world - state["center"][place]) @ away / (away @ away)
                assert reach.max() == pytest.approx(1, abs=1e-3)
                assert vertices[:, axis].max() > vertices[:, axis].min()


def test_pictures_and_camera(exported: Path, rigid: Trial) -> None:
    path, frame = exported / f"{CONFIGS['collide']}.hdf5", 30
    drawn = rigid.render(frame, ("color", "depth", "ids"), look="free")
    np.testing.assert_array_equal(read_image(path, frame, "_img"), drawn.color)
    depth = read_depth(path, frame)
    near = drawn.depth < 99
    np.testing.assert_allclose(depth[near], drawn.depth[near], atol=1e-5)
    seen, colors = read_image(path, frame, "_id"), static(path, "object_segmentation_colors")
    for place, index in enumerate(order(path, rigid)):
        # As an official reader has it, which takes a pixel for an object by any of its channels.
        np.testing.assert_array_equal((seen == colors[place]).any(-1), drawn.ids == index + 1)
    with h5py.File(path, "r") as f:
        matrices = f[f"frames/{frame:04d}/camera_matrices"]
        both = matrices["projection_matrix"][:].reshape(4, 4) @ matrices["camera_matrix"][
            :
        ].reshape(4, 4)
        centers = f[f"frames/{frame:04d}/objects/center"][:]
    clip = np.column_stack([centers, np.ones(len(centers))]) @ both.T
    pixel = (clip[:, :2] / clip[:, 3:] * [1, -1] + 1) / 2 * SIZE
    wanted, _ = View(rigid.scene.camera, SIZE, SIZE).project(centers[:, [0, 2, 1]])
    np.testing.assert_allclose(pixel, wanted, atol=1e-3)
    assert read_image(path, frame, "_normals").shape == (SIZE, SIZE, 3)
    assert read_image(path, frame, "_flow").any()
    assert not read_image(path, FRAMES - 1, "_flow").any()


def test_flow_in_pixels_stands_apart(exported: Path, rigid: Trial) -> None:
    with h5py.File(exported / f"{CONFIGS['collide']}.hdf5", "r") as f:
        assert set(f) == {"static", "frames", "physion"}
        flow = f["physion/flow"][7]
    np.testing.assert_array_equal(flow, rigid.render(7, ("flow",)).flow.astype(np.float16))


def test_only_gzip_is_needed(exported: Path) -> None:
    known = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE}

    def check(_: str, thing: Any) -> None:
        if isinstance(thing, h5py.Dataset):
            plan = thing.id.get_create_plist()
            assert {plan.get_filter(i)[0] for i in range(plan.get_nfilters())} <= known

    for config in CONFIGS.values():
        with h5py.File(exported / f"{config}.hdf5", "r") as f:
            f.visititems(check)


def test_contacts_belong_to_pairs(exported: Path, rigid: Trial) -> None:
    path = exported / f"{CONFIGS['collide']}.hdf5"
    contacts = rigid.trajectory.contacts
    with h5py.File(path, "r") as f:
        for frame, state in ((TOUCH, b"enter"), (TOUCH + 1, b"stay"), (PART, b"exit")):
            group = f[f"frames/{frame:04d}/collisions"]
            assert group["object_ids"][:].tolist() == [[1, 2]]
            assert group["states"][:].tolist() == [state]
            if state == b"exit":
                # It makes no labelled frame for readers that take any contact point as a touch.
                assert group["contacts"].shape == (0, 2, 3)
                continue
            row = np.flatnonzero(contacts.frame == frame)[0]
            normal, point = group["contacts"][0]
            np.testing.assert_array_equal(point, contacts.point[row][[0, 2, 1]])
            # Unity's normal runs from the second to the first, ours from the first.
            np.testing.assert_array_equal(normal, -contacts.normal[row][[0, 2, 1]])
            zone, cone = 1, 3
            away = (
                rigid.trajectory.velocities[frame, cone] - rigid.trajectory.velocities[frame, zone]
            )
            np.testing.assert_allclose(group["relative_velocities"][0], away[[0, 2, 1]])
        assert len(f[f"frames/{PART + 1:04d}/collisions/object_ids"]) == 0
        floor = f["frames/0003/env_collisions"]
        assert floor["object_ids"][:].tolist() == [2]
        row = np.flatnonzero(contacts.frame == 3)[0]
        np.testing.assert_array_equal(floor["contacts"][0, 0], contacts.normal[row][[0, 2, 1]])
        for frame in f["frames"].values():
            touching = (frame["collisions/states"][:] != b"exit").sum()
            assert len(frame["collisions/contacts"]) == touching
            environment = frame["env_collisions"]
            assert len(environment["contacts"]) == len(environment["object_ids"])


def test_labels(exported: Path, rigid: Trial) -> None:
    path = exported / f"{CONFIGS['collide']}.hdf5"
    assert read_label(path) == rigid.labels.contact is True
    with h5py.File(path, "r") as f:
        labels = [frame["labels"] for frame in f["frames"].values()]
        touching = [bool(label["target_contacting_zone"][()]) for label in labels]
        assert [i for i, touch in enumerate(touching) if touch] == list(range(TOUCH, PART))
        assert [bool(label["trial_end"][()]) for label in labels] == [False] * (FRAMES - 1) + [True]
        assert bool(labels[-1]["trial_complete"][()]) and not labels[-1]["trial_timeout"][()]
        assert [i for i, label in enumerate(labels) if label["target_on_ground"][()]] == [3]
        moved = rigid.trajectory.positions[-1, 3] - rigid.trajectory.positions[0, 3]
        np.testing.assert_allclose(labels[-1]["target_delta_position"][:], moved[[0, 2, 1]])
        assert labels[-1]["target_has_moved"][()] and not labels[0]["target_has_moved"][()]


def test_a_tower_fell_when_its_top_is_below_half_of_its_first_height() -> None:
    """The cap's top is at 0.6 m at first and the block's at 0.2 m; the probe does not count."""
    bodies = (
        Body("zone", "cube", (0, 0, 0), (1, 1, 0.01), kinematic=True),
        Body("block", "cube", (0, 0, 0), (0.2, 0.2, 0.2)),
        Body("cap", "cube", (0, 0, 0.4), (0.2, 0.2, 0.2)),
        Body("probe", "sphere", (1, 0, 3), (0.2, 0.2, 0.2)),
    )
    scene = Scene("a", "support", bodies, Roles("cap", "zone", "probe"), Camera((3.0, 0.0, 1.0)))
    heights = [0.4, 0.395, 0.3, 0.11, 0.09, 0.0, 0.3]
    positions = np.tile([body.position for body in bodies], (7, 1, 1)).astype(np.float32)
    positions[:, 2, 2] = heights
    rotations = np.tile(np.float32([1, 0, 0, 0]), (7, 4, 1))
    still = np.zeros_like(positions)
    nothing = np.zeros((7, 0, 3), np.float32)
    gaps = np.full(7, np.nan, np.float32)
    contacts = Contacts(
        np.array([2], np.int32), np.array([[0, 2]], np.int32), still[:1, 0], still[:1, 0], gaps[:1]
    )
    motion = Trajectory(
        positions, rotations, still, still, nothing, gaps, contacts, False, "by hand"
    )
    labels = FrameWriter(OfficialObjects(scene, motion), 8, 8).labels
    assert labels["did_fall"].tolist() == [False] * 4 + [True, True, False]
    assert labels["target_has_moved"].tolist() == [False, False] + [True] * 5
    assert labels["target_contacting_zone"].tolist() == [False, False, True] + [False] * 4
    assert labels["trial_timeout"].tolist() == [False] * 6 + [True]
    assert not labels["trial_complete"].any()


def test_cloth_has_particles_and_distances(exported: Path, cloth: Trial) -> None:
    path = exported / f"{CONFIGS['drape']}.hdf5"
    assert [name.decode() for name in static(path, "model_names")][1] == "cloth_square"
    with h5py.File(path, "r") as f:
        frame = f["frames/0020"]
        sheet = frame["particles/2"][:]
        ours = cloth.trajectory.cloth_vertices[20]
        np.testing.assert_array_equal(sheet[:, :3], ours[:, [0, 2, 1]])
        np.testing.assert_allclose(1 / sheet[:, 3].sum(), 0.5 / len(ours) ** 2, rtol=1e-5)
        before = cloth.trajectory.cloth_vertices[19]
        speed = (ours - before)[:, [0, 2, 1]] / 0.01
        np.testing.assert_allclose(frame["velocities/2"][:], speed, atol=1e-3)
        assert frame["particles/1"].shape[1] == 4  # the zone, a solid
        assert "target_has_moved" not in frame["labels"]
        gaps = [v["labels/minimum_distance_target_to_zone"][()] for v in f["frames"].values()]
    np.testing.assert_allclose(gaps, cloth.trajectory.cloth_distance + CLOTH_DISTANCE, atol=1e-6)
    touching = [gap < 0.1222 for gap in gaps]  # the official rule tells our outcome
    assert touching.index(True) == cloth.labels.first_frame
    assert read_label(path) == cloth.labels.contact


def test_types_are_as_the_official_writer_makes_them(exported: Path) -> None:
    """Section 4 of the reference: what numpy and h5py make of the writer's lists and arrays."""
    double = ("mass", "static_friction", "dynamic_friction", "bounciness", "color", "probe_mass")
    double += ("scale_x", "scale_y", "scale_z", "ramp_base_height")
    single = ("scale", "initial_position", "initial_rotation", "target_rotation", "push_force")
    texts = ("model_names", "stimulus_name", "room", "probe_type", "distractors", "git_commit")
    with h5py.File(exported / f"{CONFIGS['collide']}.hdf5", "r") as f:
        for frame in f["frames"].values():
            for name in ("collisions", "env_collisions"):
                assert frame[name]["object_ids"].dtype == f["static/object_ids"].dtype == np.int64
                assert frame[name]["contacts"].dtype == np.float64
            assert frame["objects/positions"].dtype == np.float32
        for names, kind in ((double, np.float64), (single, np.float32), (texts, object)):
            for name in names:
                assert f["static"][name].dtype == kind, name
        assert h5py.check_string_dtype(f["static/model_names"].dtype).length is None
        np.testing.assert_allclose(
            f["static/target_rotation"][:], f["static/initial_rotation"][1], atol=1e-6
        )


def test_drape_says_how_cloth_was_simulated(exported: Path, cloth: Trial, official: Path) -> None:
    sent: dict[str, dict[str, Any]] = {}
    for path in sorted((official / "scenes/drape").glob("*/tdw_commands.json.gz")):
        for line in gzip.decompress(path.read_bytes()).decode().splitlines():
            if (start := line.find("[")) >= 0 and "flex" in line:
                commands, _ = json.JSONDecoder().raw_decode(line[start:])
                sent |= {c["$type"]: c for c in commands if "flex" in c.get("$type", "")}
    settings, sheet = ClothSettings(), cloth.scene.cloths[0]
    with h5py.File(exported / f"{CONFIGS['drape']}.hdf5", "r") as f:
        static = f["static"]
        container = {name: d[()] for name, d in static["container"].items()}
        for name in ("collision_distance", "static_friction", "dynamic_friction"):
            assert container[name] == np.float32(sent["create_flex_container"][name])
        assert container["substep_count"] == settings.substeps
        assert container["solid_rest"] == np.float32(settings.rest_distance)
        solids = {name: d[:] for name, d in static["solid_actors"].items()}
        assert static["model_names"][[1, 4]].tolist() == [b"cloth_square", b"prop:vase"]
        assert solids["object_id"].tolist() == [1, 3, 4]  # neither the cloth nor the scenery
        for name in ("mass_scale", "mesh_expansion", "particle_spacing"):
            assert (solids[name] == np.float32(sent["set_flex_solid_actor"][name])).all()
        cloths = {name: d[:].tolist() for name, d in static["cloth_actors"].items()}
        assert cloths.pop("object_id") == [2]
        for name in ("stretch", "bend", "tether"):
            value = np.float32(getattr(sheet, name))
            assert cloths.pop(f"{name}_stiffness") == [value]
        assert cloths == {n: [sent["set_flex_cloth_actor"][n]] for n in cloths} and cloths
        assert not len(static["soft_actors"]) and not len(static["fluid_actors"])
    with h5py.File(exported / f"{CONFIGS['collide']}.hdf5", "r") as f:
        assert "container" not in f["static"]


def test_metadata_has_all_official_keys(exported: Path, official: Path) -> None:
    ours = {
        scenario: json.loads((exported / config).with_name("metadata.json").read_text())[0]
        for scenario, config in CONFIGS.items()
    }
    for scenario, record in ours.items():
        for path in sorted((official / "scenes" / scenario).glob("*/metadata.json")):
            theirs = json.loads(path.read_text())[0]
            assert theirs.keys() <= record.keys(), path
            for key, value in theirs.items():
                same = isinstance(value, type(record[key]))
                assert same or value is None or record[key] is None, key
        stats = json.loads((exported / CONFIGS[scenario]).with_name("trial_stats.json").read_text())
        published = json.loads(path.with_name("trial_stats.json").read_text())
        assert published.keys() <= stats.keys()


def test_metadata_is_measured(exported: Path, rigid: Trial) -> None:
    record = json.loads((exported / CONFIGS["collide"]).with_name("metadata.json").read_text())[0]
    scene = rigid.scene
    assert record["stimulus_name"] == RIGID and record["controller_name"] == "Collision"
    assert record["num_frames"] == FRAMES
    assert record["does_target_contact_zone"] and not record["does_target_miss_zone"]
    assert record["first_target_contact_zone_frame"] == TOUCH
    assert record["first_target_hit_ground_frame"] == 3
    share = rigid.pixel_fractions[scene.index("cone")]
    assert record["target_visible_area"] == pytest.approx(share, abs=5e-4)
    assert record["num_distractors"] == 1 and record["num_occluders"] == 0
    assert record["push_time"] == 4
    last = rigid.render(FRAMES - 1, ("ids",)).ids == scene.index("cone") + 1
    first = rigid.ids == scene.index("cone") + 1
    line = np.linspace(-1, 1, SIZE)
    moved = [
        (line[:, None] * last).sum() / last.sum() - (line[:, None] * first).sum() / first.sum(),
        (line[None] * last).sum() / last.sum() - (line[None] * first).sum() / first.sum(),
    ]
    np.testing.assert_allclose(record["final_target_mask_displacement"], moved, atol=1e-3)


def test_a_trial_without_contact_is_exported_as_one(tmp_path: Path) -> None:
    """In every list, as false: the other trials here all touch."""
    dataset = make_dataset(tmp_path / "d", touch=False)
    executor = SerialExecutor()
    export_official(dataset, tmp_path / "o", images=False, executor=executor)
    assert not read_label(tmp_path / "o" / f"{CONFIGS['collide']}.hdf5")
    assert f"{RIGID}_img,False" in (tmp_path / "o/labels.csv").read_text()
    table = pd.read_csv(tmp_path / "o/stimulus_names_and_labels.csv")
    assert table["label"].tolist() == [False]
    path = (tmp_path / "o" / CONFIGS["collide"]).with_name("metadata.json")
    (record,) = json.loads(path.read_text())
    assert record["does_target_contact_zone"] is False and record["does_target_miss_zone"] is True
    assert record["first_target_contact_zone_frame"] is None
    export_official(dataset, tmp_path / "e", layout="physion-evaluator", executor=executor)
    labels = json.loads((tmp_path / "e/physion_mp4s/test/all_video_labels.json").read_text())
    (label,) = labels.values()
    assert label == {"label": False, "contact_frame_label": FRAMES // 2}


def test_means_over_the_trials_of_a_configuration() -> None:
    records: list[dict[str, Any]] = [
        {"trial_num": 0, "contact": True, "area": 0.1, "room": "box", "shift": [1.0, 0.0],
         "away": {"x": 1.0}, "frame": None},
        {"trial_num": 1, "contact": False, "area": 0.3, "room": "tdw", "shift": [2.0, -1.0],
         "away": {"x": 4.0}, "frame": 7},
        {"trial_num": 2, "contact": False, "area": 0.4, "room": "tdw", "shift": None,
         "away": None, "frame": 8},
        {"trial_num": 3, "contact": False, "area": 0.4, "room": "tdw", "shift": [6.0, 4.0],
         "away": None, "frame": 9},
    ]  # fmt: skip
    assert trial_stats(records) == {
        "contact/avg_label": 0.25,
        "area/avg_label": 0.3,
        "room/avg_label": "box-tdw",
        "shift/avg_label": [3.0, 1.0],
        "away/avg_label": {"x": 2.5},
        "frame/avg_label": 8.0,
        "num_trials": 4,
    }


def test_zone_ramp_target_and_probe_come_first_and_ids_count_from_1() -> None:
    bodies = (
        Body("block", "cube", (2, 0, 0)),
        Body("probe", "sphere", (1, 0, 0)),
        Body("ramp", "ramp_with_platform_30", (0, 1, 0), kinematic=True),
        Body("target", "cone", (0, 0, 0)),
        Body("zone", "cube", (0, 2, 0), kinematic=True),
    )
    scene = Scene("a", "roll", bodies, Roles("target", "zone", "probe"), Camera((3.0, 0.0, 1.0)))
    objects = OfficialObjects(scene, simulate(scene, frames=1))
    assert objects.ids == {"zone": 1, "ramp": 2, "target": 3, "probe": 4, "block": 5}
    # The renderer's ids are 0 for the room, then 1 to 5 in the order of the scene.
    seen = objects.official_ids(np.arange(6, dtype=np.int16).reshape(2, 3))
    assert seen.tolist() == [[0, 5, 4], [2, 3, 1]]


def test_core_folders_hold_both_looks(exported: Path, dataset: Path) -> None:
    paths = Dataset(dataset).paths(RIGID)
    core = exported / "Collide"
    free, own = paths.free_movie.read_bytes(), paths.movie.read_bytes()
    assert (core / f"mp4s/{RIGID}_img.mp4").read_bytes() == free
    marked = core / "mp4s-redyellow/collide_testing-redyellow_0003_img.mp4"
    assert marked.read_bytes() == own
    assert (exported / f"{CONFIGS['collide']}_img.mp4").read_bytes() == free
    assert (core / f"maps/{RIGID}_map.png").read_bytes() == paths.map.read_bytes()
    rows = list(csv.reader((exported / "labels.csv").open()))
    assert rows == [
        ["", "ground truth outcome"],
        [f"{RIGID}_img", "True"],
        [f"{CLOTH}_img", "True"],
    ]
    table = list(csv.DictReader((exported / "stimulus_names_and_labels.csv").open()))
    assert [row["scenario"] for row in table] == ["collide", "drape"]
    for row in table:
        assert all((exported / row[f"{kind}_url"]).is_file() for kind in ("stim", "map", "hdf5"))


def test_a_second_run_keeps_what_is_whole(exported: Path, dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(exported, out)
    whole = out / f"{CONFIGS['drape']}.hdf5"
    stamp = whole.stat().st_mtime_ns
    cut = out / f"{CONFIGS['collide']}.hdf5"
    cut.write_bytes(cut.read_bytes()[:5000])
    report = export_official(dataset, out, executor=SerialExecutor())
    assert report.made == (RIGID,) and report.kept == (CLOTH,)
    assert whole.stat().st_mtime_ns == stamp
    assert cut.read_bytes() == (exported / f"{CONFIGS['collide']}.hdf5").read_bytes()


def test_a_missing_movie_is_rendered_and_a_bad_trial_fails_without_the_others(
    exported: Path, dataset: Path, tmp_path: Path
) -> None:
    copy, out = tmp_path / "dataset", tmp_path / "out"
    shutil.copytree(dataset, copy)
    Dataset(copy).paths(RIGID).trial_file.write_bytes(b"no trial")
    report = export_official(copy, out, executor=SerialExecutor())
    assert report.made == (CLOTH,) and set(report.failed) == {RIGID} and report.exit_code == 1
    assert not (out / "Collide").exists()
    assert count_frames(out / f"{CONFIGS['drape']}_img.mp4") == FRAMES


def test_choices_and_refusals(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no trial"):
        export_official(dataset, tmp_path / "out", split="training")
    with pytest.raises(BadInputError, match="outside"):
        export_official(dataset, dataset / "out")
    with pytest.raises(BadInputError, match="it is not a dataset"):
        export_official(tmp_path, tmp_path / "out")


def test_stacks_are_described_as_there(dataset: Path) -> None:
    """Contain and Link: base and attachment by name, links from the lowest to the highest."""
    parts = [
        Body("zone", "cube", (0, 0, 0), kinematic=True),
        Body("target", "torus", (0, 0, 0.4)),
        Body("probe", "sphere", (1, 0, 0)),
        Body("base", "cone", (0, 0, 0.1)),
        Body("attachment", "cylinder", (0, 0, 0.2)),
        Body("member_0", "torus", (0, 0, 0.3)),
        Body("cap", "cube", (0, 0, 0.9)),
    ]
    scene = Scene(
        "a",
        "link",
        tuple(parts),
        Roles("target", "zone", "probe"),
        Camera((3.0, 0.0, 1.0)),
        joints=(Joint("base", "attachment"),),
    )
    told = _of_stack(OfficialObjects(scene, Dataset(dataset).trial(RIGID).trajectory))
    assert told == {
        "base_id": 4,
        "use_base": True,
        "base_type": "cone",
        "attachment_id": 5,
        "use_attachment": True,
        "attachent_type": "cylinder",
        "attachment_fixed": True,
        "link_type": "torus",
        "num_links": 2,
        "target_link_idx": 1,
        "use_cap": True,
    }


def test_the_verb(
    dataset: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(export_verb, "LocalExecutor", lambda workers: SerialExecutor())
    options = export_verb.Options(dataset, tmp_path / "out", scenario="drape", workers=1, json=True)
    assert export_verb.main(options) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["made"] == [CLOTH] and Path(said["index"]).is_file()
    with pytest.raises(BadInputError, match="needs a folder"):
        export_verb.main(export_verb.Options(dataset))


# The exported push point is the point at which the engine pushes.


@pytest.mark.parametrize("shape", ["bowl", "pipe"])
def test_a_hollow_body_pushed_at_the_exported_point_does_not_spin(shape: str) -> None:
    """Without a point the impulse acts at the centre of mass: so must the exported point."""
    body = Body("a", shape, (0.3, -0.2, 5.0), (0.4, 0.5, 0.6), (0.8, 0.6, 0, 0), mass=2.0)
    zone = Body("zone", "cube", (9.0, 9.0, 0.0), (1, 1, 0.01), kinematic=True)
    push = Push("a", (3.0, 1.0, 2.0))
    camera = Camera((0, -3, 1))
    scene = Scene("t", "collide", (body, zone), Roles("a", "zone"), camera, pushes=(push,))
    path = simulate(scene, frames=3)
    exported = _push(OfficialObjects(scene, path))["push_position"]
    x, y, z = (float(value) for value in swap_axes(exported))
    again = replace(scene, pushes=(replace(push, point=(x, y, z)),))
    pushed = simulate(again, frames=3)
    np.testing.assert_allclose(pushed.velocities, path.velocities, atol=1e-5)
    # The point is stored in single precision; the centre of the drawn bowl would give far more.
    assert np.abs(pushed.angular_velocities).max() < 1e-4


# Conversion of axes: positions, rotations and cameras agree in both systems.


numbers = st.floats(-100, 100, allow_subnormal=False)
points = arrays(np.float64, 3, elements=numbers)
quaternions = (
    arrays(np.float64, 4, elements=st.floats(-1, 1))
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


def turn_as_unity(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """What a reader of official files computes: the textbook formula on (x, y, z, w)."""
    t = 2 * np.cross(q[:3], v)
    return v + q[3] * t + np.cross(q[:3], t)


@given(points)
def test_points_and_spins_come_back(p: np.ndarray) -> None:
    assert (swap_axes(swap_axes(p)) == p).all()
    assert (swap_angular_velocity(swap_angular_velocity(p)) == p).all()
    x, y, z = p
    assert tuple(swap_axes(p)) == vector({"x": x, "y": y, "z": z})


@given(quaternions)
def test_rotations_come_back(q: np.ndarray) -> None:
    assert (from_official_rotation(to_official_rotation(q)) == q).all()


@given(quaternions, points)
def test_turning_and_changing_axes_commute(q: np.ndarray, p: np.ndarray) -> None:
    turned_then_swapped = swap_axes(rotation_matrices(q) @ p)
    swapped_then_turned = turn_as_unity(to_official_rotation(q), swap_axes(p))
    np.testing.assert_allclose(turned_then_swapped, swapped_then_turned, atol=1e-9)


@given(points, points)
def test_a_spinning_point_moves_the_same_way(spin: np.ndarray, arm: np.ndarray) -> None:
    ours = swap_axes(np.cross(spin, arm))
    np.testing.assert_allclose(
        ours, np.cross(swap_angular_velocity(spin), swap_axes(arm)), atol=1e-9
    )


def straight(pitch: float) -> np.ndarray:
    """A rotation straight up or down, where yaw and roll cannot be distinguished."""
    return np.array(quaternion_from_euler({"x": pitch, "y": 30.0, "z": 20.0}))


@settings(deadline=None)  # the first example imports the reader of logs
@given(quaternions)
@example(straight(90.0))
@example(straight(-90.0))
def test_euler_angles_are_those_the_importer_of_logs_reads(q: np.ndarray) -> None:
    x, y, z = to_official_euler(q)
    back = np.array(quaternion_from_euler({"x": x, "y": y, "z": z}))
    np.testing.assert_allclose(rotation_matrices(back), rotation_matrices(q), atol=1e-6)


CAMERA = Camera((3.0, -1.0, 1.5), (0.2, 0.1, 0.4), math.radians(55))


def test_official_matrices_show_points_where_our_camera_does() -> None:
    world_to_camera, projection = to_official_camera(CAMERA, 80, 60)
    p = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    clip = np.column_stack([swap_axes(p), np.ones(20)]) @ (projection @ world_to_camera).T
    assert (clip[:, 3] > 0).all()
    at = clip[:, :2] / clip[:, 3:]
    seen, depth = View(CAMERA, 80, 60).project(p)
    np.testing.assert_allclose((at[:, 0] + 1) / 2 * 80, seen[:, 0], atol=1e-9)
    np.testing.assert_allclose((1 - at[:, 1]) / 2 * 60, seen[:, 1], atol=1e-9)
    np.testing.assert_allclose(clip[:, 3], depth, atol=1e-9)


def test_official_camera_matrix_is_left_handed_as_the_real_ones() -> None:
    world_to_camera, projection = to_official_camera(CAMERA, 64, 64)
    assert np.linalg.det(world_to_camera[:3, :3]) == pytest.approx(-1)
    assert projection[1, 1] == pytest.approx(1.9209821)
    assert projection[3, 2] == -1


@given(points, points)
def test_cameras_come_back(eye: np.ndarray, aim: np.ndarray) -> None:
    if np.linalg.norm((eye - aim)[:2]) < 1:
        return
    camera = Camera(tuple(eye), tuple(aim))
    matrices = [m.astype(np.float32).astype(float) for m in to_official_camera(camera, 64, 64)]
    back, upright = from_official_camera(matrices[0], matrices[1], aim)
    assert upright
    np.testing.assert_allclose(back.position, eye, atol=2e-4)
    np.testing.assert_allclose(back.target, aim, atol=2e-4)
    assert (back.near, back.far) == (0.1, 100.0)
    assert back.fov == pytest.approx(camera.fov, abs=1e-6)


def test_tilted_cameras_are_distinguished_and_what_is_no_camera_is_refused() -> None:
    matrices = to_official_camera(CAMERA, 64, 64)
    turn = np.eye(4)
    turn[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    _, upright = from_official_camera(turn @ matrices[0], matrices[1], (0, 0, 0))
    assert not upright
    nothing = np.zeros((4, 4))
    for broken in ((nothing, matrices[1]), (matrices[0], nothing)):
        with pytest.raises(BadInputError):
            from_official_camera(*broken, (0, 0, 0))


# Official names, and encodings of pictures.


def test_no_two_objects_share_a_channel() -> None:
    colors = segmentation_colors(255)
    assert colors.min() > 0
    for channel in colors.T:
        assert len(set(channel.tolist())) == 255
    with pytest.raises(BadInputError, match="256 objects"):
        segmentation_colors(256)


@given(st.floats(0, 99.8))
def test_depth_by_the_official_formula(metres: float) -> None:
    packed = encode_depth(np.array([[metres], [1.0]])).astype(float)
    red, green, blue = packed[0, 0]  # top row first
    value = (red + green / 256 + blue / 65536) * (100 - 0.1) / 256
    assert value == pytest.approx(metres, abs=6e-6)
    assert decode_depth(encode_depth(np.array([[metres]])))[0, 0] == pytest.approx(value)
    far = decode_depth(encode_depth(np.array([[np.inf, np.nan, 500.0]])))  # nothing is far
    np.testing.assert_allclose(far, 99.9, atol=1e-4)


def test_pictures_are_lossless_and_jpeg_is_read() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    assert (decode_picture(np.frombuffer(encode_png(picture), np.uint8)) == picture).all()
    buffer = io.BytesIO()
    Image.new("RGB", (8, 6), (200, 30, 30)).save(buffer, "jpeg")
    jpeg = decode_picture(np.frombuffer(buffer.getvalue(), np.uint8))
    assert jpeg.shape == (6, 8, 3) and abs(int(jpeg[3, 3, 0]) - 200) < 5


def huge_picture() -> bytes:
    buffer = io.BytesIO()
    Image.new("1", (5000, 5000)).save(buffer, "png")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "said"),
    [(b"", None), (b"\x89PNG\r\n\x1a\n", None), (b"GIF89a" + bytes(50), None),
     (huge_picture(), "too large")],
    ids=["empty", "only a header", "gif", "huge"],
)  # fmt: skip
def test_what_is_no_picture_is_refused(data: bytes, said: str | None) -> None:
    with pytest.raises(BadInputError, match=said):
        decode_picture(np.frombuffer(data, np.uint8))


def test_normals_are_relative_to_the_camera() -> None:
    view = axes(Camera((0.0, -3.0, 0.0), (0.0, 0.0, 0.0)))
    normals = np.array([[[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]])
    assert encode_normals(normals, view)[0].tolist() == [
        [255, 128, 128],
        [128, 255, 128],
        [128, 128, 255],
    ]


@given(st.floats(0, 1), st.floats(0, 2))
def test_flow_is_a_colour_wheel(turn: float, size: float) -> None:
    width = 50  # So that full brightness is one pixel a frame.
    flow = np.zeros((1, width, 2))
    flow[0, 0] = size * np.cos(2 * np.pi * turn), size * np.sin(2 * np.pi * turn)
    color = encode_flow(flow)[0]
    expected = np.array(colorsys.hsv_to_rgb(turn % 1.0, 1, min(size, 1))) * 255
    np.testing.assert_allclose(color[0], expected, atol=1.01)
    assert not color[1:].any()


def test_names() -> None:
    assert split_name("pilot_a_b_0007") == ("pilot_a_b", "0007")
    assert split_name("tiny") == ("tiny", "0000")
    assert redyellow_name("pilot_a_0007") == "pilot_a-redyellow_0007"
    assert plain_name("pilot_a-redyellow_0007_img.mp4") == "pilot_a_0007"


def test_every_published_stimulus_betrays_its_scenario(official: Path) -> None:
    rows = csv.DictReader((official / "stimuli/stimulus_names_and_labels.csv").open())
    count = 0
    for row in rows:
        assert guess_scenario(row["stim_ID"], "", ()) == row["scenario"]
        assert redyellow_name(row["stim_ID"]).startswith(split_name(row["stim_ID"])[0])
        count += 1
    assert count == 1200


def test_controllers_and_folders_tell_what_a_name_does_not() -> None:
    for scenario, controller in CONTROLLERS.items():
        assert guess_scenario("a_0001", controller, ()) == scenario
    assert guess_scenario("a_0001", "", ("hdf5s", "Drape")) == "drape"
    assert guess_scenario("a_0001", "None", ("dropbox", "controls")) is None
