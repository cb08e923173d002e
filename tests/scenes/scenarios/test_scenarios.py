"""Properties of the scenes of every scenario."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from physion.core.errors import BadInputError, BadSceneError, UnknownNameError
from physion.core.seeds import child_generator, trial_seed
from physion.numerics.rotations import rotate_vectors
from physion.scenes.looks import RED, YELLOW, is_mistakable, with_role_colors
from physion.scenes.sampling.build import Scenario, scenarios
from physion.scenes.sampling.placement import CameraRule, SceneryRule, place_camera, world_bounds
from physion.scenes.sampling.sample import get_preset, parse_presets, sample_scene
from physion.scenes.scenarios.collide import CollideParameters as Collide
from physion.scenes.scenarios.dominoes import DominoesParameters as Dominoes
from physion.scenes.scenarios.drop import DropParameters as Drop
from physion.scenes.scenarios.drop import random_rotation
from physion.scenes.scene import Body, Scene
from physion.scenes.shapes.primitives import expand_props, shape
from support.sound_scenes import (
    assert_seen,
    assert_valid,
    body,
    bounds,
    overlap,
    overlapping,
    thing,
)

TRIALS = range(12)


@pytest.fixture(params=scenarios.names())
def scenario(request: pytest.FixtureRequest) -> Scenario:
    return scenarios.get(request.param)


def draw(scenario: Scenario, index: int, distractors: int = 2, occluders: int = 1) -> Scene:
    rule = dataclasses.replace(
        scenario.params().scenery, distractors=distractors, occluders=occluders
    )
    params = dataclasses.replace(scenario.params(), scenery=rule)
    return scenario.sample(params, trial_seed("test", scenario.name, "train", index))


def test_overlap_of_hulls() -> None:
    cube = shape("cube").mesh.vertices
    assert overlap(cube, cube + np.array([0.9, 0.9, 0.9]))
    assert not overlap(cube, cube + np.array([1.01, 0, 0]))
    # Boxes meet, hulls do not: a cone beside the tip of another.
    cone = shape("cone").mesh.vertices
    assert not overlap(cone, cone + np.array([0.9, 0, 0.5]))


def test_scene_is_valid_and_has_roles(scenario: Scenario) -> None:
    for index in TRIALS:
        scene = draw(scenario, index)
        assert scene.scenario == scenario.name
        assert scene.ending.min_frames == 151
        assert_valid(scene)


def test_same_seed_same_scene_other_seed_other_scene(scenario: Scenario) -> None:
    assert draw(scenario, 3).to_json() == draw(scenario, 3).to_json()
    digests = {draw(scenario, index).physics_digest() for index in TRIALS}
    assert len(digests) == len(TRIALS)
    assert len({draw(scenario, index).name for index in TRIALS}) == len(TRIALS)


def test_json_round_trip(scenario: Scenario) -> None:
    scene = draw(scenario, 0)
    assert Scene.from_json(scene.to_json()) == scene


@pytest.mark.slow
def test_agent_and_patient_are_in_the_image(scenario: Scenario) -> None:
    for index in TRIALS:
        assert_seen(draw(scenario, index))


def test_nothing_overlaps_at_the_start(scenario: Scenario) -> None:
    for index in TRIALS:
        assert not overlapping(draw(scenario, index)), index


@pytest.mark.slow
def test_scenery_is_outside_the_bodies(scenario: Scenario) -> None:
    for index in TRIALS:
        scene = draw(scenario, index, distractors=2, occluders=2)
        scenery = [bounds(one) for one in scene.bodies if one.scenery]
        assert len(scenery) == 4
        for a, b in itertools.product(map(bounds, stands(scene)), scenery):
            assert (a[1, :2] < b[0, :2]).any() or (b[1, :2] < a[0, :2]).any()


def stands(scene: Scene) -> list[Body]:
    """Solids, without a plate that reaches so near to the camera that occluders stand on it."""
    near = math.hypot(*scene.camera.position[:2]) / 2
    flat = {
        one.name
        for one in scene.bodies
        if one.kinematic and one.scale[2] < 0.05 and math.hypot(*one.scale[:2]) / 2 > near
    }
    assert len(flat) <= 1
    return [one for one in scene.bodies if not one.scenery and one.name not in flat]


@pytest.mark.slow
def test_scenery_changes_neither_motion_nor_camera_nor_looks(scenario: Scenario) -> None:
    for index in TRIALS:
        bare, full = draw(scenario, index, 0, 0), draw(scenario, index, 3, 2)
        assert len(full.bodies) == len(bare.bodies) + 5
        assert full.bodies[: len(bare.bodies)] == bare.bodies
        assert full.camera == bare.camera and full.pushes == bare.pushes
        assert full.physics_digest() == bare.physics_digest()


def props(scene: Scene, kind: str) -> list[tuple[object, ...]]:
    """Return what is drawn of each prop of a kind; its place depends on the others."""
    return [(b.shape, b.scale, b.look) for b in scene.bodies if b.name.startswith(kind)]


@pytest.mark.nightly
@pytest.mark.slow
def test_distractors_and_occluders_have_streams_of_their_own(scenario: Scenario) -> None:
    same = 0
    for index in TRIALS:
        scenes = [draw(scenario, index, count, 1) for count in range(4)]
        assert all(props(scene, "occluder") == props(scenes[0], "occluder") for scene in scenes)
        longest = props(scenes[3], "distractor")
        for count, scene in enumerate(scenes):
            assert props(scene, "distractor") == longest[:count]
        more = draw(scenario, index, 1, 3)
        assert props(more, "distractor") == longest[:1]
        params = scenario.params()
        rule = dataclasses.replace(
            params.scenery,
            distractors=1,
            occluders=1,
            distractor_props=("full",),
            occluder_props=("full",),
        )
        params = dataclasses.replace(params, scenery=rule)
        alike = scenario.sample(params, trial_seed("test", scenario.name, "train", index))
        one, other = body(alike, "distractor_0"), body(alike, "occluder_0")
        same += (one.shape, one.look) == (other.shape, other.look)
    assert same < 4, "the same prop is drawn for both now and then, not always"


def test_scenery_is_behind_and_in_front(scenario: Scenario) -> None:
    for index in TRIALS:
        scene = draw(scenario, index)
        toward = np.array(scene.camera.position[:2])
        assert np.dot(body(scene, "distractor_0").position[:2], toward) < 0
        assert np.dot(body(scene, "occluder_0").position[:2], toward) > 0


def test_role_colors(scenario: Scenario) -> None:
    scene = draw(scenario, 0)
    bodies = list(scene.bodies)
    for i, color in enumerate([(0.9, 0.1, 0.2), (0.8, 0.8, 0.1)], start=2):
        look = dataclasses.replace(bodies[i].look, color=color)
        bodies[i] = dataclasses.replace(bodies[i], look=look)
    scene = dataclasses.replace(scene, bodies=tuple(bodies))
    painted = with_role_colors(scene)
    assert painted == with_role_colors(scene)
    assert thing(painted, scene.roles.agent).look.color == RED
    assert thing(painted, scene.roles.patient).look.color == YELLOW
    assert (RED, YELLOW) == ((1.0, 0.0, 0.0), (1.0, 1.0, 0.0))
    assert painted.physics_digest() == scene.physics_digest()
    for name in scene.names():
        before, after = thing(scene, name).look, thing(painted, name).look
        assert after.texture == before.texture
        if name in (scene.roles.agent, scene.roles.patient):
            continue
        near = any(is_mistakable(before.color, c) for c in (RED, YELLOW))
        assert near == (before.color != after.color)
        assert not any(is_mistakable(after.color, c) for c in (RED, YELLOW))


def test_colors_mistakable_for_red_or_yellow() -> None:
    assert is_mistakable((0.9, 0.2, 0.1), RED) and is_mistakable((0.45, 0.05, 0.05), RED)
    assert is_mistakable((0.8, 0.8, 0.1), YELLOW) and is_mistakable((0.5, 0.48, 0.05), YELLOW)
    for fine in [(0.45, 0.3, 0.18), (0.1, 0.1, 0.9), (0.1, 0.0, 0.0), (0.85, 0.84, 0.8)]:
        assert not is_mistakable(fine, RED) and not is_mistakable(fine, YELLOW)


def test_unknown_scenario_error_has_closest_names() -> None:
    with pytest.raises(UnknownNameError, match="dominoes"):
        sample_scene("domino", trial_seed("test", "domino", "train", 0))


def test_default_parameters_are_used_and_recorded() -> None:
    scene = sample_scene("drop", trial_seed("test", "drop", "train", 0))
    assert scene.parameters["height"] == [1.25, 1.5]


def test_camera_shows_what_is_inside_its_field_of_view_or_is_an_error() -> None:
    # It looks along -y from a distance of the square root of 2, with 55 degrees from side to side.
    side = math.sqrt(2) * math.tan(math.radians(55 / 2))
    rule = CameraRule((1.0, 1.0), (45.0, 45.0), (0.0, 0.0))
    for x in (-0.97 * side, 0.97 * side):
        near = Body("near", "cube", (x, 0.0, 0.0), (0.1, 0.1, 0.1))
        place_camera(np.random.default_rng(0), rule, 0.0, (near,))
    for x, y in ((-side, 0.0), (side, 0.0), (0.0, 40.0)):
        far = Body("far", "cube", (x, y, 0.0), (0.1, 0.1, 0.1))
        with pytest.raises(BadSceneError, match=r"^no camera shows far: [^\d]*$"):
            place_camera(np.random.default_rng(0), rule, 0.0, (far,))


def test_scenery_does_not_overlap_or_is_an_error() -> None:
    params, crowded = get_preset("dominoes", "default").params, Counter[str]()
    for count in (4, 12):
        rule = dataclasses.replace(params.scenery, distractors=count, occluders=count // 2)
        for index in TRIALS:
            seed = trial_seed("test", "dominoes", "crowd", index)
            try:
                scene = sample_scene("dominoes", seed, dataclasses.replace(params, scenery=rule))
            except BadSceneError as error:
                crowded[str(error)] += 1
                continue
            props = [one for one in scene.bodies if one.scenery]
            assert len(props) == count + count // 2
            for one, other in itertools.combinations(props, 2):
                reach = math.hypot(*one.scale[:2]) + math.hypot(*other.scale[:2])
                assert math.dist(one.position[:2], other.position[:2]) >= reach / 2
    assert 0 < sum(crowded.values()) < 2 * len(TRIALS)
    assert all(re.match(r"no room for (distractor|occluder)_\d+ next to \w+: ", c) for c in crowded)


@pytest.mark.parametrize("key", ["distractors", "occluders"])
def test_scenery_counts_are_limited(key: str) -> None:
    text = f'scenario = "drop"\n[presets.many.params]\nscenery.{key} = 13'
    with pytest.raises(BadInputError, match=f"many': scenery: {key} is 13, allowed is 0 to 12"):
        parse_presets(text, "own.toml")


def test_camera_follows_the_official_rule() -> None:
    for i in range(20):
        rng = child_generator(trial_seed("test", "camera", "x", i), "camera")
        camera = place_camera(rng, CameraRule((2.0, 2.0), (0.0, 90.0), (1.5, 2.5)), 0.7, ())
        x, y, z = camera.position
        assert math.hypot(x, y) == pytest.approx(2 * math.sqrt(2))
        assert 45 <= math.degrees(math.atan2(y, x)) <= 135
        assert 1.5 <= z <= 2.5 and camera.target == (0, 0, 0.7)
    for mirror, x in ((0.0, 1.0), (1.0, -1.0)):
        rule = CameraRule((1.0, 1.0), (0.0, 0.0), (1.0, 1.0), mirror)
        camera = place_camera(np.random.default_rng(0), rule, 0.5, ())
        assert camera.position == pytest.approx((x, 1.0, 1.0))
        assert math.degrees(camera.fov) == pytest.approx(55.0)


def speed(scene: Scene) -> float:
    """Return the speed that the push gives to the probe, m/s."""
    (push,) = scene.pushes
    return math.hypot(*push.impulse) / body(scene, push.body).mass


def heading(scene: Scene) -> float:
    x, y, _ = scene.pushes[0].impulse
    return math.degrees(math.atan2(y, x))


def mass_of(name: str) -> Callable[[Scene], float]:
    return lambda scene: body(scene, name).mass


def size_of(name: str, axis: int = 0) -> Callable[[Scene], float]:
    return lambda scene: body(scene, name).scale[axis]


def place_of(name: str, axis: int) -> Callable[[Scene], float]:
    return lambda scene: body(scene, name).position[axis]


def density_of(name: str) -> Callable[[Scene], float]:
    """Return the mass of a cube with sides of 0.5 m of the body's density."""
    return lambda scene: body(scene, name).mass / math.prod(body(scene, name).scale) / 8


DRAWN: dict[str, list[tuple[Callable[[Scene], float], float, float]]] = {
    "dominoes": [
        (speed, 0.75, 0.75),
        (lambda scene: scene.pushes[0].frame, 0, 14),
        (lambda scene: scene.pushes[0].point[2], 0.4, 0.4),  # type: ignore[index]
        (mass_of("target"), 2, 2),
        (place_of("probe", 0), -0.75, -0.75),
        # Half a target, and 0.1 m of gap, before a zone of 0.5 m.
        (place_of("zone", 0), 0.75 + 0.1 + 0.5, 0.75 + 0.1 + 0.5),
    ],
    "support": [
        (speed, 1, 8),
        (density_of("target"), 2, 2),
        (density_of("block_0"), 2, 2),
        (size_of("block_0"), 0.4, 0.5),
        (lambda scene: scene.pushes[0].frame, 15, 15),
    ],
    "collide": [
        (speed, 5, 10),
        (heading, -8, 8),
        (mass_of("probe"), 2, 2),
        (size_of("probe"), 0.35, 0.35),
        (place_of("zone", 0), 2, 2),
        (place_of("zone", 1), -0.35, 0.35),
        (lambda scene: body(scene, "probe").contact.static_friction, 0.4, 0.4),
        (lambda scene: scene.camera.position[2], 0.75, 2.0),
    ],
    "contain": [
        (speed, 4, 9),
        (density_of("base"), 2, 3),
        (size_of("base"), 0.5, 1.0),
        # A quarter of the mass of 2 kg.
        (density_of("target"), 0.5, 0.5),
        (size_of("target"), 0.2, 0.4),
        (mass_of("probe"), 3, 3),
    ],
    "drop": [
        (mass_of("target"), 2, 7),
        (mass_of("lower"), 10, 11),
        (size_of("target"), 0.1, 0.4),
        (size_of("lower"), 0.3, 1.0),
        (place_of("target", 0), -0.2, 0.2),
        (place_of("target", 1), -0.2, 0.2),
    ],
    "link": [
        (speed, 1, 7),
        (mass_of("probe"), 12, 12),
        (density_of("base"), 4, 4),
        (density_of("target"), 0.5, 0.5),
        # A cylinder of 4 kg for the cube around it.
        (density_of("attachment"), math.pi, math.pi),
    ],
    "roll": [
        (place_of("ramp", 0), -0.625, -0.625),
        (place_of("zone", 0), 1.25, 1.25),
        (mass_of("target"), 2, 2),
    ],
    "drape": [
        (lambda scene: scene.cloths[0].stretch, 0, 1),
        (lambda scene: scene.cloths[0].bend, 0, 1),
        (lambda scene: scene.cloths[0].tether, 0, 1),
        (lambda scene: scene.cloths[0].mass, 0.5, 0.5),
        (lambda scene: scene.cloths[0].position[0], -0.2, 0.2),
        (lambda scene: scene.cloths[0].position[1], -0.6, -0.4),
        (lambda scene: scene.cloths[0].position[2], 1.3, 1.5),
        (lambda scene: math.hypot(*scene.camera.position[:2]) / math.sqrt(2), 1.5, 2.5),
    ],
}
"""What a scene's default parameters draw, from the smallest to the largest value of the official
rules (docs/official-system.md, sections 2 and 3)."""


@pytest.mark.nightly
@pytest.mark.slow
def test_values_are_drawn_from_the_whole_of_their_official_range(scenario: Scenario) -> None:
    params = scenario.params()
    seeds = [trial_seed("range", scenario.name, "train", index) for index in range(60)]
    scenes = [scenario.sample(params, seed) for seed in seeds]
    for number, (value, low, high) in enumerate(DRAWN[scenario.name]):
        values = [value(scene) for scene in scenes]
        margin = 0.15 * (high - low)
        assert low - 1e-6 <= min(values) <= low + margin + 1e-6, (number, min(values))
        assert high - margin - 1e-6 <= max(values) <= high + 1e-6, (number, max(values))


def test_floor_of_the_bright_room_is_4_to_5_mm_higher() -> None:
    for room, low, high in (("box", 0.0, 0.0), ("bright", 0.004, 0.005), ("empty", 0.0, 0.0)):
        scene = sample_scene("collide", 3, dataclasses.replace(Collide(), room=room))
        assert low <= scene.floor <= high
        assert body(scene, "zone").position[2] == scene.floor == body(scene, "target").position[2]


def still_row(**changed: object) -> Dominoes:
    """Return parameters of two metres of upright dominoes without jitter of orientation."""
    middle = dataclasses.replace(Dominoes().middle, turn_deg=(0.0, 0.0))
    values = {"length": 2.0, "middle": middle, "spacing_jitter": 0.0, "lateral_jitter": 0.0}
    return dataclasses.replace(Dominoes(), **(values | changed))


def test_dominoes_rows() -> None:
    seed = trial_seed("test", "dominoes", "train", 0)
    for count in (0, 1, 4, 8):
        scene = sample_scene("dominoes", seed, still_row(middles=count))
        row = [b.position[0] for b in scene.bodies if b.name.startswith("middle")]
        assert row == pytest.approx(np.linspace(-1, 1, count + 2)[1:-1])
    gaps = set()
    for index in range(30):
        seed = trial_seed("test", "dominoes", "train", index)
        scene = sample_scene("dominoes", seed, still_row(middles=4, remove_middle=True))
        gaps |= {f"middle_{i}" for i in range(4)} - {b.name for b in scene.bodies}
        assert sum(b.name.startswith("middle") for b in scene.bodies) == 3
    assert len(gaps) == 4, "any of them may be left out"


def test_dominoes_that_do_not_fit_are_an_error() -> None:
    seed = trial_seed("test", "dominoes", "train", 0)
    with pytest.raises(BadSceneError, match=r"2 m long .*100 tries: no room for 30 dominoes"):
        sample_scene("dominoes", seed, still_row(middles=30))
    with pytest.raises(BadSceneError, match="probe and target would start inside"):
        sample_scene("dominoes", seed, still_row(middles=0, length=0.05))
    with pytest.raises(BadSceneError, match="probe and target would start inside"):
        sample_scene("collide", seed, dataclasses.replace(Collide(), length=0.2))


def test_pushes_rotate_with_the_probe() -> None:
    probe = dataclasses.replace(Dominoes().probe, turn_deg=(40.0, 60.0))
    for index in TRIALS:
        seed = trial_seed("test", "dominoes", "train", index)
        for turned in (True, False):
            scene = sample_scene("dominoes", seed, still_row(probe=probe, turned_push=turned))
            x, y, _ = scene.pushes[0].impulse
            w, *_, z = body(scene, "probe").rotation
            expected = 2 * math.atan2(z, w) if turned else 0.0
            assert math.atan2(y, x) == pytest.approx(expected)
        assert 40 <= math.degrees(2 * math.atan2(z, w)) <= 60


def test_lower_body_of_drop_is_on_zone_or_floor() -> None:
    zone = Drop().zone
    for center, height in (((0.0, 0.0), 0.01), ((0.0, 1.0), 0.01), ((0.0, 3.0), 0.0)):
        params = dataclasses.replace(Drop(), zone=dataclasses.replace(zone, center=center))
        scene = sample_scene("drop", trial_seed("test", "drop", "train", 1), params)
        assert bounds(body(scene, "lower"))[0, 2] == pytest.approx(height)
        assert body(scene, "zone").position == (*center, 0.0)


def test_drop_falls_freely_and_is_in_view() -> None:
    large = dataclasses.replace(Drop().dropped, scale=(0.9, 1.0))
    for index in TRIALS:
        seed = trial_seed("test", "drop", "train", index)
        params = dataclasses.replace(Drop(), dropped=large, camera_height=(0.5, 1.5))
        scene = sample_scene("drop", seed, params)
        target, lower = body(scene, "target"), body(scene, "lower")
        assert bounds(target)[0, 2] - bounds(lower)[1, 2] >= 0.1 - 1e-9
        fall = target.position[2]
        assert scene.camera.target == pytest.approx((0, 0, fall / 2))
        assert 0.5 * fall <= scene.camera.position[2] <= 1.5 * fall
        low = sample_scene("drop", seed, dataclasses.replace(params, camera_height=(0.0, 0.0)))
        assert low.camera.position[2] == low.floor + 0.25, "not lower than the rule allows"


def test_drop_orientation_follows_parameters() -> None:
    upright = dataclasses.replace(Drop().dropped, turn_deg=(0.0, 0.0))
    params = dataclasses.replace(Drop(), dropped=upright, even_turn=False)
    seed = trial_seed("test", "drop", "train", 0)
    assert body(sample_scene("drop", seed, params), "target").rotation == (1, 0, 0, 0)
    even = dataclasses.replace(params, even_turn=True)
    assert body(sample_scene("drop", seed, even), "target").rotation != (1, 0, 0, 0)
    rng = np.random.default_rng(0)
    turns = np.array([random_rotation(rng) for _ in range(2000)])
    for axis in np.eye(3):
        ups = rotate_vectors(turns, axis)[:, 2]
        # On a ball every height is as likely; three even angles give a variance of 1/4.
        assert np.var(ups) == pytest.approx(1 / 3, abs=0.03) and abs(np.mean(ups)) < 0.05


def test_collide_positions() -> None:
    lifted = dataclasses.replace(Collide(), lift=0.2, zone_jitter=0.3)
    asides = []
    for index in range(40):
        scene = sample_scene("collide", trial_seed("test", "collide", "train", index), lifted)
        assert body(scene, "probe").position == (-1.0, 0.0, 0.2)
        assert body(scene, "target").position == (1.0, 0.0, 0.0)
        asides.append(body(scene, "zone").position[1])
    assert -0.3 <= min(asides) < -0.15 < 0.15 < max(asides) <= 0.3


def test_push_has_the_speed_that_was_drawn() -> None:
    for index in TRIALS:
        for name, fastest in (("dominoes", 0.75), ("collide", 10.0)):
            scene = draw(scenarios.get(name), index)
            (push,) = scene.pushes
            speed = math.hypot(*push.impulse) / body(scene, push.body).mass
            assert speed <= fastest + 1e-9 and push.impulse[0] > 0
            low, high = world_bounds(body(scene, push.body))
            assert (low <= push.point).all() and (push.point <= high).all()


def test_scenery_rule_defaults_have_props() -> None:
    rule = SceneryRule()
    for prop in expand_props(rule.distractor_props + rule.occluder_props):
        assert shape(f"prop:{prop}").pieces
