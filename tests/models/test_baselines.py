"""Baselines: what holds for all, and each of them; settings, no torch, no leak."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from physion.clips.batch import Batch, Motion
from physion.core.errors import BadInputError, UnknownNameError
from physion.models.baselines.pixels import BlobCentroids, CopyLastFrame, color_masks
from physion.models.baselines.trees import (
    BLOB_FEATURES,
    NEAREST,
    STATE_FEATURES,
    mask_blob,
)
from physion.models.build import build_model
from physion.models.gaps import FAR, TOLERANCE, minimise
from physion.models.interface import Model, can
from physion.physics.cloth.simulate import ClothSettings
from physion.physics.cloth.solver import CLOTH_CONTACT_GAP
from physion.rendering.renderer import Renderer
from physion.scenes.looks import in_look
from physion.scenes.scene import Body, BodyEvent, Camera, Cloth, Roles, Scene, Vec3
from support.crossing_bodies import batch_of, crossing, replace_future, some_crossings
from support.rendered_scenes import resting

OTHERS: dict[str, dict[str, Any]] = {
    "state-trees": {"stride": 9},
    "mask-trees": {"image_size": 48},
    "already-touched": {"margin": 0.02},
    "constant-motion": {"frames": 20},
    "blob-centroids": {"image_size": 48},
    "blob-trees": {"image_size": 48},
    "copy-last-frame": {"image_size": 16},
}
"""Every baseline, with options that are not the default."""


def fitted(name: str, fit: Batch, labels: np.ndarray) -> Any:
    """Return the baseline, fitted if it can be."""
    model = build_model(name)
    return model.fit(fit, labels, 3) if can(model, "fit") else model


def answers(model: Any, batch: Batch) -> np.ndarray:
    """Return what the model says about a batch, by its method."""
    if can(model, "imagine"):
        return np.asarray(model.imagine(batch, 2, 0).gap)
    return np.asarray(model.predict(batch))


def seen_by(name: str) -> tuple[Any, Batch]:
    """Return a fitted baseline and motions that it was not fitted to; some have touched."""
    fit, labels = some_crossings(60, 0)
    test, _ = some_crossings(59, 1)
    touching = crossing(name="crossing_1_0059", touch=(30,), agent=(1.0, 2.0, 0.0))
    return fitted(name, fit, labels), batch_of([*(test.state or ()), touching])


@pytest.mark.parametrize("name", OTHERS)
def test_digest_and_provenance_follow_the_settings(name: str) -> None:
    model, other = build_model(name), build_model(name, **OTHERS[name])
    assert isinstance(model, Model)
    assert model.digest() == build_model(name).digest() != other.digest()
    assert int(model.digest(), 16) >= 0 and len(model.digest()) == 64
    assert model.provenance().model == name and model.provenance().init == "none"
    with pytest.raises(UnknownNameError, match=f"option of model {name}"):
        build_model(name, sampels=1)


def test_baselines_say_what_they_see_and_answer_from_the_observed_part() -> None:
    models = {name: build_model(name) for name in [*OTHERS, "chance"]}
    stated = {name: model.provenance().inputs for name, model in models.items()}
    assert {name: words for name, words in stated.items() if words} == {"chance": "base rate"}
    answering = {name: model.answers for name, model in models.items() if model.answers}
    known = ("already-touched", "chance")
    assert answering == dict.fromkeys(known, "observed")


def test_chance_is_the_rate_of_succession() -> None:
    """(k + 1) / (n + 2) for k contacts among n trials (Laplace)."""
    batch = batch_of([crossing()] * 4)
    fitted = build_model("chance").fit(batch, np.array([True, True, False, True]), 0)
    assert fitted.predict(batch).tolist() == pytest.approx([4 / 6] * 4)
    nothing = build_model("chance").fit(batch.select([]), np.zeros(0, bool), 0)
    assert nothing.predict(batch.select([0])).tolist() == [0.5]


@pytest.mark.parametrize("name", [n for n in OTHERS if not can(build_model(n), "encode")])
def test_an_answer_depends_only_on_its_own_trial(name: str) -> None:
    model, batch = seen_by(name)
    together = answers(model, batch)
    assert len(np.unique(together)) > 1
    order = np.random.default_rng(2).permutation(len(batch))
    assert answers(model, batch.select(order)).tobytes() == together[order].tobytes()
    alone = np.concatenate([answers(model, batch.select([row])) for row in range(len(batch))])
    assert alone.tobytes() == together.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["already-touched", "constant-motion"])
def test_noise_after_the_observed_part_changes_no_answer(name: str) -> None:
    fit, labels = some_crossings(60, 0)
    model, batch = seen_by(name)
    noisy = batch_of([replace_future(motion) for motion in batch.state or ()])
    assert answers(model, noisy).tobytes() == answers(model, batch).tobytes()
    # Nor does noise in the trials of the fit.
    refit = fitted(name, batch_of([replace_future(m, 1) for m in fit.state or ()]), labels)
    assert answers(refit, batch).tobytes() == answers(model, batch).tobytes()


@pytest.mark.parametrize("name", ["already-touched", "constant-motion"])
def test_trials_without_motion_or_observed_part_are_named(name: str) -> None:
    model, batch = seen_by(name)
    movie = crossing(name="movie_0001", agent=(float("nan"), 0.0, 0.0))
    with pytest.raises(BadInputError, match="'movie_0001' was imported without motion"):
        answers(model, batch_of([crossing(name="crossing_1_0000"), movie]))
    with pytest.raises(BadInputError, match=f"{name} needs motions"):
        answers(model, Batch(("a",), batch.frames[:1], batch.valid[:1]))
    with pytest.raises(BadInputError, match="'short' has 44 frames, fewer than"):
        answers(model, batch_of([crossing(name="short", frames=44)]))


# Constant motion on scenes whose gaps are known in closed form.


def gap(motion: Motion, **options: Any) -> float:
    """Return the gap that the model imagines."""
    rollout = build_model("constant-motion", **options).imagine(batch_of([motion]), 1, 0)
    assert rollout.contact.tolist() == [[bool(rollout.gap[0, 0] <= 0)]]
    return float(rollout.gap[0, 0])


def test_gap_after_the_time_that_is_looked_ahead() -> None:
    # Unit cubes, centres 5 m apart, approaching at 2 m/s; by default up to frame 150.
    assert gap(crossing()) == pytest.approx(5 - 1 - 2 * 0.01 * (150 - 44), abs=TOLERANCE)
    assert gap(crossing(), frames=199) == pytest.approx(0.02, abs=TOLERANCE)
    assert gap(crossing(), frames=201) == 0


@pytest.mark.parametrize(
    ("start", "expected"), [((0.0, 1.5, 0.0), 0.5), ((0.0, 0.9, 0.0), 0.0), ((0.0, 1.3, 1.4), 0.5)]
)
def test_gap_when_cubes_pass_each_other(start: Vec3, expected: float) -> None:
    motion = crossing(agent=start, velocity=(8.0, 0.0, 0.0), patient=(5.0, 0.0, 0.0))
    assert gap(motion) == pytest.approx(expected, abs=TOLERANCE)


def test_balls_on_a_collision_course_touch_and_others_miss_by_the_known_gap() -> None:
    def passing(sideways: float) -> float:
        return gap(crossing(shape="sphere", agent=(0.0, sideways, 0.0), velocity=(8.0, 0.0, 0.0)))

    assert passing(0.0) == passing(0.7) == 0
    # The hull of a ball lies inside it, by at most r (1 - cos(pi / 16)) = .0096 m.
    assert 1.4 - 1 - TOLERANCE <= passing(1.4) <= 1.4 - 1 + 2 * 0.0096 + TOLERANCE


def test_bodies_that_part_have_their_gap_now() -> None:
    motion = crossing(velocity=(-2.0, 0.0, 0.0), patient=(1.75, 0.0, 0.0))
    assert gap(motion) == pytest.approx(0.75, abs=TOLERANCE)


@pytest.mark.parametrize("height", [0.0, 0.8])
def test_spinning_bodies_sweep_with_their_corners(height: float) -> None:
    # Bars of 2 x .2 x .2 m: the corners of the spinning one pass the long side of the other.
    motion = crossing(
        scale=(2.0, 0.2, 0.2), velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 3.0),
        patient=(0.0, 1.6, height),
    )  # fmt: skip
    sideways, above = 1.6 - 0.1 - math.hypot(1, 0.1), max(height - 0.2, 0.0)
    assert gap(motion) == pytest.approx(math.hypot(sideways, above), abs=TOLERANCE)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_bodies_spin_in_the_sense_of_their_spin(sense: float) -> None:
    """In 0.5 s a bar of 2 x .2 m turns by 0.5: its corner comes near a cube, or parts from it."""
    bodies = (
        Body("agent", "cube", (0.0, 0.0, 0.0), (2.0, 0.2, 0.2)),
        Body("patient", "cube", (0.9, 1.0, 0.0), (0.2, 0.2, 0.2)),
    )
    motion = crossing(bodies=bodies, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, sense))
    corner = math.sin(0.5) + 0.1 * math.cos(0.5) if sense > 0 else 0.1
    assert gap(motion, frames=50) == pytest.approx(0.9 - corner, abs=TOLERANCE)


def test_bodies_spin_about_their_centre_of_mass() -> None:
    # A cube of 1 m spins about x, and stays where it is; its pivot is at its bottom.
    motion = crossing(
        velocity=(0.0, 0.0, 0.0), spin=(5.0, 0.0, 0.0), patient=(0.0, 0.0, 3.0), scale=(1, 1, 1)
    )
    assert gap(motion) == pytest.approx(3 - 0.5 - math.sqrt(0.5), abs=TOLERANCE)


def test_nothing_but_the_velocity_counts() -> None:
    """A body in the air does not fall, and a wall in between stops nothing."""
    bodies = (
        Body("agent", "cube", (0, 0, 4)),
        Body("patient", "cube", (3, 0, 0)),
        Body("wall", "cube", (1.5, 0, 0), (0.1, 9.0, 9.0), kinematic=True),
    )
    still = crossing(agent=(0.0, 0.0, 4.0), velocity=(0.0, 0.0, 0.0), bodies=bodies)
    assert gap(still) == pytest.approx(math.hypot(2, 3), abs=TOLERANCE)
    moving = crossing(agent=(0.0, 0.0, 0.0), velocity=(4.0, 0.0, 0.0), bodies=bodies)
    assert gap(moving) == 0


def test_a_contact_that_was_seen_is_a_touch() -> None:
    assert gap(crossing(touch=(10,))) == 0
    assert gap(crossing(touch=(45,))) > 0


def test_gaps_are_finite_where_there_is_nothing_to_touch() -> None:
    assert gap(crossing(patient=(50.0, 0.0, 0.0))) == FAR
    events = (BodyEvent(50, "patient", "appear"),)
    assert gap(crossing(patient=(1.2, 0.0, 0.0), events=events)) == FAR
    sheets = (Cloth("one", (0, 0, 1), resolution=2), Cloth("two", (0, 0, 1), resolution=2))
    assert gap(crossing(cloths=sheets, roles=Roles("one", "two"))) == FAR


def falling_sheet(speed: float, roles: Roles) -> Motion:
    """Return a level sheet 2 m above the top of a cube, falling with ``speed`` in m/s."""
    sheet = Cloth("sheet", (5, 0, 3), resolution=21)
    motion = crossing(cloths=(sheet,), roles=roles, velocity=(0.0, 0.0, 0.0))
    steps = np.linspace(-1, 1, 21)
    x, y = np.meshgrid(steps + 5, steps, indexing="ij")
    vertices = np.zeros((60, 441, 3), np.float32)
    vertices[..., 0], vertices[..., 1] = x.ravel(), y.ravel()
    vertices[..., 2] = 3 - speed * 0.01 * (np.arange(60)[:, None] - 44)
    return Motion(motion.scene, replace(motion.trajectory, cloth_vertices=vertices))


@pytest.mark.parametrize("roles", [Roles("sheet", "patient"), Roles("patient", "sheet")])
def test_cloth_touches_by_the_rule_of_the_label(roles: Roles) -> None:
    settings = ClothSettings()
    thickness = settings.rest_distance + CLOTH_CONTACT_GAP
    # The particles of a cube end within a spacing of its top.
    inside = settings.particle_spacing
    still = gap(falling_sheet(0.0, roles))
    assert 2 - thickness <= still <= 2 - thickness + inside
    # From one sheet to the next all else is equal: a second at 1 m/s is 1 m less.
    assert still - gap(falling_sheet(1.0, roles), frames=100) == pytest.approx(1, abs=2e-3)
    assert gap(falling_sheet(2.0, roles), frames=100) == 0


def test_samples_are_equal_and_the_seed_is_not_used() -> None:
    batch = batch_of([crossing(), crossing(agent=(1.0, 0.0, 0.0))])
    rollout = build_model("constant-motion").imagine(batch, 3, 0)
    assert rollout.gap.shape == rollout.contact.shape == (2, 3)
    assert (rollout.gap == rollout.gap[:, :1]).all() and rollout.gap[0, 0] != rollout.gap[1, 0]
    assert rollout.gap.dtype == np.float64 and rollout.contact.dtype == np.bool_
    assert (build_model("constant-motion").imagine(batch, 3, 1).gap == rollout.gap).all()


def test_minimum_of_a_function_is_found_between_frames() -> None:
    assert minimise(lambda t: abs(t - 0.0237) + 0.1, 1, 10) == pytest.approx(0.1, abs=TOLERANCE)
    # As steep as the bound allows, between two frames.
    assert minimise(lambda t: abs(100 * t - 5.5), 100, 10) == pytest.approx(0, abs=TOLERANCE)
    parabola = minimise(lambda t: 3 * (t - 0.055) ** 2 + 0.2, 1, 10)
    assert parabola == pytest.approx(0.2, abs=TOLERANCE)


def test_search_ends_at_a_touch() -> None:
    times: list[float] = []

    def value(seconds: float) -> float:
        times.append(seconds)
        return 0.05 - seconds

    assert minimise(value, 1000, 10) <= 0
    assert len(times) == 6


# Features of the true state, for trees.


def state_rows(motion: Motion, *frames: int) -> np.ndarray:
    """Return the features (T, D) of some frames, by default of frame 44 only."""
    shown = np.array([frames or (44,)])
    batch = Batch((motion.scene.name,), shown, np.ones_like(shown, bool), state=(motion,))
    return np.asarray(build_model("state-trees").encode(batch)[0])


def named(motion: Motion, frame: int = 44) -> dict[str, float]:
    """Return the features of a frame by name."""
    return dict(zip(STATE_FEATURES, state_rows(motion, frame)[0].tolist(), strict=True))


def of(slot: str, values: dict[str, float]) -> dict[str, float]:
    """Return the features of one object by name."""
    start = f"{slot} "
    return {n.removeprefix(start): v for n, v in values.items() if n.startswith(start)}


def test_features_are_seen_from_the_floor_below_the_patient_towards_the_agent() -> None:
    motion = crossing(
        agent=(5.0, 6.0, 3.0), velocity=(4.0, 0.0, -1.0), spin=(0.1, 0.2, 0.3),
        patient=(5.0, 2.0, 0.0), scale=(0.5, 1.0, 2.0),
    )  # fmt: skip
    values = named(motion)
    # Centres lie half a height above the pivots; the agent is four metres along y.
    expected = {
        "present": 1, "cloth": 0, "x": 4, "y": 0, "z": 4, "axis x": 0, "axis y": -1, "axis z": 0,
        "up x": 0, "up y": 0, "up z": 1, "vx": 0, "vy": -4, "vz": -1, "wx": 0.2, "wy": -0.1,
        "wz": 0.3, "length": 0.5, "width": 1, "height": 2,
    }  # fmt: skip
    assert of("agent", values) == pytest.approx(expected, abs=1e-6)
    assert [of("patient", values)[axis] for axis in "xyz"] == pytest.approx([0, 0, 1])
    assert not any(of("probe", values).values()), "this scene has no probe"
    between = {"ahead": 4, "up": 3, "distance": 5, "approach": (4 * 0 + 3 * -1) / 5}
    assert {name: values[name] for name in between} == pytest.approx(between)
    # A tenth of a second earlier the agent was elsewhere, in the same frame of reference.
    earlier = of("agent", named(motion, 34))
    assert [earlier[axis] for axis in "xyz"] == pytest.approx([4, 0.4, 4.1], abs=1e-5)


@pytest.mark.parametrize("angle", [0.7, -2.0, math.pi])
def test_a_scene_that_is_turned_and_moved_has_the_same_features(angle: float) -> None:
    bodies = (
        Body("agent", "cube", (0, 0, 0)), Body("patient", "cube", (2, 0, 0)),
        Body("ball", "sphere", (0, -3, 0)), Body("far", "cube", (1, 4, 0)),
    )  # fmt: skip
    motion = crossing(
        agent=(0.0, 0.3, 0.5), velocity=(2.0, 1.0, 0.5), bodies=bodies,
        roles=Roles("agent", "patient", "ball"),
    )  # fmt: skip
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    path = motion.trajectory
    # About z, as a quaternion in front of those of the bodies, which are at rest.
    about_z = np.array([math.cos(angle / 2), 0, 0, math.sin(angle / 2)], np.float32)
    turned = replace(
        path,
        positions=(path.positions @ turn.T + (3, -1, 0)).astype(np.float32),
        velocities=(path.velocities @ turn.T).astype(np.float32),
        rotations=np.broadcast_to(about_z, path.rotations.shape).copy(),
    )
    other = state_rows(Motion(motion.scene, turned), 0, 22, 44)
    assert other == pytest.approx(state_rows(motion, 0, 22, 44), abs=1e-5)


def test_other_objects_are_the_nearest_to_the_line_in_the_order_of_their_distance() -> None:
    bodies = [Body("agent", "cube", (0, 0, 0)), Body("patient", "cube", (10, 0, 0))]
    # On the line, from the agent to the patient, and one behind the patient that is farther.
    bodies += [Body(f"on {x}", "cube", (x, 0.1, 0), (x, 1, 1)) for x in (8, 5, 2, 4, 6, 3)]
    bodies += [Body("behind", "cube", (10.5, 3, 0), (99, 1, 1))]
    values = named(crossing(bodies=tuple(bodies), agent=(0.0, 0.0, 0.0)))
    lengths = [of(f"object {number}", values)["length"] for number in range(1, NEAREST + 1)]
    assert lengths == [8, 6, 5, 4, 3, 2]


def test_a_rotation_and_its_negative_have_equal_features_and_move_the_centre() -> None:
    motion = crossing(agent=(0.0, 0.0, 0.0), patient=(-5.0, 0.0, 0.0), scale=(1.0, 1.0, 2.0))
    rotations = np.array(motion.trajectory.rotations)
    rotations[:, 0] = (np.sqrt(0.5), np.sqrt(0.5), 0, 0)  # about x: up becomes -y
    turned = Motion(motion.scene, replace(motion.trajectory, rotations=rotations))
    other = Motion(motion.scene, replace(motion.trajectory, rotations=-rotations))
    assert state_rows(turned).tolist() == state_rows(other).tolist()
    values = of("agent", named(turned))
    # The centre is one metre to the side of the pivot, and the first axis points to it.
    assert [values[n] for n in "xyz"] == pytest.approx([math.hypot(5, 1), 0, 0], abs=1e-6)
    assert [values[f"up {axis}"] for axis in "xyz"] == pytest.approx(
        [1 / math.hypot(5, 1), -5 / math.hypot(5, 1), 0], abs=1e-6
    )


def test_absent_objects_give_zeros() -> None:
    values = named(crossing(events=(BodyEvent(50, "patient", "appear"),)))
    assert not any(of("patient", values).values())
    assert values["distance"] == 0 and of("agent", values)["present"] == 1
    vanished = named(crossing(events=(BodyEvent(44, "agent", "vanish"),)))
    assert of("agent", vanished)["present"] == 0 and of("patient", vanished)["present"] == 1
    later = named(crossing(events=(BodyEvent(45, "agent", "vanish"),)))
    assert of("agent", later)["present"] == 1


def test_a_cloth_is_the_mean_of_its_vertices() -> None:
    sheets = (Cloth("first", (0, 0, 2), resolution=3), Cloth("sheet", (0, 0, 2), resolution=2))
    motion = crossing(cloths=sheets, patient=(0.0, 0.0, 0.0), roles=Roles("sheet", "patient"))
    vertices = np.zeros((60, 13, 3), np.float32)
    vertices[:, 9:, 0] = (0, 1, 2, 5)
    vertices[:, 9:, 2] = 2 - 0.03 * np.arange(60)[:, None]
    vertices[:, :9] = 77
    values = named(Motion(motion.scene, replace(motion.trajectory, cloth_vertices=vertices)))
    expected = {"present": 1, "cloth": 1, "x": 2, "y": 0, "z": 2 - 0.03 * 44, "vz": -3, "length": 2}
    found = of("agent", values)
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=1e-4)


def test_noise_after_the_observed_part_changes_no_feature() -> None:
    motion = crossing(agent=(0.0, 1.0, 0.0))
    assert (
        state_rows(replace_future(motion), 0, 44).tobytes() == state_rows(motion, 0, 44).tobytes()
    )
    movie = crossing(name="movie_0001", agent=(float("nan"), 0.0, 0.0))
    with pytest.raises(BadInputError, match="'movie_0001' was imported without motion"):
        state_rows(movie)


# Baselines that see pictures: coloured blobs, and a copy of the last frame.

RED, YELLOW = (255, 0, 0), (255, 255, 0)
SIZE = 64


def clips(rgb: np.ndarray) -> Batch:
    """Return pictures (B, T, H, W, 3) as a batch."""
    frames = np.tile(np.arange(rgb.shape[1]) * 6, (len(rgb), 1))
    names = tuple(f"trial_{row}" for row in range(len(rgb)))
    return Batch(names, frames, np.ones(frames.shape, np.bool_), rgb=rgb)


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    """Return random pictures of a shape (B, T, size, size, 3)."""
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def draw_disc(picture: np.ndarray, x: int, y: int, radius: float, color: tuple[int, ...]) -> int:
    """Draw a disc centred on a pixel; return how many pixels it has."""
    rows, columns = np.mgrid[: len(picture), : len(picture)]
    inside = (rows - y) ** 2 + (columns - x) ** 2 <= radius**2
    picture[inside] = color
    return int(inside.sum())


def test_centroids_and_areas_of_discs_are_exact() -> None:
    picture = np.full((SIZE, SIZE, 3), 120, np.uint8)
    red = draw_disc(picture, 12, 40, 6, RED)
    yellow = draw_disc(picture, 45, 20, 9.5, YELLOW)
    features = build_model("blob-centroids").encode(clips(picture[None, None]))
    expected = [12.5 / 64, 40.5 / 64, red / 64**2, 45.5 / 64, 20.5 / 64, yellow / 64**2]
    assert features.dtype == np.float32 and features.shape == (1, 1, 6)
    assert features[0, 0] == pytest.approx(expected, abs=1e-7)


def test_blobs_that_are_not_seen_are_in_the_middle_without_area() -> None:
    gray = np.full((1, 1, SIZE, SIZE, 3), 90, np.uint8)
    assert build_model("blob-centroids").encode(clips(gray)).tolist() == [
        [[0.5, 0.5, 0, 0.5, 0.5, 0]]
    ]


def test_blobs_over_time_are_exact() -> None:
    """Squares of known pixels, of which the red one moves by 8 pixels between two frames."""
    frames = np.full((2, 128, 128, 3), 120, np.uint8)
    for frame, left in enumerate((16, 24)):
        frames[frame, 32:48, left : left + 8] = RED
        frames[frame, 64:96, 64:96] = YELLOW
    values = build_model("blob-trees").encode(clips(frames[None]))[0]
    named = [dict(zip(BLOB_FEATURES, row.tolist(), strict=True)) for row in values]

    def deviation(pixels: int) -> float:
        """Return the standard deviation of so many neighbouring pixels, parts of the picture."""
        return math.sqrt((pixels**2 - 1) / 12) / 128

    expected = {
        "red area": 128 / 128**2, "red x": 20 / 128, "red y": 40 / 128,
        "red width": deviation(8), "red height": deviation(16), "red slant": 0,
        "red left": 16 / 128, "red top": 32 / 128, "red right": 24 / 128, "red bottom": 48 / 128,
        "yellow area": 32**2 / 128**2, "yellow right": 96 / 128,
        "red to yellow x": 60 / 128, "red to yellow y": 40 / 128,
        "red to yellow distance": math.hypot(60, 40) / 128,
        "red to yellow gap": math.hypot(64 - 24, 64 - 48) / 128,
    }  # fmt: skip
    assert {name: named[0][name] for name in expected} == pytest.approx(expected, abs=1e-6)
    changes = {name: named[1][f"change of {name}"] for name in expected}
    moved = {"red x": 8, "red left": 8, "red right": 8, "red to yellow x": -8}
    moved["red to yellow distance"] = math.hypot(52, 40) - math.hypot(60, 40)
    moved["red to yellow gap"] = math.hypot(32, 16) - math.hypot(40, 16)
    assert changes == pytest.approx({n: moved.get(n, 0) / 128 for n in expected}, abs=1e-6)
    assert not values[0, len(BLOB_FEATURES) // 2 :].any()


def test_a_mask_is_described_by_the_moments_and_the_box_of_its_pixels() -> None:
    rng = np.random.default_rng(0)
    masks = np.zeros((3, 20, 30), bool)
    masks[0, 3:9, 11:16] = rng.random((6, 5)) < 0.7
    masks[1, 12:18, 20:29] = rng.random((6, 9)) < 0.7
    expected = []
    for mask in masks:
        rows, columns = np.nonzero(mask)
        if not len(rows):
            expected.append([0, 0.5, 0.5, 0, 0, 0, 0.5, 0.5, 0.5, 0.5])
            continue
        x, y = (columns + 0.5) / 30, (rows + 0.5) / 20
        box = [columns.min() / 30, rows.min() / 20, (columns.max() + 1) / 30, (rows.max() + 1) / 20]
        slant = np.mean((x - x.mean()) * (y - y.mean()))
        expected.append([len(x) / 600, x.mean(), y.mean(), x.std(), y.std(), slant, *box])
    assert np.allclose(mask_blob(masks), expected, atol=1e-6)
    # The variance of n equally spaced values over 1 is (1 - 1 / n^2) / 12.
    full = [1, 0.5, 0.5, *np.sqrt((1 - np.array([30.0, 20]) ** -2) / 12), 0, 0, 0, 1, 1]
    assert np.allclose(mask_blob(np.ones((2, 20, 30), bool)), full, atol=1e-6)
    assert np.allclose(mask_blob(masks[2:]), expected[2:])


def test_masks_are_of_agent_patient_and_the_largest_others() -> None:
    """Object 5 is larger than 3 in the observed frames only; 4 is never seen."""
    model = build_model("mask-trees")
    ids = np.zeros((1, model.spec.context + 1, 64, 64), np.uint8)
    ids[0, :, 8:16, 8:24] = 1
    ids[0, :, 40:48, 40:48] = 2
    ids[0, :, 0:2, 0:10] = 3
    ids[0, :-1, 60:64, 0:8] = 5
    ids[0, -1, 30:64, 0:8] = 3
    shown = np.arange(ids.shape[1])[None]
    batch = Batch(("a",), shown, np.ones_like(shown, bool), ids=ids)
    first = model.encode(batch)[0, 0]
    areas = [8 * 16, 8 * 8, 4 * 8, 2 * 10, 0]
    assert first[:50:10] * 64**2 == pytest.approx(areas)
    # Agent and patient have the features of blobs of the same pixels.
    colors = np.full((*ids.shape, 3), 120, np.uint8)
    colors[ids == 1], colors[ids == 2] = RED, YELLOW
    blobs = build_model("blob-trees", image_size=64).encode(clips(colors))[0, 0]
    assert first[:20].tolist() == blobs[:20].tolist()
    with pytest.raises(BadInputError, match=r"needs the objects of pixels \(input ids\)"):
        model.encode(clips(colors))


def test_a_slanted_blob_and_one_that_is_not_seen() -> None:
    frames = np.full((1, 128, 128, 3), 120, np.uint8)
    for step in range(10):
        frames[0, 20 + step, 40 + step] = RED
    values = dict(
        zip(BLOB_FEATURES, build_model("blob-trees").encode(clips(frames[None]))[0, 0], strict=True)
    )
    # Equal rows and columns: the covariance is the variance of either.
    assert values["red slant"] == pytest.approx(99 / 12 / 128**2, abs=1e-6)
    unseen = {"area": 0, "x": 0.5, "width": 0, "slant": 0, "left": 0.5, "bottom": 0.5}
    assert {name: values[f"yellow {name}"] for name in unseen} == unseen


@pytest.mark.parametrize(
    ("color", "red", "yellow"),
    [
        ((158, 27, 29), True, False),
        ((220, 30, 100), True, False),
        ((215, 208, 15), False, True),
        ((140, 160, 20), False, True),
        ((255, 128, 0), False, False),  # orange
        ((60, 200, 40), False, False),
        ((40, 60, 220), False, False),
        ((230, 230, 230), False, False),
        ((0, 0, 0), False, False),
        ((160, 100, 90), False, False),  # pale
        ((60, 5, 5), False, False),  # dark
        ((200, 0, 220), False, False),  # magenta
    ],
)
def test_colours_that_count(color: tuple[int, int, int], red: bool, yellow: bool) -> None:
    masks = color_masks(np.array([color], np.uint8))
    assert [bool(mask[0]) for mask in masks] == [red, yellow]


def test_blobs_of_a_rendered_scene_are_agent_and_patient() -> None:
    bodies = (
        Body("agent", "sphere", (-0.6, 0.3, 0.0), (0.6, 0.6, 0.6)),
        Body("patient", "cube", (0.6, -0.4, 0.0), (0.6, 0.6, 0.6)),
        Body("other", "cone", (0.0, 0.9, 0.0), (0.4, 0.4, 0.4)),
    )
    camera = Camera((3.0, 0.5, 1.2), (0.0, 0.0, 0.3))
    scene = Scene("pair", "collide", bodies, Roles("agent", "patient"), camera)
    frame = Renderer(in_look(scene, "redyellow"), resting(scene), SIZE, SIZE).render(
        0, ("color", "ids")
    )
    assert frame.color is not None and frame.ids is not None
    features = build_model("blob-centroids").encode(clips(frame.color[None, None]))[0, 0]
    for place, number in ((0, 1), (3, 2)):
        rows, columns = np.nonzero(frame.ids == number)
        middle = [(columns.mean() + 0.5) / SIZE, (rows.mean() + 0.5) / SIZE]
        assert features[place : place + 2] == pytest.approx(middle, abs=1 / SIZE)
        assert features[place + 2] == pytest.approx(len(rows) / SIZE**2, rel=0.15)


@pytest.mark.parametrize(
    "model", [build_model("blob-centroids"), build_model("copy-last-frame")], ids=["blobs", "copy"]
)
def test_features_of_a_frame_depend_only_on_it(model: object) -> None:
    assert isinstance(model, BlobCentroids | CopyLastFrame)
    size = model.spec.image_size
    rgb = noise(4, 9, size, size, 3)
    features = model.encode(clips(rgb))
    assert np.ptp(features) > 0 and model.spec.framewise
    # Parts of clips, other clips beside them, and noise in later frames change nothing.
    assert model.encode(clips(rgb[1:2, 3:5])).tobytes() == features[1:2, 3:5].tobytes()
    later = rgb.copy()
    later[:, 7:] = noise(4, 2, size, size, 3, seed=1)
    assert model.encode(clips(later))[:, :7].tobytes() == features[:, :7].tobytes()
    assert model.encode(clips(later)).tobytes() != features.tobytes()


def test_pixels_are_the_features_of_a_copy() -> None:
    rgb = noise(2, 7, 32, 32, 3)
    features = build_model("copy-last-frame").encode(clips(rgb))
    assert features.shape == (2, 7, 32 * 32 * 3) and features.dtype == np.float32
    assert features[1, 2] == pytest.approx(rgb[1, 2].ravel() / 255)


@pytest.mark.parametrize("stored", [False, True])
def test_the_last_context_frame_is_imagined(stored: bool) -> None:
    model, rgb = build_model("copy-last-frame"), noise(2, 7, 32, 32, 3)
    features = model.encode(clips(rgb))
    context = replace(clips(rgb), future=18)
    if stored:
        context = replace(context, rgb=None, features=features)
    rollout = model.imagine(context, 2, 0)
    assert rollout.features.shape == (2, 2, 18, 32 * 32 * 3)
    assert (rollout.features == features[:, None, -1:]).all()
    assert ("rgb" in rollout.shown) == (not stored)
    if not stored:
        assert rollout.shown["rgb"].shape == (2, 2, 18, 32, 32, 3)
        assert (rollout.shown["rgb"] == rgb[:, None, -1:]).all()


@pytest.mark.parametrize(
    "model", [build_model("blob-centroids"), build_model("copy-last-frame")], ids=["blobs", "copy"]
)
def test_other_pictures_are_refused(model: object) -> None:
    assert isinstance(model, BlobCentroids | CopyLastFrame)
    with pytest.raises(BadInputError, match=r"pictures \(input rgb\) of .*\(48, 48, 3\)"):
        model.encode(clips(noise(1, 1, 48, 48, 3)))
    batch = clips(noise(1, 1, 48, 48, 3))
    with pytest.raises(BadInputError, match="not none"):
        model.encode(Batch(batch.trials, batch.frames, batch.valid))


# Whether the contact was seen, and base rates.


def test_base_rate_matches_trials_that_had_not_touched() -> None:
    seen, later = crossing(touch=(44,)), crossing(touch=(45,))
    fit = batch_of([seen, seen, later, later, later, later])
    labels = np.array([True, True, True, False, False, False])
    model = build_model("already-touched", margin=0.05).fit(fit, labels, 0)
    assert model.predict(batch_of([later, seen])).tolist() == [0.25, 0.95]


@pytest.mark.parametrize(("labels", "rate"), [([], 0.5), ([False], 0.01), ([True], 0.99)])
def test_base_rate_stays_within_the_margin(labels: list[bool], rate: float) -> None:
    model = build_model("already-touched").fit(
        batch_of([crossing()] * len(labels)), np.array(labels, bool), 0
    )
    assert model.predict(batch_of([crossing()])).tolist() == [rate]


def test_labels_must_fit_the_trials() -> None:
    with pytest.raises(BadInputError, match="2 labels for 1 trials"):
        build_model("already-touched").fit(batch_of([crossing()]), np.array([True, False]), 0)
