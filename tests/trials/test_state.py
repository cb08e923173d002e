"""State of a trial: motion, contacts, meshes, camera, masks and tables."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.rendering.renderer import Renderer
from physion.scenes.sampling.sample import sample_scene
from physion.scenes.scene import (
    Body,
    Camera,
    Cloth,
    Ending,
    Look,
    Push,
    Roles,
    Scene,
    SurfaceMaterial,
)
from physion.trials import state
from physion.trials.trial_file import Trial, TrialWriter
from support.hand_made import make_parts

WIDTH, HEIGHT = 96, 64


def _pack(scene: Scene) -> Trial:
    """The trial of a scene, simulated and stored."""
    trajectory = simulate(scene)
    frame = Renderer(scene, trajectory, WIDTH, HEIGHT).render(0, ("ids",))
    assert frame.ids is not None
    changes = {
        "trial": scene.name,
        "scenario": scene.scenario,
        "width": WIDTH,
        "height": HEIGHT,
        "frames": len(trajectory),
        "look": "redyellow",
        "engine": trajectory.engine,
        "completed": trajectory.completed,
        "digest": trajectory.digest(),
    }
    meta = dataclasses.replace(make_parts().metadata, **changes)
    labels = label_contact(scene, trajectory)
    return Trial(TrialWriter(meta, scene, trajectory, labels, frame.ids).finish(), "the trial")


@pytest.fixture(scope="module")
def collision() -> Trial:
    """A ball that is pushed off centre into a box, beside a vase that is only drawn."""
    scene = Scene(
        name="collision",
        scenario="collide",
        bodies=(
            Body("box", "cube", (0.5, 0.0, 0.0), scale=(0.3, 0.3, 0.5), mass=2.0),
            Body(
                "ball",
                "sphere",
                (-0.5, 0.0, 0.0),
                scale=(0.3, 0.3, 0.3),
                mass=0.5,
                contact=SurfaceMaterial(0.4, 0.3, 0.2),
                look=Look((0.1, 0.2, 0.3), "metal"),
            ),
            Body("cone", "cone", (0.0, 0.8, 0.0), (0.4, 0.4, 0.8), kinematic=True),
            Body("vase", "prop:vase", (-0.5, 1.0, 0.0), scale=(0.3, 0.3, 0.5), scenery=True),
        ),
        roles=Roles("ball", "box", probe="ball"),
        camera=Camera((0.2, -3.0, 1.6), (0.0, 0.0, 0.25), math.radians(45)),
        pushes=(
            Push("ball", (1.5, 0.0, 0.0), (-0.65, 0.0, 0.15), frame=4),
            Push("box", (0.0, 0.2, 0.0), frame=50),
        ),
        room="empty",
        ending=Ending(min_frames=60, max_frames=60),
    )
    return _pack(scene)


@pytest.fixture(scope="module")
def hanging() -> Trial:
    """The hand-made trial with a cloth of 3 x 3 vertices in the air."""
    return Trial(make_parts().pack(), "the hand-made trial")


def test_centres_of_mass_move_as_fast_as_the_engine_says(collision: Trial) -> None:
    centers = state.centroids(collision)
    linear = collision.trajectory.velocities
    assert centers.shape == (60, 4, 3) and linear.shape == (60, 4, 3)

    def error(places: NDArray[np.float32]) -> float:
        # On average: where bodies collide, the last sweep changes speeds after they have moved.
        steps = np.diff(places[:, 1].astype(np.float64), axis=0) / 0.01
        return float(np.abs(steps - linear[1:, 1]).mean())

    assert np.ptp(linear[:, 1, 0]) > 2
    assert error(centers) < 0.02
    assert error(collision.trajectory.positions) > 0.2, "the ball rolls, and its pivot with it"


def test_centres_of_mass_match_solids_and_cloth(collision: Trial, hanging: Trial) -> None:
    first = state.centroids(collision)[0]
    np.testing.assert_allclose(first[0], [0.5, 0.0, 0.25], atol=1e-3)
    np.testing.assert_allclose(first[1], [-0.5, 0.0, 0.15], atol=1e-3)
    np.testing.assert_allclose(first[2], [0.0, 0.8, 0.2], atol=1e-3)  # a quarter of its height
    centers = state.centroids(hanging)
    assert centers.shape[1] == 3
    vertices = hanging.trajectory.cloth_vertices
    np.testing.assert_allclose(centers[:, 2], vertices.mean(axis=1), atol=1e-5)


def test_contacts_are_named_and_normals_go_from_the_first_to_the_second(collision: Trial) -> None:
    table, stored = state.contact_table(collision), collision.trajectory.contacts
    assert len(table) == len(stored.frame)
    np.testing.assert_array_equal(table["impulse"], stored.impulse)
    np.testing.assert_allclose(table["time"], table["frame"] * 0.01)
    assert set(table["first"]) == {state.FLOOR, "box"}
    normals = table[["normal_x", "normal_y", "normal_z"]].to_numpy()
    pair = ((table["first"] == "box") & (table["second"] == "ball")).to_numpy()
    assert pair.any() and table["frame"][pair].iloc[0] == collision.labels.first_frame
    np.testing.assert_allclose(normals[pair][0], [-1, 0, 0], atol=0.2)
    assert table["point_x"][pair].iloc[0] == pytest.approx(0.35, abs=0.05), "the box's side"
    on_floor = (table["first"] == state.FLOOR).to_numpy()
    assert set(table["second"][on_floor]) == {"box", "ball"}
    assert normals[on_floor, 2].min() > 0.99
    np.testing.assert_allclose(table["point_z"][on_floor], 0, atol=0.01)
    assert state.contact_table(Trial(make_parts(contact_frame=None).pack(), "apart")).empty


def test_meshes_scaled_and_unscaled(collision: Trial, hanging: Trial) -> None:
    found = state.meshes(collision)
    assert list(found) == collision.scene.names()
    np.testing.assert_allclose(np.ptp(found["box"].vertices, axis=0), [1, 1, 1])
    np.testing.assert_allclose(np.ptp(found["box"].scaled, axis=0), [0.3, 0.3, 0.5])
    np.testing.assert_allclose(np.ptp(found["vase"].scaled, axis=0), [0.3, 0.3, 0.5])
    sheet = state.meshes(hanging)["sheet"]
    np.testing.assert_allclose(np.ptp(sheet.vertices, axis=0), [2, 2, 0])
    assert sheet.faces.shape == (8, 3) and sheet.faces.max() == 8


def test_world_vertices_rest_where_the_bodies_are(collision: Trial, hanging: Trial) -> None:
    start = state.world_vertices(collision, 0)
    np.testing.assert_allclose(start["box"].min(axis=0), [0.35, -0.15, 0], atol=1e-4)
    np.testing.assert_allclose(start["cone"].max(axis=0)[2], 0.8, atol=1e-4)
    end = state.world_vertices(collision, 59)
    middle = (end["ball"].min(axis=0) + end["ball"].max(axis=0)) / 2
    np.testing.assert_allclose(middle, state.centroids(collision)[59, 1], atol=0.01)
    cloth = state.world_vertices(hanging, 7)["sheet"]
    np.testing.assert_array_equal(cloth, hanging.trajectory.cloth_vertices[7])
    with pytest.raises(BadInputError, match="no frame 60"):
        state.world_vertices(collision, 60)


def test_the_object_table_says_what_everything_is(collision: Trial, hanging: Trial) -> None:
    table = state.object_table(collision).set_index("name")
    ball = table.loc["ball"]
    assert (ball["shape"], ball["mass"], ball["role"]) == ("sphere", 0.5, "agent+probe")
    friction = ball[["static_friction", "dynamic_friction", "restitution"]]
    assert tuple(friction) == (0.4, 0.3, 0.2)
    assert tuple(table.loc["box", ["scale_x", "scale_y", "scale_z"]]) == (0.3, 0.3, 0.5)
    assert table["role"].tolist() == ["patient", "agent+probe", "", ""]
    assert table["kinematic"].tolist() == [False, False, True, False]
    assert table["scenery"].tolist() == [False, False, False, True]
    # Colours match the look.
    free = state.object_table(collision, "free").set_index("name").loc["ball"]
    marked = state.object_table(collision, "redyellow").set_index("name").loc["ball"]
    colors = [tuple(row[["red", "green", "blue"]]) for row in (ball, marked, free)]
    assert colors == [(1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.1, 0.2, 0.3)]
    cloth = state.object_table(hanging).iloc[-1]
    names = ("name", "kind", "shape", "scale_x")
    assert tuple(cloth[name] for name in names) == ("sheet", "cloth", "sheet", 2)
    assert pd.isna(cloth["static_friction"])


def test_the_camera_agrees_with_the_renderer(collision: Trial) -> None:
    """A ball's centre is projected onto the middle of the pixels that show it, in every frame."""
    inside, outside = state.camera_intrinsics(collision), state.camera_extrinsics(collision)
    centers = state.centroids(collision)
    for frame in (0, 20, 59):
        ids = collision.render(frame, ("ids", "depth"))
        assert ids.ids is not None and ids.depth is not None
        for index in (0, 1, 2):
            seen = outside @ np.append(centers[frame, index], 1.0)
            u, v, w = inside @ seen[:3]
            u, v = u / w, v / w
            assert ids.ids[int(v), int(u)] == index + 1
            assert 0 < w - ids.depth[int(v), int(u)] < 0.5, "the surface is in front of the centre"
        rows, columns = np.nonzero(ids.ids == 2)
        seen = outside @ np.append(centers[frame, 1], 1.0)
        u, v, w = inside @ seen[:3]
        assert abs(columns.mean() + 0.5 - u / w) < 0.7
        assert abs(rows.mean() + 0.5 - v / w) < 0.7
    np.testing.assert_allclose(state.camera_intrinsics(collision, 192, 128)[:2], 2 * inside[:2])
    np.testing.assert_allclose(inside[:2, 2], [48, 32])
    position = np.linalg.inv(outside)[:3, 3]
    np.testing.assert_allclose(position, collision.scene.camera.position)


def test_masks_show_agent_and_patient(collision: Trial) -> None:
    ball, box = state.role_masks(collision, 0)
    assert ball.shape == (HEIGHT, WIDTH) and ball.dtype == np.bool_
    np.testing.assert_array_equal(ball, collision.ids == 2)
    np.testing.assert_array_equal(box, collision.ids == 1)
    later, _ = state.role_masks(collision, 30)
    assert np.nonzero(later)[1].mean() > np.nonzero(ball)[1].mean() + 5, "the ball goes right"
    assert not (ball & box).any()
    with pytest.raises(BadInputError, match="no frame -1"):
        state.role_masks(collision, -1)


def test_pushes_say_when_and_how_hard(collision: Trial) -> None:
    table = state.pushes(collision)
    assert table["body"].tolist() == ["ball", "box"] and table["frame"].tolist() == [4, 50]
    np.testing.assert_allclose(table["time"], [0.04, 0.5])
    np.testing.assert_allclose(table["speed"], [3.0, 0.1])
    assert table.loc[0, ["point_x", "point_y", "point_z"]].tolist() == [-0.65, 0.0, 0.15]
    assert table.loc[1, ["point_x", "point_y", "point_z"]].isna().all()
    linear = collision.trajectory.velocities
    # The push acts in the step that leads to frame 4.
    assert abs(linear[3, 1, 0]) < 0.01 and linear[4, 1, 0] == pytest.approx(3.0, abs=0.1)


def test_cloths_are_kept_apart() -> None:
    parts = make_parts()
    scene = parts.scene
    two = dataclasses.replace(
        scene, cloths=(*scene.cloths, Cloth("second", (0.0, 0.0, 3.0), resolution=2))
    )
    vertices = np.concatenate(
        [parts.trajectory.cloth_vertices, np.full((60, 4, 3), 7.0, np.float32)], axis=1
    )
    motion = dataclasses.replace(parts.trajectory, cloth_vertices=vertices)
    meta = dataclasses.replace(parts.metadata, digest=motion.digest())
    stored = parts._replace(scene=two, trajectory=motion, metadata=meta)
    trial = Trial(stored.pack(), "two cloths")
    np.testing.assert_array_equal(state.centroids(trial)[:, 3], np.full((60, 3), 7.0))
    assert (state.world_vertices(trial, 3)["second"] == 7).all()


def test_what_was_drawn_lies_in_the_ranges_of_the_parameters() -> None:
    scenes = [sample_scene("collide", seed) for seed in range(6)]
    found = [state.drawn_values(scene) for scene in scenes]
    for scene, values in zip(scenes, found, strict=True):
        assert set(values) == set(state.DRAWN)
        ranges = scene.parameters
        target = scene.bodies[scene.index(scene.roles.agent)]
        assert values["drawn_agent_mass"] == target.mass
        assert values["drawn_agent_shape"] in ranges["target"]["shapes"]
        assert values["drawn_probe_static_friction"] == pytest.approx(0.4)
        low, high = ranges["push"]["speed"]
        assert low <= float(str(values["drawn_push_speed"])) <= high
        heading = float(str(values["drawn_push_heading"]))
        assert ranges["push"]["heading_deg"][0] <= heading <= ranges["push"]["heading_deg"][1]
        x, y, _ = scene.camera.position
        assert values["drawn_camera_distance"] == pytest.approx(math.hypot(x, y))
        assert values["drawn_camera_azimuth"] == pytest.approx(math.degrees(math.atan2(y, x)))
        agent, patient = (scene.bodies[scene.index(name)].position
                          for name in (scene.roles.agent, scene.roles.patient))  # fmt: skip
        assert values["drawn_distance"] == pytest.approx(math.dist(agent[:2], patient[:2]))
    assert len({values["drawn_push_speed"] for values in found}) == 6
    assert found[0]["drawn_blocks"] == 0 and found[0]["drawn_cloth_bend"] is None


def test_blocks_and_cloth_are_drawn_values_too() -> None:
    row = sample_scene("dominoes", 0, preset="default_boxroom")
    values = state.drawn_values(row)
    blocks = [body for body in row.bodies if body.name.startswith("middle_")]
    assert values["drawn_blocks"] == len(blocks) > 0
    assert values["drawn_block_mass"] == pytest.approx(np.mean([body.mass for body in blocks]))
    sheet = sample_scene("drape", 0)
    values = state.drawn_values(sheet)
    assert values["drawn_agent_mass"] == sheet.cloths[0].mass
    assert values["drawn_cloth_bend"] == sheet.cloths[0].bend
    assert values["drawn_agent_shape"] is None and values["drawn_probe_mass"] is None
    assert values["drawn_push_speed"] is None


def test_objects_beyond_the_edges_of_the_picture() -> None:
    """The camera looks along -y from 10 m; at the origin it sees 10 tan(fov / 2) to each side."""
    half = 10 * math.tan(0.25)
    wide = half * WIDTH / HEIGHT
    camera = Camera((0.0, 10.0, 0.0), (0.0, 0.0, 0.0), fov=0.5)
    thin = (0.4, 0.0002, 0.4)  # all vertices at the same depth
    bodies = (
        Body("inside", "cube", (0.0, 0.0, -0.2), thin, kinematic=True),
        Body("cut", "cube", (wide, 0.0, -0.2), thin, kinematic=True),
        Body("away", "cube", (0.0, 0.0, half + 0.3), thin, kinematic=True),
        Body("behind", "cube", (0.0, 12.0, 0.0), thin, kinematic=True),
        Body("drawn", "cube", (9.0, 0.0, 0.0), thin, scenery=True),
    )
    scene = Scene(
        name="edges",
        scenario="collide",
        bodies=bodies,
        roles=Roles("inside", "cut"),
        camera=camera,
        ending=Ending(46, 46),
    )
    trial = _pack(scene)
    assert state.outside_picture(trial) == {"cut": 0.5, "away": 1.0, "behind": 1.0}
