"""Import of official command logs: small hand-made logs, and the real ones."""

from __future__ import annotations

import csv
import gzip
import json
import math
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physion.core.errors import BadInputError
from physion.physics.engine import make_engine
from physion.physics.labels import label_contact
from physion.scenes.scene import BodyEvent, Scene
from physion.scenes.tdw.commands import MAX_LINE_BYTES, quaternion_from_euler, vector
from physion.scenes.tdw.read_logs import read_scenes

Command = dict[str, Any]


def xyz(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def thing(id_: int, name: str, position: dict[str, float], **more: Any) -> list[Command]:
    """Return the commands that create one object, as the official generator writes them."""
    commands: list[Command] = [
        {
            "$type": "add_object",
            "name": name,
            "category": "flex_primitive",
            "position": position,
            "rotation": more.get("rotation", xyz(0, 0, 0)),
            "id": id_,
        },
        {"$type": "scale_object", "scale_factor": more.get("scale", xyz(1, 1, 1)), "id": id_},
        {"$type": "set_mass", "id": id_, "mass": more.get("mass", 2.0)},
    ]
    if "color" in more:
        r, g, b = more["color"]
        commands.append({"$type": "set_color", "id": id_, "color": {"r": r, "g": g, "b": b}})
    return commands


def two_cubes() -> list[Command]:
    return [
        *thing(1, "cube", xyz(1, 0, 2), scale=xyz(2, 0.01, 3)),
        {"$type": "set_kinematic_state", "id": 1, "is_kinematic": True, "use_gravity": True},
        *thing(2, "cube", xyz(0, 0.5, 0)),
    ]


def write_log(folder: Path, trials: list[list[list[Command]]], packed: bool = False) -> Path:
    """Write frames of trials as a log with its metadata, every outcome a contact at frame 7."""
    folder.mkdir(parents=True, exist_ok=True)
    setup = [
        {"$type": "add_scene", "name": "tdw_room"},
        {"$type": "set_field_of_view", "field_of_view": 60},
    ]
    lines = [f"{json.dumps(setup)} trial None"]
    for number, frames in enumerate(trials):
        lines += [f"{json.dumps(frame)} trial {number}" for frame in frames]
        lines.append(f"{json.dumps([{'$type': 'destroy_object', 'id': 2}])} trial {number}")
    text = "\n".join(lines) + "\n"
    records = [
        {
            "stimulus_name": f"{folder.name}_{number:04d}",
            "controller_name": "Collision",
            "does_target_contact_zone": True,
            "first_target_contact_zone_frame": 7,
            "num_frames": 152,
            "final_target_displacement": xyz(1, 2, 3),
        }
        for number in range(len(trials))
    ]
    (folder / "metadata.json").write_text(json.dumps(records))
    if packed:
        path = folder / "tdw_commands.json.gz"
        path.write_bytes(gzip.compress(text.encode()))
    else:
        path = folder / "tdw_commands.json"
        path.write_text(text)
    return path


def only_scene(folder: Path) -> Scene:
    found = read_scenes(folder)
    assert [str(failure) for failure in found.failures] == []
    (trial,) = found.trials
    return trial.scene


@pytest.mark.parametrize("packed", [False, True])
def test_a_trial_becomes_a_scene(tmp_path: Path, packed: bool) -> None:
    push = {"$type": "apply_force_at_position", "force": xyz(1, 2, 3), "position": xyz(4, 5, 6)}
    write_log(tmp_path / "config", [[two_cubes(), [], [push | {"id": 2}]]], packed)
    found = read_scenes(tmp_path)
    (trial,) = found.trials
    scene = trial.scene
    assert scene.name == "config_0000"
    assert (scene.scenario, scene.room) == ("collide", "bright")
    zone, target = scene.bodies
    assert (scene.roles.patient, scene.roles.agent) == (zone.name, target.name)
    assert zone.position == (1, 2, 0) and zone.scale == (2, 3, 0.01) and zone.kinematic
    assert scene.camera.fov == pytest.approx(math.radians(60))
    (impulse,) = scene.pushes
    assert impulse.frame == 2 and impulse.impulse == (1, 3, 2) and impulse.point == (4, 6, 5)
    assert scene.roles.probe == target.name
    assert trial.outcome.contact and trial.outcome.first_frame == 7
    assert trial.outcome.displacement == (1, 3, 2)


@pytest.mark.parametrize(
    ("euler", "moved"),
    [
        # Unity, left-handed: a quarter turn about y (up) takes forward (z) to right (x).
        ((0, 90, 0), {(0, 0, 1): (1, 0, 0)}),
        ((90, 0, 0), {(0, 1, 0): (0, 0, 1)}),
        ((0, 0, 90), {(1, 0, 0): (0, 1, 0)}),
        # z first, then x, then y.
        ((90, 90, 0), {(0, 1, 0): (1, 0, 0)}),
    ],
)
def test_rotations_are_converted_to_our_axes(
    euler: tuple[float, float, float], moved: dict[tuple[float, ...], tuple[float, ...]]
) -> None:
    w, x, y, z = quaternion_from_euler(xyz(*euler))
    turn = Rotation.from_quat([x, y, z, w])
    for before, after in moved.items():
        ours = turn.apply(vector(xyz(*before)))
        np.testing.assert_allclose(ours, vector(xyz(*after)), atol=1e-12)


ANGLE = {"$type": "rotate_object_by", "id": 2, "angle": 90}
HALF = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("commands", "about"),
    [
        # The same quarter turn about the upright, as a quaternion and as an angle: in our axes
        # Unity's rotations have the opposite sense.
        ([{"$type": "rotate_object_to", "id": 2, "rotation": xyz(0, HALF, 0) | {"w": HALF}}], "Z"),
        ([ANGLE | {"axis": "yaw"}], "Z"),
        # About the world's axes the later rotation comes from the left, about its own from the
        # right.
        ([ANGLE | {"axis": "pitch"}, ANGLE | {"axis": "yaw"}], "ZX"),
        ([ANGLE | {"axis": "pitch"}, ANGLE | {"axis": "yaw", "is_world": False}], "XZ"),
        ([ANGLE | {"axis": "roll"}, ANGLE | {"axis": "pitch"}], "XY"),
    ],
)
def test_objects_are_turned_as_the_log_says(
    tmp_path: Path, commands: list[Command], about: str
) -> None:
    write_log(tmp_path / "config", [[[*two_cubes(), *commands]]])
    w, x, y, z = only_scene(tmp_path).bodies[1].rotation
    expected = np.eye(3)
    for axis in about:
        expected = expected @ Rotation.from_euler(axis, -90, degrees=True).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), expected, atol=1e-12)


def test_library_models_become_props_that_fill_their_bounds(tmp_path: Path) -> None:
    """A quarter turn about the upright takes our y to x and x to -y, also for the pivot."""
    faces = {"left": (0, 2, 1), "right": (1, 2, 1), "front": (0.5, 2, 3), "back": (0.5, 2, -1)}
    faces |= {"top": (0.5, 3.5, 1), "bottom": (0.5, 0.5, 1)}
    bounds = {"urn": {"bounds": {side: xyz(*at) for side, at in faces.items()}}}
    (tmp_path / "model_bounds.json").write_text(json.dumps({"models": bounds}))
    urn = thing(3, "urn", xyz(1, 2, 3), rotation=xyz(0, 90, 0), scale=xyz(2, 2, 2))
    urn[0]["category"] = "vase"
    write_log(tmp_path / "config", [[[*two_cubes(), *urn]]])
    body = only_scene(tmp_path).bodies[2]
    assert (body.shape, body.scale) == ("prop:vase", (2, 8, 6))
    # The centre of its bottom face is at (0.5, 1, 0.5) of the model, twice as large.
    assert body.position == pytest.approx((1 + 2, 3 - 1, 2 + 1))


def test_cloth_has_its_size_and_stiffnesses(tmp_path: Path) -> None:
    """The sheet of the official cloth is 2 m wide at scale 1."""
    cloth = [
        *thing(2, "cloth_square", xyz(0.1, 1.5, -0.4), scale=xyz(0.8, 1, 0.6)),
        {
            "$type": "set_flex_cloth_actor",
            "id": 2,
            "stretch_stiffness": 0.1,
            "bend_stiffness": 0.2,
            "tether_stiffness": 0.3,
        },
        {"$type": "set_flex_object_mass", "id": 2, "mass": 0.7},
    ]
    write_log(tmp_path / "config", [[[*thing(1, "cube", xyz(0, 0, 0)), *cloth]]])
    scene = only_scene(tmp_path)
    (sheet,) = scene.cloths
    assert scene.roles.agent == sheet.name and sheet.position == (0.1, -0.4, 1.5)
    assert sheet.size == pytest.approx((1.6, 1.2, 0.0)) and sheet.mass == 0.7
    assert (sheet.stretch, sheet.bend, sheet.tether) == (0.1, 0.2, 0.3)


def test_target_is_the_last_of_its_colour_where_object_two_is_gone(tmp_path: Path) -> None:
    red, blue = (1, 0, 0), (0, 0, 1)
    commands = [
        *thing(1, "cube", xyz(0, 0, 0)),
        *thing(2, "cube", xyz(1, 10, 10), color=red),
        {"$type": "destroy_object", "id": 2},
        *thing(3, "sphere", xyz(0, 1, 0), color=blue),
        *thing(4, "sphere", xyz(0, 2, 0), color=red),
        *thing(5, "sphere", xyz(0, 3, 0), color=blue),
    ]
    write_log(tmp_path / "config", [[commands]])
    scene = only_scene(tmp_path)
    assert scene.roles.agent == "sphere_4"
    assert [body.name for body in scene.bodies] == ["cube_1", "sphere_3", "sphere_4", "sphere_5"]


def test_vanishing_bodies_are_left_out_and_noted(tmp_path: Path) -> None:
    commands = two_cubes() + thing(3, "cube", xyz(0, 0, 0), scale=xyz(0, 0, 0), mass=0.0)
    write_log(tmp_path / "config", [[commands]])
    (trial,) = read_scenes(tmp_path).trials
    assert len(trial.scene.bodies) == 2
    assert any("cube_3" in note for note in trial.notes)


def test_fixed_joints_drag_and_materials(tmp_path: Path) -> None:
    commands = [
        *two_cubes(),
        *thing(3, "cylinder", xyz(0, 1.5, 0)),
        {"$type": "add_fixed_joint", "parent_id": 2, "id": 3},
        {"$type": "set_object_drag", "id": 3, "drag": 0.5, "angular_drag": 0.25},
        {
            "$type": "set_physic_material",
            "id": 3,
            "dynamic_friction": 0.1,
            "static_friction": 0.2,
            "bounciness": 0.3,
        },
    ]
    write_log(tmp_path / "config", [[commands]])
    scene = only_scene(tmp_path)
    (joint,) = scene.joints
    assert (joint.parent, joint.child) == ("cube_2", "cylinder_3")
    body = scene.bodies[2]
    assert (body.drag, body.angular_drag) == (0.5, 0.25)
    contact = body.contact
    assert (contact.dynamic_friction, contact.static_friction, contact.restitution) == (
        0.1,
        0.2,
        0.3,
    )


def test_unknown_commands_are_counted_and_duplicates_found(tmp_path: Path) -> None:
    frames = [[*two_cubes(), {"$type": "summon_dragon"}, {"$type": "summon_dragon"}]]
    write_log(tmp_path / "config", [frames, frames])
    found = read_scenes(tmp_path)
    assert found.unknown == {"summon_dragon": 4}
    unique, copies = found.unique()
    assert (len(unique), copies) == (1, 1)


def test_the_recorded_displacement_is_of_object_two(tmp_path: Path) -> None:
    write_log(tmp_path / "same", [[two_cubes()]])
    (trial,) = read_scenes(tmp_path / "same").trials
    # Object 2 starts at (0, 0, .5) in our axes and moves by (1, 3, 2).
    assert trial.outcome.final_position == (1, 3, 2.5)
    red = (1, 0, 0)
    commands = [
        *thing(1, "cube", xyz(0, 0, 0)),
        *thing(2, "cube", xyz(1, 10, 10), color=red),
        {"$type": "destroy_object", "id": 2},
        *thing(3, "sphere", xyz(0, 1, 0), color=red),
    ]
    write_log(tmp_path / "replaced", [[commands]])
    (trial,) = read_scenes(tmp_path / "replaced").trials
    assert trial.scene.roles.agent == "sphere_3"
    assert trial.outcome.final_position == (2, 13, 12)


def test_a_broken_line_fails_its_trial_only(tmp_path: Path) -> None:
    path = write_log(tmp_path / "config", [[two_cubes()], [two_cubes()]])
    lines = path.read_text().splitlines()
    lines[1] = '[{"$type": "add_object", trial 0'
    path.write_text("\n".join(lines))
    found = read_scenes(tmp_path)
    assert [trial.scene.name for trial in found.trials] == ["config_0001"]
    (failure,) = found.failures
    assert failure.trial == "0" and "line 2" in failure.message
    assert str(path) in str(failure)


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ({"$type": "set_mass", "id": 9, "mass": 1}, "object 9 was never created"),
        ({"$type": "set_mass", "id": 2}, "has no 'mass'"),
        ({"$type": "scale_object", "id": 2, "scale_factor": {"x": 1}}, "x, y and z"),
        (
            {"$type": "scale_object", "id": 2, "scale_factor": xyz(1, math.inf, 1)},
            "finite",
        ),
    ],
)
def test_bad_commands_name_line_and_trial(tmp_path: Path, command: Command, complaint: str) -> None:
    write_log(tmp_path / "config", [[two_cubes()], [[*two_cubes(), command]]])
    found = read_scenes(tmp_path)
    assert len(found.trials) == 1
    (failure,) = found.failures
    assert failure.trial == "1" and complaint in failure.message and "line 4" in failure.message


def test_objects_may_appear_move_and_vanish_later(tmp_path: Path) -> None:
    """Lists of the trial: creation, a late object, a teleport, a lone destruction, two more."""
    late = thing(3, "sphere", xyz(1, 2, 3), scale=xyz(0.5, 0.5, 0.5), mass=4.0)
    late += [{"$type": "teleport_object", "id": 3, "position": xyz(1, 2, 4)}]
    move = [
        {"$type": "teleport_object", "id": 1, "position": xyz(7, 0, 8)},
        {"$type": "rotate_object_by", "id": 1, "axis": "yaw", "angle": 180},
        {"$type": "teleport_object", "id": 2, "position": xyz(0, 5, 0)},
    ]
    push = {"$type": "apply_force_to_object", "force": xyz(1, 0, 0), "id": 3}
    gone = [{"$type": "destroy_object", "id": 3}]
    write_log(tmp_path / "config", [[two_cubes(), late, move, gone, [], [push | {"id": 2}]]])
    scene = only_scene(tmp_path)
    assert [body.name for body in scene.bodies] == ["cube_1", "cube_2", "sphere_3"]
    assert scene.bodies[2].position == (1, 4, 2) and scene.bodies[2].mass == 4.0
    appear, slab, cube, vanish = scene.events
    assert appear == BodyEvent(1, "sphere_3", "appear")
    assert (slab.frame, slab.body, slab.kind, slab.position) == (2, "cube_1", "move", (7, 8, 0))
    assert slab.rotation == pytest.approx((0, 0, 0, -1), abs=1e-12)
    assert cube == BodyEvent(2, "cube_2", "move", (0, 0, 5))
    assert vanish == BodyEvent(3, "sphere_3", "vanish")
    assert [push.frame for push in scene.pushes] == [5]
    assert Scene.from_json(scene.to_json()) == scene


@pytest.mark.parametrize("engine", ["physion", "mujoco"])
def test_a_log_whose_shelf_vanishes_is_simulated(tmp_path: Path, engine: str) -> None:
    still = {"$type": "set_kinematic_state", "is_kinematic": True, "use_gravity": True}
    start = [
        *thing(1, "cube", xyz(0, 0, 0), scale=xyz(2, 0.01, 2)),
        still | {"id": 1},
        *thing(2, "cube", xyz(0, 1.1, 0), scale=xyz(0.3, 0.3, 0.3)),
        *thing(3, "cube", xyz(0, 1, 0), scale=xyz(1, 0.1, 1)),
        still | {"id": 3},
    ]
    empty: list[list[Command]] = [[]] * 19
    gone = [{"$type": "destroy_object", "id": 3}]
    write_log(tmp_path / "held", [[start, *empty, []]])
    write_log(tmp_path / "dropped", [[start, *empty, gone, []]])
    labels = []
    for folder in ("held", "dropped"):
        scene = only_scene(tmp_path / folder)
        labels.append(label_contact(scene, make_engine(engine).simulate(scene)))
    assert not labels[0].contact
    # From frame 20 on it falls by 1.09 m.
    assert labels[1].first_frame == pytest.approx(20 + math.sqrt(2 * 1.09 / 9.81) / 0.01, abs=2)


def test_the_last_lists_that_destroy_objects_are_no_events(tmp_path: Path) -> None:
    gone = [{"$type": "destroy_object", "id": 2}]
    write_log(tmp_path / "config", [[two_cubes(), [], gone]])
    assert only_scene(tmp_path).events == ()


def test_a_later_object_may_take_the_place_of_the_target(tmp_path: Path) -> None:
    red = (1, 0, 0)
    start = [*thing(1, "cube", xyz(0, 0, 0)), *thing(2, "cube", xyz(1, 10, 10), color=red)]
    later = [{"$type": "destroy_object", "id": 2}, *thing(3, "bowl", xyz(0, 1, 0), color=red)]
    write_log(tmp_path / "config", [[start, later, []]])
    scene = only_scene(tmp_path)
    assert scene.roles.agent == "bowl_3"
    assert [(e.frame, e.body, e.kind) for e in scene.events] == [
        (1, "cube_2", "vanish"),
        (1, "bowl_3", "appear"),
    ]


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ({"$type": "set_mass", "id": 2, "mass": 1}, "cube_2 was created at frame 0"),
        ({"$type": "rotate_object_by", "id": 2, "angle": 9}, "give the rotation itself"),
        ({"$type": "add_fixed_joint", "parent_id": 1, "id": 2}, "both were created before"),
    ],
)
def test_what_a_scene_cannot_change_later_is_refused(
    tmp_path: Path, command: Command, complaint: str
) -> None:
    write_log(tmp_path / "config", [[two_cubes(), [], [command]]])
    (failure,) = read_scenes(tmp_path).failures
    assert complaint in failure.message and "line 4" in failure.message


def test_a_set_up_that_is_repeated_starts_the_trial_again(tmp_path: Path) -> None:
    """As in the official configuration simple_ramp_box_1_dis_1_occ of Roll."""
    push = {"$type": "apply_force_to_object", "force": xyz(1, 0, 0), "id": 2}
    write_log(tmp_path / "a" / "config", [[two_cubes(), [push], []]])
    write_log(tmp_path / "b" / "config", [[two_cubes(), two_cubes(), [push], []]])
    assert only_scene(tmp_path / "b") == only_scene(tmp_path / "a")


def test_a_later_object_of_the_same_id_replaces_the_earlier_one(tmp_path: Path) -> None:
    push = {"$type": "apply_force_to_object", "force": xyz(1, 0, 0), "id": 2}
    later = [*thing(2, "bowl", xyz(0, 1, 0)), push]
    again = thing(2, "bowl", xyz(0, 2, 0))
    write_log(tmp_path / "config", [[two_cubes(), [push], later, [], again]])
    scene = only_scene(tmp_path)
    assert [body.name for body in scene.bodies] == ["cube_2", "bowl_2_2", "cube_1", "bowl_2_3"]
    assert scene.roles.agent == "bowl_2_3"
    assert [push.body for push in scene.pushes] == ["cube_2", "bowl_2_2"]
    assert [(e.frame, e.body, e.kind) for e in scene.events] == [
        (2, "cube_2", "vanish"),
        (2, "bowl_2_2", "appear"),
        (4, "bowl_2_2", "vanish"),
        (4, "bowl_2_3", "appear"),
    ]


def test_destroyed_objects_take_no_commands(tmp_path: Path) -> None:
    gone = [{"$type": "destroy_object", "id": 2}]
    push = {"$type": "apply_force_to_object", "force": xyz(1, 0, 0), "id": 2}
    write_log(tmp_path / "config", [[two_cubes(), gone, [push]]])
    (failure,) = read_scenes(tmp_path).failures
    assert "object 2 was destroyed at frame 1" in failure.message


def test_missing_metadata_fails_its_log_only(tmp_path: Path) -> None:
    write_log(tmp_path / "a", [[two_cubes()]])
    write_log(tmp_path / "b", [[two_cubes()]])
    (tmp_path / "a" / "metadata.json").unlink()
    found = read_scenes(tmp_path)
    assert [trial.scene.name for trial in found.trials] == ["b_0000"]
    assert "metadata.json is missing" in str(found.failures[0])


def test_truncated_archives_are_failures(tmp_path: Path) -> None:
    path = write_log(tmp_path / "config", [[two_cubes()]], packed=True)
    path.write_bytes(path.read_bytes()[:-20])
    found = read_scenes(tmp_path)
    assert not found.trials and "cannot be read to its end" in str(found.failures[0])


def test_folders_without_logs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="holds no tdw_commands"):
        read_scenes(tmp_path)
    with pytest.raises(BadInputError, match="does not exist"):
        read_scenes(tmp_path / "nowhere")


@pytest.mark.nightly
@pytest.mark.slow
def test_official_logs_are_imported_completely(official: Path) -> None:
    found = read_scenes(official / "scenes")
    assert found.failures == [] and not found.unknown
    assert {trial.scene.scenario for trial in found.trials} == {
        "dominoes",
        "support",
        "collide",
        "contain",
        "drop",
        "link",
        "roll",
        "drape",
    }
    with (official / "stimuli" / "stimulus_names_and_labels.csv").open() as file:
        published = {row["stim_ID"]: row["label"] == "True" for row in csv.DictReader(file)}
    shared = [t for t in found.trials if t.scene.name in published]
    assert len(shared) > 500
    assert all(published[t.scene.name] == t.outcome.contact for t in shared)
    for trial in found.trials[::50]:
        assert Scene.from_json(trial.scene.to_json()) == trial.scene


def test_a_packed_log_is_not_unpacked_beyond_its_limit(tmp_path: Path) -> None:
    """A line of 300 MB in 300 KB: what is unpacked stays below three times the longest line."""
    folder = tmp_path / "bomb"
    path = write_log(folder, [[two_cubes()]], packed=True)
    path.write_bytes(gzip.compress(b" " * 2**20) * 300)
    tracemalloc.start()
    found = read_scenes(tmp_path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    (failure,) = found.failures
    assert f"has a line of more than {MAX_LINE_BYTES} bytes" in failure.message
    assert peak < 3 * MAX_LINE_BYTES


@pytest.mark.slow
def test_a_packed_log_of_many_lines_is_bounded_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_log(tmp_path / "bomb", [[two_cubes()]], packed=True)
    monkeypatch.setattr("physion.scenes.tdw.commands.MAX_LOG_BYTES", 2**20)
    (tmp_path / "bomb" / "metadata.json").write_text("[]")
    path.write_bytes(gzip.compress(b"[] trial 0\n" * 2**10) * 100)
    (failure,) = read_scenes(tmp_path).failures
    assert "has more than 1048576 bytes uncompressed" in failure.message


@pytest.mark.parametrize("text", ["[" * 100_000, '[{"a": ' * 100_000])
def test_deep_metadata_is_one_line(tmp_path: Path, text: str) -> None:
    write_log(tmp_path / "deep", [[two_cubes()]])
    (tmp_path / "deep" / "metadata.json").write_text(text)
    (failure,) = read_scenes(tmp_path).failures
    assert "metadata.json cannot be read" in failure.message and "\n" not in failure.message


@pytest.mark.parametrize(
    ("limit", "command", "complaint"),
    [
        ("MAX_THINGS", thing(7, "cube", xyz(0, 1, 0))[0], "more than 2 objects"),
        (
            "MAX_CHANGES",
            {"$type": "apply_force_to_object", "force": xyz(1, 0, 0), "id": 2},
            "more than 2 pushes, joints and events",
        ),
        ("MAX_NAME", thing(7, "cube" * 100, xyz(0, 1, 0))[0], "more than 200 characters"),
    ],
)
def test_trials_are_bounded(
    tmp_path: Path,
    limit: str,
    command: Command,
    complaint: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if limit != "MAX_NAME":
        monkeypatch.setattr(f"physion.scenes.tdw.commands.{limit}", 2)
    write_log(tmp_path / "config", [[[*two_cubes(), command, command, command]]])
    (failure,) = read_scenes(tmp_path).failures
    assert complaint in failure.message and "\n" not in failure.message
