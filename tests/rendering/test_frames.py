"""Whole frames: repeatable, independent of each other, in every room, with plausible colours."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.seeds import child_generator, trial_seed
from physion.physics.engine import simulate
from physion.rendering.camera import View
from physion.rendering.renderer import (
    PASSES,
    Frame,
    Renderer,
    RenderSettings,
    role_map,
)
from physion.rendering.rooms import rooms
from physion.rendering.textures.atlas import FINISHES, SIZE, build_atlas, finish
from physion.scenes.sampling.build import scenarios
from physion.scenes.sampling.sample import parse_presets
from physion.scenes.scene import FLOORS, BodyEvent, Camera, Cloth, Look, Scene
from physion.scenes.tdw.read_logs import read_scenes
from support.paths import FIND_TESTS
from support.rendered_scenes import ALL, body, resting, scene_of, tumbling


def digest(frame: Frame) -> str:
    sha = hashlib.sha256()
    for name in PASSES:
        value = getattr(frame, name)
        sha.update(b"" if value is None else value.tobytes())
    return sha.hexdigest()


def test_shapes_and_types_of_the_passes() -> None:
    scene, trajectory = tumbling()
    frame = Renderer(scene, trajectory, 96, 64).render(0, ALL)
    types = {name: (getattr(frame, name).shape, getattr(frame, name).dtype.name) for name in ALL}
    assert types == {
        "color": ((64, 96, 3), "uint8"),
        "depth": ((64, 96), "float32"),
        "normals": ((64, 96, 3), "float32"),
        "ids": ((64, 96), "int16"),
        "flow": ((64, 96, 2), "float32"),
    }


def test_only_the_passes_asked_for_are_made_and_they_do_not_depend_on_each_other() -> None:
    scene, trajectory = tumbling()
    together = Renderer(scene, trajectory, 64, 64).render(1, ALL)
    for name in PASSES:
        alone = Renderer(scene, trajectory, 64, 64).render(1, (name,))
        np.testing.assert_array_equal(getattr(alone, name), getattr(together, name))
        assert all(getattr(alone, other) is None for other in PASSES if other != name)


def test_a_frame_does_not_depend_on_the_frames_rendered_before_it() -> None:
    scene, trajectory = tumbling()
    fresh = [digest(Renderer(scene, trajectory, 128, 128).render(i, ALL)) for i in range(3)]
    one = Renderer(scene, trajectory, 128, 128)
    assert [digest(one.render(i, ALL)) for i in (2, 0, 1, 0)] == [fresh[i] for i in (2, 0, 1, 0)]
    assert len(set(fresh)) == 3
    assert [digest(f) for f in one.frames(ALL)] == fresh


def test_a_frame_does_not_depend_on_the_frames_after_the_next() -> None:
    scene, trajectory = tumbling(4)
    arrays = ("positions", "rotations", "velocities", "angular_velocities", "cloth_vertices")
    cut = dataclasses.replace(
        trajectory,
        cloth_distance=trajectory.cloth_distance[:2],
        **{name: getattr(trajectory, name)[:2] for name in arrays},
    )
    whole, part = Renderer(scene, trajectory, 64, 64), Renderer(scene, cut, 64, 64)
    assert digest(whole.render(0, ALL)) == digest(part.render(0, ALL))


@pytest.mark.slow
@pytest.mark.parametrize("scenario", sorted(scenarios.names()))
@pytest.mark.parametrize("size", [(40, 56), (96, 96)])
def test_what_is_kept_between_frames_changes_no_byte(scenario: str, size: tuple[int, int]) -> None:
    """Frames in any order, in any room, with a body that appears and vanishes."""
    seed = trial_seed("kept", scenario, "testing", size[0])
    rng = child_generator(seed, "frames")
    chosen = scenarios.get(scenario)
    scene = chosen.sample(chosen.params(), seed)
    room = str(rng.choice(sorted(rooms.names())))
    scene = dataclasses.replace(scene, room=room, events=_passing_body(scene))
    trajectory = simulate(scene, frames=60)
    kept, fresh = (
        Renderer(scene, trajectory, *size, RenderSettings(keep_static=static))
        for static in (True, False)
    )
    order = [int(i) for i in rng.permutation(60)[:7]]
    for frame in (*order, order[0]):
        passes = ALL if frame % 2 else ("color",)
        assert digest(kept.render(frame, passes)) == digest(fresh.render(frame, passes))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_what_is_kept_does_not_depend_on_where_things_move(seed: int) -> None:
    """Bodies that leap anywhere, also over the edges of the depth maps, and a crumpled cloth."""
    rng = np.random.default_rng(seed)
    shapes = rng.choice(["cube", "sphere", "cone", "torus", "bowl"], 7)
    textures = rng.choice(sorted(FINISHES), 7)
    things = [
        body(f"thing_{i}", str(shape), tuple(rng.uniform((-1, -1, 0), 1)), kinematic=i > 4,
             scale=tuple(rng.uniform(0.1, 0.5, 3)), look=Look(tuple(rng.random(3)), texture))
        for i, (shape, texture) in enumerate(zip(shapes, textures, strict=True))
    ]  # fmt: skip
    cloths = [Cloth("sheet", (0.0, 0.0, 0.5), (1.0, 1.0, 0.0), resolution=9)] * int(seed % 2)
    camera = Camera(tuple(rng.uniform((2, 2, 1), 4)), (0.0, 0.0, 0.3))
    room = str(rng.choice(sorted(rooms.names())))
    scene = scene_of(*things, cloths=cloths, camera=camera, room=room)
    events = (BodyEvent(2, "thing_1", "vanish"), BodyEvent(3, "thing_6", "appear"))
    scene = dataclasses.replace(scene, events=events[: int(rng.integers(3))])
    trajectory = resting(scene, 6)
    changing = [*range(5), *(scene.index(event.body) for event in scene.events)]
    trajectory.positions[:, changing] = rng.uniform(
        (-2.8, -2.8, 0), (2.8, 2.8, 1.2), (6, len(changing), 3)
    )
    trajectory.cloth_vertices[...] += rng.normal(0, 0.1, trajectory.cloth_vertices.shape)
    size = [int(side) for side in rng.integers(20, 90, 2)]
    kept, fresh = (
        Renderer(scene, trajectory, *size, RenderSettings(keep_static=static))
        for static in (True, False)
    )
    for frame in (*rng.permutation(6), *rng.integers(6, size=4)):
        passes = ALL if frame % 2 else ("color",)
        assert digest(kept.render(frame, passes)) == digest(fresh.render(frame, passes))


def _passing_body(scene: Scene) -> tuple[BodyEvent, ...]:
    """Return events by which scenery, or a body without a role, comes and goes, if there is any."""
    roles = {scene.roles.agent, scene.roles.patient, scene.roles.probe}
    spare = [body.name for body in scene.bodies if body.name not in roles and body.scenery]
    return (BodyEvent(10, spare[0], "vanish"), BodyEvent(40, spare[-1], "appear")) if spare else ()


@pytest.mark.parametrize("kinematic", [False, True])
def test_absent_bodies_are_not_drawn_and_cast_no_shadow(kinematic: bool) -> None:
    small = {"scale": (0.4, 0.4, 0.4)}
    rest = (body("block", at=(-0.5, 0.0, 0.0), **small), body("zone", at=(0.6, 0.0, 0.0), **small))
    late = body("late", "sphere", (0.0, 0.3, 0.2), kinematic=kinematic, **small)
    always = scene_of(*rest, late, room="box")
    events = (BodyEvent(1, "late", "appear"), BodyEvent(2, "late", "vanish"))
    scene = dataclasses.replace(always, events=events)
    renderer = Renderer(scene, resting(scene, 3), 64, 64)
    away = resting(always)
    away.positions[0, 2] = (0.0, 0.0, 500.0)
    without = Renderer(always, away, 64, 64).render(0, ALL)
    shown = [renderer.render(frame, ALL) for frame in range(3)]
    assert [(frame.ids == 3).any() for frame in shown] == [False, True, False]
    for frame in (shown[0], shown[2]):
        np.testing.assert_array_equal(frame.color, without.color)
        np.testing.assert_array_equal(frame.depth, without.depth)
    assert not np.array_equal(shown[1].color, without.color)
    assert np.nanmax(np.abs(shown[1].flow)) < 1e-3


@pytest.mark.nightly
@pytest.mark.slow
def test_a_fresh_process_gives_the_same_bytes() -> None:
    scene, trajectory = tumbling()
    code = (
        "from support.rendered_scenes import tumbling, ALL\n"
        "from tests.rendering.test_frames import digest\n"
        "from physion.rendering.renderer import Renderer\n"
        "print(digest(Renderer(*tumbling()).render(1, ALL)))"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], env=FIND_TESTS, capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == digest(Renderer(scene, trajectory).render(1, ALL))


@pytest.mark.parametrize("room", ["box", "bright"])
@pytest.mark.parametrize("step", range(8))
def test_rooms_have_no_holes_and_are_not_over_exposed(room: str, step: int) -> None:
    angle = step * np.pi / 4
    camera = Camera((2.5 * np.cos(angle), 2.5 * np.sin(angle), 1.2), (0.0, 0.0, 1.0))
    scene = scene_of(
        body("box", at=(0.0, 0.0, 0.0), scale=(0.2, 0.2, 0.2)), camera=camera, room=room
    )
    frame = Renderer(scene, resting(scene), 128, 128).render(0, ("color", "depth"))
    assert frame.color is not None and frame.depth is not None
    assert np.isfinite(frame.depth).all()
    assert (frame.color.min(-1) >= 253).mean() < 0.01
    assert 30 < frame.color.mean() < 190


def test_room_panels_face_inwards() -> None:
    for name in ("box", "bright"):
        room = rooms.get(name)
        floor = room.panels[0]
        assert np.cross(floor.u, floor.v)[2] > 0
        assert floor.corner[2] == 0.0


def floor_color(frame: Frame, view: View, point: tuple[float, float, float]) -> float:
    assert frame.color is not None
    (x, y), _ = view.project(point)
    return float(frame.color[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2].mean())


def test_objects_throw_soft_shadows_and_occlude_the_ground_around_them() -> None:
    camera = Camera((0.0, 3.0, 2.5), (0.0, 0.0, 0.0))
    view = View(camera, 256, 256)
    far = body("far", at=(2.0, -2.0, 0.0), scale=(0.1, 0.1, 0.1))
    empty = scene_of(far, camera=camera)
    plain = Renderer(empty, resting(empty)).render(0)
    high = scene_of(far, body("lid", at=(0.0, 0.0, 1.0), scale=(0.8, 0.8, 0.02)), camera=camera)
    shaded = Renderer(high, resting(high)).render(0)
    direction = np.asarray(rooms.get("empty").light_direction)
    under = (-direction[0] / direction[2], -direction[1] / direction[2], 0.0)
    assert floor_color(shaded, view, under) < 0.95 * floor_color(plain, view, under)
    # Inside the edge, on it, and outside of it.
    x, y = under[0], under[1]
    steps = [floor_color(shaded, view, (x + dx, y, 0.0)) for dx in (0.2, 0.4, 0.6)]
    assert steps[0] < steps[1] < steps[2]
    low = scene_of(far, body("box", at=(0.0, 0.0, 0.0), scale=(0.4, 0.4, 0.4)), camera=camera)
    occluded = Renderer(low, resting(low)).render(0)
    spot = (0.27, 0.0, 0.0)  # towards the light, where no shadow falls
    assert floor_color(occluded, view, spot) < 0.98 * floor_color(plain, view, spot)


def test_color_is_anti_aliased() -> None:
    camera = Camera((0.0, 3.0, 0.8), (0.0, 0.0, 0.8))
    ball = body("ball", "sphere", (0.0, 0.0, 0.3), look=Look((0.0, 0.0, 0.0), "plain"))
    scene = scene_of(ball, camera=camera)
    frame = Renderer(scene, resting(scene), 128, 128).render(0, ("color", "ids"))
    assert frame.color is not None and frame.ids is not None
    row = frame.color[64].astype(int).sum(-1)
    dark, light = row[64], row[5]
    edges = np.flatnonzero(np.diff((frame.ids[64] == 1).astype(int)))
    between = [v for e in edges for v in row[e : e + 2] if dark + 60 < v < light - 60]
    assert light - dark > 200
    assert between


@pytest.mark.slow
def test_textures_keep_their_mean_over_the_levels_and_their_bytes() -> None:
    names = tuple(sorted({f.texture for f in FINISHES.values()}))
    atlas = build_atlas(names)
    assert (np.diff(atlas.starts.ravel()) > 0).all()
    for row, name in enumerate(names):
        start = atlas.starts[row]
        full = (atlas.texels[start[0] : start[1], :3] / 255.0) ** 2
        last = (atlas.texels[start[-1], :3] / 255.0) ** 2
        assert start[1] - start[0] == SIZE**2
        np.testing.assert_allclose(full.mean(0), last, atol=0.01, err_msg=name)
    build_atlas.cache_clear()
    np.testing.assert_array_equal(build_atlas(names).texels, atlas.texels)


def test_role_map_shows_agent_and_patient() -> None:
    scene, trajectory = tumbling()
    ids = Renderer(scene, trajectory, 128, 128).render(0, ("ids",)).ids
    assert ids is not None
    colors = role_map(ids, scene)
    assert colors.shape == (128, 128, 4) and colors.dtype == np.uint8
    assert set(map(tuple, colors[ids == 1])) == {(255, 0, 0, 255)}
    assert set(map(tuple, colors[ids == 4])) == {(255, 255, 0, 255)}
    assert set(colors[(ids != 1) & (ids != 4)][:, 3]) == {0}


def test_errors_name_what_is_wrong() -> None:
    scene, trajectory = tumbling()
    renderer = Renderer(scene, trajectory, 32, 32)
    with pytest.raises(UnknownNameError, match="closest: color"):
        renderer.render(0, ("colour",))
    with pytest.raises(BadInputError, match="frame 3 of a trajectory of 3 frames"):
        renderer.render(3)
    with pytest.raises(BadInputError, match="0 x 32 pixels"):
        Renderer(scene, trajectory, 0, 32)
    other = scene_of(body("alone"))
    with pytest.raises(BadInputError, match="trajectory of 3 bodies"):
        Renderer(other, trajectory)
    with pytest.raises(UnknownNameError, match="unknown room"):
        Renderer(dataclasses.replace(scene, room="attic"), trajectory)
    with pytest.raises(UnknownNameError, match="wood_ash"):
        finish("wood_ahs")


@pytest.mark.nightly
@pytest.mark.slow
def test_first_trial_of_every_scenario_shows_agent_and_patient(official: Path) -> None:
    trials = read_scenes(official / "scenes", limit=1).trials
    assert len({trial.scene.scenario for trial in trials}) == 8
    for trial in trials:
        scene = trial.scene
        frame = Renderer(scene, resting(scene), 96, 96).render(0, ("color", "depth", "ids"))
        assert frame.color is not None and frame.depth is not None and frame.ids is not None
        assert np.isfinite(frame.depth).all(), scene.name
        assert 30 < frame.color.mean() < 190, scene.name
        assert (frame.color.min(-1) >= 253).mean() < 0.02, scene.name
        for role in (scene.roles.agent, scene.roles.patient):
            assert (frame.ids == scene.index(role) + 1).any(), (scene.name, role)


PRESET = """
scenario = "collide"
[presets.mine]
about = "In a room of another package."
params = {room = "red"}
"""
PLUG_IN = """
from dataclasses import replace
from physion.rendering.rooms import rooms
empty = rooms.get("empty")
RED = replace(empty, panels=tuple(replace(p, color=(1.0, 0.0, 0.0)) for p in empty.panels))
"""
SHOW = """
import numpy as np, sys
from physion.physics.engine import simulate
from physion.rendering.renderer import PASSES, Renderer
from physion.scenes.sampling.sample import sample_scene
scene = sample_scene("collide", 3, preset=f"{sys.argv[1]}:mine")
frame = Renderer(scene, simulate(scene, frames=2), 32, 32).render(0, PASSES)
room = frame.color[frame.ids == 0].astype(float)
print(scene.room, scene.floor, room[:, 0].mean() > 3 * room[:, 1].mean())
"""


def test_the_rooms_of_presets_match_the_renderer() -> None:
    assert set(FLOORS) == set(rooms.names())


def test_an_unknown_room_is_refused_when_the_preset_is_read() -> None:
    with pytest.raises(BadInputError, match="'red'"):
        parse_presets(PRESET, "my.toml")


@pytest.mark.slow
def test_a_preset_may_use_a_room_of_another_package(tmp_path: Path) -> None:
    (tmp_path / "own_room.py").write_text(PLUG_IN)
    (tmp_path / "own-1.0.dist-info").mkdir()
    (tmp_path / "own-1.0.dist-info" / "METADATA").write_text("Name: own\nVersion: 1.0\n")
    points = "[physion.rooms]\nred = own_room:RED\n"
    (tmp_path / "own-1.0.dist-info" / "entry_points.txt").write_text(points)
    (tmp_path / "mine.toml").write_text(PRESET)
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-c", SHOW, str(tmp_path / "mine.toml")],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == ["red", "0.0", "True"], done.stderr
