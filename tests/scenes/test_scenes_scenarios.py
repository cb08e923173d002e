"""What holds for the scenes of every scenario."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy.optimize import linprog

from physion.errors import BadSceneError, UnknownNameError
from physion.scenes.looks import RED, TEXTURES, YELLOW, mistakable, with_role_colors
from physion.scenes.placement import (
    CameraRule,
    SceneryRule,
    on_screen,
    place_camera,
    rotate,
    world_bounds,
)
from physion.scenes.scenarios import Scenario, sample_scene, scenarios
from physion.scenes.scene import Body, Scene
from physion.scenes.shapes import shape
from physion.seeds import child_generator, trial_seed

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


def body(scene: Scene, name: str) -> Body:
    return scene.bodies[scene.index(name)]


def hulls(thing: Body) -> list[np.ndarray]:
    """World corners of a body's pieces, a hair smaller so that touching is not overlapping."""
    corners = [
        rotate(thing.rotation, p.mesh.vertices * thing.scale) for p in shape(thing.shape).pieces
    ]
    return [c.mean(axis=0) + 0.998 * (c - c.mean(axis=0)) + thing.position for c in corners]


def overlap(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two convex hulls share a point: boxes first, then a linear program."""
    if (a.max(axis=0) < b.min(axis=0)).any() or (b.max(axis=0) < a.min(axis=0)).any():
        return False
    # A point of both hulls: weights of a's corners and of b's corners that give the same point.
    equal = np.zeros((5, len(a) + len(b)))
    equal[:3, : len(a)], equal[:3, len(a) :] = a.T, -b.T
    equal[3, : len(a)] = equal[4, len(a) :] = 1
    found = linprog(np.zeros(equal.shape[1]), A_eq=equal, b_eq=[0, 0, 0, 1, 1], method="highs")
    return bool(found.status == 0)


def test_overlap_tells_apart() -> None:
    cube = shape("cube").mesh.vertices
    assert overlap(cube, cube + np.array([0.9, 0.9, 0.9]))
    assert not overlap(cube, cube + np.array([1.01, 0, 0]))
    # Boxes meet, hulls do not: a cone beside the tip of another.
    cone = shape("cone").mesh.vertices
    assert not overlap(cone, cone + np.array([0.9, 0, 0.5]))


def test_scene_is_valid_and_says_who_is_who(scenario: Scenario) -> None:
    for index in TRIALS:
        scene = draw(scenario, index)
        assert scene.scenario == scenario.name
        agent, patient = body(scene, scene.roles.agent), body(scene, scene.roles.patient)
        assert patient.kinematic and not agent.kinematic
        assert not agent.scenery and not patient.scenery
        assert scene.ending.min_frames == 151
        for thing in scene.bodies:
            assert shape(thing.shape).mesh.faces.size
            assert thing.look.texture in TEXTURES
            assert math.isclose(math.hypot(*thing.rotation), 1.0)
            assert world_bounds(thing)[0, 2] > -1e-9, "nothing starts under the floor"


def test_same_seed_same_scene_other_seed_other_scene(scenario: Scenario) -> None:
    assert draw(scenario, 3).to_json() == draw(scenario, 3).to_json()
    digests = {draw(scenario, index).physics_digest() for index in TRIALS}
    assert len(digests) == len(TRIALS)
    assert len({draw(scenario, index).name for index in TRIALS}) == len(TRIALS)


def test_json_round_trip(scenario: Scenario) -> None:
    scene = draw(scenario, 0)
    assert Scene.from_json(scene.to_json()) == scene


def test_agent_and_patient_are_in_the_picture(scenario: Scenario) -> None:
    for index in TRIALS:
        scene = draw(scenario, index)
        for name in (scene.roles.agent, scene.roles.patient):
            center = world_bounds(body(scene, name)).mean(axis=0)
            assert max(map(abs, on_screen(scene.camera, center))) < 1


def test_nothing_overlaps_at_the_start(scenario: Scenario) -> None:
    for index in TRIALS:
        solids = [thing for thing in draw(scenario, index).bodies if not thing.scenery]
        for one, other in itertools.combinations(solids, 2):
            for a, b in itertools.product(hulls(one), hulls(other)):
                assert not overlap(a, b), (index, one.name, other.name)


def test_scenery_stands_clear_of_the_scene(scenario: Scenario) -> None:
    for index in TRIALS:
        scene = draw(scenario, index, distractors=2, occluders=2)
        solids = [world_bounds(thing) for thing in scene.bodies if not thing.scenery]
        scenery = [world_bounds(thing) for thing in scene.bodies if thing.scenery]
        assert len(scenery) == 4
        for a, b in itertools.product(solids, scenery):
            assert (a[1, :2] < b[0, :2]).any() or (b[1, :2] < a[0, :2]).any()


def test_scenery_changes_neither_motion_nor_camera_nor_looks(scenario: Scenario) -> None:
    for index in TRIALS:
        bare, full = draw(scenario, index, 0, 0), draw(scenario, index, 3, 2)
        assert len(full.bodies) == len(bare.bodies) + 5
        assert full.bodies[: len(bare.bodies)] == bare.bodies
        assert full.camera == bare.camera and full.pushes == bare.pushes
        assert full.physics_digest() == bare.physics_digest()
        more = draw(scenario, index, 2, 1)
        by_name = {thing.name: thing for thing in full.bodies}
        assert by_name["distractor_0"].shape == body(more, "distractor_0").shape


def test_scenery_stands_behind_and_before(scenario: Scenario) -> None:
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
    assert body(painted, scene.roles.agent).look.color == RED
    assert body(painted, scene.roles.patient).look.color == YELLOW
    assert painted.physics_digest() == scene.physics_digest()
    for before, after in zip(scene.bodies, painted.bodies, strict=True):
        assert after.look.texture == before.look.texture
        if before.name in (scene.roles.agent, scene.roles.patient):
            continue
        near = any(mistakable(before.look.color, c) for c in (RED, YELLOW))
        assert near == (before.look.color != after.look.color)
        assert not any(mistakable(after.look.color, c) for c in (RED, YELLOW))


def test_what_passes_for_red_or_yellow() -> None:
    assert mistakable((0.9, 0.2, 0.1), RED) and mistakable((0.45, 0.05, 0.05), RED)
    assert mistakable((0.8, 0.8, 0.1), YELLOW) and mistakable((0.5, 0.48, 0.05), YELLOW)
    for fine in [(0.45, 0.3, 0.18), (0.1, 0.1, 0.9), (0.1, 0.0, 0.0), (0.85, 0.84, 0.8)]:
        assert not mistakable(fine, RED) and not mistakable(fine, YELLOW)


def test_unknown_scenario_gives_the_closest() -> None:
    with pytest.raises(UnknownNameError, match="dominoes"):
        sample_scene("domino", trial_seed("test", "domino", "train", 0))


def test_default_parameters_are_used_and_recorded() -> None:
    scene = sample_scene("drop", trial_seed("test", "drop", "train", 0))
    assert scene.parameters["height"] == [1.25, 1.5]


def test_camera_that_cannot_see_says_so() -> None:
    far = Body("far", "cube", (0.0, 40.0, 0.0))
    rule = CameraRule((1.0, 1.0), (45.0, 45.0), (1.0, 1.0))
    with pytest.raises(BadSceneError, match="far"):
        place_camera(np.random.default_rng(0), rule, 0.5, (far,))


def test_camera_follows_the_official_rule() -> None:
    for i in range(20):
        rng = child_generator(trial_seed("test", "camera", "x", i), "camera")
        camera = place_camera(rng, CameraRule((2.0, 2.0), (0.0, 90.0), (1.5, 2.5)), 0.7, ())
        x, y, z = camera.position
        assert math.hypot(x, y) == pytest.approx(2 * math.sqrt(2))
        assert 45 <= math.degrees(math.atan2(y, x)) <= 135
        assert 1.5 <= z <= 2.5 and camera.target == (0, 0, 0.7)


def test_dominoes_rows() -> None:
    kind = scenarios.get("dominoes")
    seed = trial_seed("test", "dominoes", "train", 0)
    for count in (0, 1, 4, 8):
        still = kind.params(
            length=2.0,
            middle=count,
            spacing_jitter=0.0,
            lateral_jitter=0.0,
            middle_yaw_deg=(0.0, 0.0),
        )
        scene = kind.sample(still, seed)
        row = [b.position[0] for b in scene.bodies if b.name.startswith("middle")]
        assert row == pytest.approx(np.linspace(-1, 1, count + 2)[1:-1])
    gap = kind.sample(dataclasses.replace(still, remove_middle=True), seed)
    assert sum(b.name.startswith("middle") for b in gap.bodies) == 7


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
    for prop in SceneryRule().distractor_props + SceneryRule().occluder_props:
        assert shape(f"prop:{prop}").pieces
