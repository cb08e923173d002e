"""Roll and Drape: sampled scenes compared with the official command logs."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physion.core.errors import BadInputError, BadSceneError
from physion.core.seeds import trial_seed
from physion.numerics.rotations import rotate_vectors
from physion.physics.cloth.simulate import settle_solids
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.physics.rigid.bodies import collision_hulls
from physion.scenes.sampling.parameters import euler_rotation
from physion.scenes.sampling.placement import (
    BodyRule,
    project_to_image,
    world_bounds,
    world_corners,
)
from physion.scenes.sampling.sample import Preset, load_presets, parse_presets, sample_scene
from physion.scenes.scenarios import drape, roll
from physion.scenes.scene import Body, Scene
from physion.scenes.shapes.primitives import shape
from physion.scenes.tdw.read_logs import read_scenes

ROLL = Path("scenes") / "roll"
DRAPE = Path("scenes") / "drape"
SAMPLES = 30


def draw(scenario: str, params: Any, index: int) -> Scene:
    return sample_scene(scenario, trial_seed("test", scenario, "train", index), params)


def body(scene: Scene, name: str) -> Body:
    return scene.bodies[scene.index(name)]


def published(scenario: str) -> list[Preset]:
    return [preset for preset in load_presets(scenario).values() if preset.published]


def scenes_of(preset: Preset, count: int = SAMPLES) -> list[Scene]:
    return [draw(preset.scenario, preset.params, index) for index in range(count)]


def official_scenes(official: Path, scenario: str, preset: Preset) -> list[Scene]:
    folder = official / "scenes" / scenario / str(preset.official)
    if not folder.is_dir():
        return []
    return [trial.scene for trial in read_scenes(folder).trials]


def span(values: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    array = np.array(values, float)
    return array.min(axis=0), array.max(axis=0)


def inside(outer: Sequence[Any], inner: Sequence[Any], slack: float = 0.0) -> bool:
    """Return whether the range of ``inner`` is in that of ``outer``, extended by ``slack``."""
    (low, high), (inner_low, inner_high) = span(outer), span(inner)
    room = slack * (high - low) + 1e-4
    return bool((inner_low >= low - room).all() and (inner_high <= high + room).all())


# Roll.


@pytest.mark.slow
@pytest.mark.parametrize("preset", published("roll"), ids=lambda preset: preset.name)
def test_roll_is_drawn_as_the_official_scenes(official: Path, preset: Preset) -> None:
    real = official_scenes(official, "roll", preset)
    if not real:
        pytest.skip("no command log of this configuration")
    ours = scenes_of(preset)
    template = preset.params.template[0]
    assert {scene.room for scene in ours} == {scene.room for scene in real}
    assert {scene.ending for scene in ours} == {scene.ending for scene in real}
    for role in ("agent", "patient", "probe"):
        theirs = [body(s, getattr(s.roles, role)) for s in real if getattr(s.roles, role)]
        drawn = [body(s, getattr(s.roles, role)) for s in ours if getattr(s.roles, role)]
        assert bool(theirs) == bool(drawn)
        if not theirs:
            continue
        assert {thing.shape for thing in theirs} <= {thing.shape for thing in drawn}
        assert {(t.mass, t.contact, t.angular_drag) for t in theirs} == {
            (t.mass, t.contact, t.angular_drag) for t in drawn
        }
        for key in ("scale", "position"):
            values = [getattr(t, key) for t in drawn], [getattr(t, key) for t in theirs]
            if key == "position" and template != "ledge" and role in ("agent", "probe"):
                # Turned ones are raised until they are clear of ramp and floor.
                values = [v[:2] for v in values[0]], [v[:2] for v in values[1]]
            floor = (0.0, 0.0, ours[0].floor)[: len(values[0][0])]
            drawn_values = [np.subtract(v, floor) if key == "position" else v for v in values[0]]
            assert inside(drawn_values, values[1], slack=0.2), (role, key)
    for one, other in (("camera.height", 2), ("camera.across", None)):
        places = [
            [s.camera.position[2] if other else math.hypot(*s.camera.position[:2]) for s in group]
            for group in (ours, real)
        ]
        assert inside(*places, slack=0.2), one
    if preset.params.template != ("ramp",):
        speeds = [
            [math.hypot(*p.impulse) / body(s, p.body).mass for s in group for p in s.pushes]
            for group in (ours, real)
        ]
        headings = [
            [math.atan2(p.impulse[1], p.impulse[0]) for s in group for p in s.pushes]
            for group in (ours, real)
        ]
        assert inside(*speeds, slack=0.2) and inside(*headings, slack=0.2)


@pytest.mark.slow
def test_roll_samples_and_records_each_template() -> None:
    params = roll.RollParameters(template=roll.TEMPLATES)
    seen = set()
    for index in range(SAMPLES):
        scene = draw("roll", params, index)
        (template,) = scene.parameters["template"]
        seen.add(template)
        names = {thing.name for thing in scene.bodies}
        assert {"ramp": "ramp", "ledge": "ledge", "collision": "probe"}[template] in names
        assert scene.ending.max_frames == (152 if template == "collision" else 302)
        assert bool(scene.pushes) == (template != "ramp")
        only = draw("roll", dataclasses.replace(params, template=(template,)), index)
        assert only.physics_digest() == scene.physics_digest()
    assert seen == set(roll.TEMPLATES)


def in_ramp(points: np.ndarray, ramp: Body) -> np.ndarray:
    """Which points (K, 3) are inside a ramp: by the half-spaces of its hull's sides."""
    found = np.ones(len(points), bool)
    (hull,) = collision_hulls(ramp.shape, ramp.scale)
    corners = rotate_vectors(ramp.rotation, hull.corners) + ramp.position
    middle = corners.mean(axis=0)
    for face in hull.faces:
        a, b, c = corners[face[:3]]
        normal = np.cross(b - a, c - a)
        normal *= np.sign((middle - a) @ normal)
        found &= (points - a) @ normal > 0
    return found


@pytest.mark.parametrize("name", ["ramp_with_platform_30", "ramp_with_platform_60"])
def test_target_starts_outside_the_ramp(name: str) -> None:
    rule = dataclasses.replace(roll.RampRule(), shapes=(name,), drop=0.0, lift=0.01)
    rule = dataclasses.replace(
        rule, target=BodyRule(("dumbbell", "cube"), (0.3, 0.3), roll.ANY_ROTATION)
    )
    raised = 0
    for index in range(SAMPLES):
        scene = draw("roll", roll.RollParameters(ramp=rule), index)
        target, ramp = body(scene, "target"), body(scene, "ramp")
        corners = world_corners(target)
        one, other = (
            np.array(ends) for ends in zip(*itertools.combinations(corners, 2), strict=True)
        )
        shares = np.linspace(0, 1, 60)[:, None, None]
        between = (one * shares + other * (1 - shares)).reshape(-1, 3)
        assert not in_ramp(between, ramp).any()
        z = float(world_corners(ramp)[:, 2].max()) - 0.01
        if target.position[2] > z + 1e-9:
            raised += 1
            if name == "ramp_with_platform_30":  # the other ends below the target
                # Not higher than needed: a centimetre lower it would be inside.
                assert in_ramp(between - (0.0, 0.0, 0.01), ramp).any()
    assert raised > 0


def test_target_is_released_above_the_slope() -> None:
    for index in range(SAMPLES):
        scene = draw("roll", roll.RollParameters(), index)
        target, ramp = body(scene, "target"), body(scene, "ramp")
        low, high = world_bounds(ramp)
        assert low[0] < target.position[0] < high[0] < world_bounds(body(scene, "zone"))[0, 0]
        assert ramp.kinematic and not target.kinematic


def test_ledge_stands_on_the_floor_as_high_as_the_official_one_reaches() -> None:
    scene = draw("roll", roll.RollParameters(template=("ledge",)), 0)
    low, high = world_bounds(body(scene, "ledge"))
    assert low[2] == 0 and high[2] == pytest.approx(0.025)
    assert high[0] - low[0] == pytest.approx(0.05) and high[1] - low[1] == pytest.approx(100)
    # The upper half of what a ball of the same scale collides with, at its middle.
    (ball,) = collision_hulls("sphere", (0.05, 100.0, 0.05))
    section = ball.corners[np.abs(ball.corners[:, 1]) < 1e-9][:, [0, 2]] - (0.0, 0.025)
    upper = section[section[:, 1] > -1e-9]
    ours = shape("half:cylinder").mesh.vertices[:, [0, 2]] * 0.05
    for point in upper:
        assert np.abs(ours - point).max(axis=1).min() < 1e-9


def test_scenery_stands_on_both_sides_of_the_ledge() -> None:
    params = roll.RollParameters(template=("ledge",))
    rule = dataclasses.replace(params.scenery, distractors=2, occluders=2)
    scene = draw("roll", dataclasses.replace(params, scenery=rule), 1)
    scenery = [thing for thing in scene.bodies if thing.scenery]
    assert len(scenery) == 4
    assert all(math.hypot(*thing.position[:2]) < 6 for thing in scenery)


def test_probes_of_collisions_are_tumbled_and_start_above_the_floor() -> None:
    params = roll.RollParameters(template=("collision",))
    turns = np.array([euler_rotation(a, a, a) for a in np.arange(-180, 180, 0.25)])
    raised = 0
    for index in range(60):
        scene = draw("roll", params, index)
        probe = body(scene, "probe")
        assert world_bounds(probe)[0, 2] >= -1e-9
        raised += probe.position[2] > 0.25
        (push,) = scene.pushes
        assert push.point is not None
        assert push.point[2] == pytest.approx(
            probe.position[2] + 0.35 * min(0.8, float(shape(probe.shape).bounds[1, 2]))
        )
        assert np.abs(turns @ probe.rotation).max() > 0.99999
    assert 0 < raised < 30


# Drape.


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("preset", published("drape"), ids=lambda preset: preset.name)
def test_drape_is_drawn_as_the_official_scenes(official: Path, preset: Preset) -> None:
    real = official_scenes(official, "drape", preset)
    if not real:
        pytest.skip("no command log of this configuration")
    ours = scenes_of(preset, 150)
    # By order: zone, left and right anchor, prop, extra anchor in the logs.
    order = ("zone", "anchor_left", "anchor_right", "prop")
    for number, name in enumerate(order[:3]):
        theirs, drawn = [s.bodies[number] for s in real], [body(s, name) for s in ours]
        assert {t.mass for t in theirs} == {t.mass for t in drawn}
        assert {t.shape for t in theirs} <= {t.shape for t in drawn}
        assert inside([t.scale for t in drawn], [t.scale for t in theirs], 0.1), name
        places = [[t.position[:2] for t in group] for group in (drawn, theirs)]
        assert inside(*places, slack=0.1), name
    props = [[world_bounds(body(s, "prop"))[:, :2] for s in ours]]
    props += [[world_bounds(s.bodies[3])[:, :2] for s in real]]
    assert inside(*props, slack=0.01)
    heights = [[body(s, "prop").scale[2] for s in ours], [s.bodies[3].scale[2] for s in real]]
    assert inside(*heights, slack=0.01)
    theirs = [s.bodies[4] for s in real if len(s.bodies) > 4]
    drawn = [body(s, "anchor_extra") for s in ours if "anchor_extra" in s.names()]
    for side in (-1, 1):
        groups = [
            [(t.position[0], t.scale[2]) for t in group if t.position[0] * side > 0]
            for group in (drawn, theirs)
        ]
        assert inside(*groups, slack=0.1)
    cloths = [[s.cloths[0] for s in group] for group in (ours, real)]
    assert inside(*[[c.position for c in group] for group in cloths], slack=0.1)
    assert len({(c.size, c.mass, c.resolution) for group in cloths for c in group}) == 1
    heights = [[s.camera.position[2] for s in group] for group in (ours, real)]
    distances = [[math.hypot(*s.camera.position[:2]) for s in group] for group in (ours, real)]
    assert inside(*heights, slack=0.1) and inside(*distances, slack=0.1)
    assert {(s.ending, s.settle_frames, s.room) for s in (*ours, *real)} == {
        (real[0].ending, 100, "box")
    }


@pytest.mark.slow
def test_cloth_is_the_agent_and_nothing_meets_on_the_floor() -> None:
    for preset, index in itertools.product(load_presets("drape").values(), range(10)):
        scene = draw("drape", preset.params, index)
        assert scene.roles.agent == scene.cloths[0].name == "cloth"
        assert scene.roles.patient == "zone" and not scene.pushes
        assert all(thing.kinematic for thing in scene.bodies)
        for one, other in itertools.combinations(scene.bodies, 2):
            a, b = world_bounds(one), world_bounds(other)
            assert (a[1, :2] <= b[0, :2]).any() or (b[1, :2] <= a[0, :2]).any()
        top = max(world_bounds(thing)[1, 2] for thing in settle_solids(scene).bodies)
        assert top < scene.cloths[0].position[2] + 0.01
        for point in (scene.cloths[0].position, world_bounds(body(scene, "zone")).mean(axis=0)):
            assert max(map(abs, project_to_image(scene.camera, point))) < 1


@pytest.mark.slow
def test_third_anchor_has_its_probability() -> None:
    scenes = [draw("drape", drape.DrapeParameters(), index) for index in range(300)]
    extra = [body(s, "anchor_extra") for s in scenes if "anchor_extra" in s.names()]
    assert abs(len(extra) / 300 - 0.7) < 0.1
    assert abs(sum(t.position[0] < 0 for t in extra) / len(extra) - 0.65) < 0.12
    none = dataclasses.replace(drape.DrapeParameters().anchors, extra=0.0)
    bare = draw("drape", drape.DrapeParameters(anchors=none), 0)
    assert "anchor_extra" not in bare.names()


def test_larger_cloth_has_more_vertices() -> None:
    for size, vertices in ((2.0, 51), (1.4, 36), (3.0, 76)):
        rule = drape.ClothRule(size=(size, size))
        (cloth,) = draw("drape", drape.DrapeParameters(cloth=rule), 0).cloths
        assert cloth.size == (size, size, 0.0) and cloth.resolution == vertices


def test_what_cannot_be_placed_is_an_error_with_reason() -> None:
    tight = drape.AnchorRule(between=(0.0, 0.0), jitter=0.0)
    with pytest.raises(BadSceneError, match=r"anchor_right .*100 tries.*anchor_left"):
        draw("drape", drape.DrapeParameters(anchors=tight), 0)


@pytest.mark.parametrize("key", ["height", "extra_height"])
def test_anchors_have_a_minimum_height(key: str) -> None:
    text = 'scenario = "drape"\n[presets.low.params]\nanchors = { height_jitter = 0.7, '
    higher = parse_presets(text + "height = 0.71, extra_height = 0.8 }", "own.toml")["low"].params
    draw("drape", higher, 0)
    said = rf"anchors: height_jitter is 0\.7 m and {key} 0\.704 m; their difference must be "
    values = {"height": 0.71, "extra_height": 0.71, key: 0.704}
    with pytest.raises(BadInputError, match=f"^own.toml: preset 'low': {said}"):
        parse_presets(text + ", ".join(f"{k} = {v}" for k, v in values.items()) + " }", "own.toml")
    low = drape.AnchorRule(height_jitter=0.7, **values)
    with pytest.raises(BadInputError, match=f"^parameters of drape: {said}"):
        draw("drape", drape.DrapeParameters(anchors=low), 0)


def test_natural_sizes_are_python_floats() -> None:
    """Numbers of numpy would be shown as np.float64(...) in messages."""
    scene = draw("drape", drape.DrapeParameters(), 0)
    assert {type(side) for one in scene.bodies for side in one.scale} == {float}


def test_cloth_over_the_zone_touches_it_and_cloth_next_to_it_does_not() -> None:
    low = drape.AnchorRule(height=0.05, height_jitter=0.0, taller=0.0, extra=0.0)
    near = drape.ClothRule(size=(0.8, 0.8), x=(0.0, 0.0), y=(0.1, 0.1), height=(0.6, 0.6))
    params = drape.DrapeParameters(
        near,
        low,
        zone_share=(0.5, 0.5),
        zone_y=(0.1, 0.1),
        prop=drape.PropRule(("stool",), shift=(0.0, -2.0)),
    )
    scene = draw("drape", params, 0)
    labels = label_contact(scene, simulate(scene))
    assert labels.contact and labels.first_frame is not None
    far = dataclasses.replace(params, cloth=dataclasses.replace(near, x=(1.2, 1.2)))
    scene = draw("drape", far, 0)
    assert not label_contact(scene, simulate(scene)).contact
