"""Seeing by simulation: rays, fits, tracks, scenes, and what the model answers."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from physion import evaluate, sample_scene
from physion.clips.batch import SCENERY_ID, Batch, Motion, Provenance, Rollout, Spec
from physion.clips.clips import observed_source
from physion.clips.rendered import MotionRenderer, object_ids
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError
from physion.core.names import SCENARIOS
from physion.data.official import official
from physion.models.build import build_model
from physion.models.interface import Model
from physion.models.noisy_simulation import NoiseLevels, add_noise
from physion.models.seeing.bodies import find, follow
from physion.models.seeing.cloth import sheet_of
from physion.models.seeing.expected import assumed_depth
from physion.models.seeing.hypotheses import Video, _flight, _refitted, see_uncertain
from physion.models.seeing.masks import MaskFit, traced
from physion.models.seeing.pixels import Rays, SeenFrame, floor_height, picture_of
from physion.models.seeing.resting import resting_scene, stacked, uncertain_frame
from physion.models.seeing.scenes import SeenTrial, Track, joints_of, see_trial, velocities
from physion.models.seeing.simulation import SeeingSimulation
from physion.models.seeing.solids import BALL, Placed, Prior, cost_of, residuals, solid
from physion.numerics.rotations import rotation_matrices
from physion.physics.engine import make_engine, simulate
from physion.readout.decisions import Decided
from physion.readout.features import Imagined, imagine_clips, write_features
from physion.readout.imagined import imagine_with
from physion.readout.tables import ScenarioPredictions, make_table
from physion.scenes.scene import Body, Camera, Joint, Look, Push, Roles, Scene
from physion.trials.dataset import Dataset
from physion.trials.official.export_folder import export_official
from physion.trials.official.import_folder import import_official
from support.official_hand_made import RIGID, make_dataset

TURNED = (math.cos(0.3), 0.0, 0.0, math.sin(0.3))
"""Rotation by 0.6 about the vertical."""


def scene(offset: float = 0.0, name: str = "roll") -> Scene:
    """Return a ball that is pushed towards a box, which it misses with a large ``offset``."""
    bodies = (
        Body("ball", "sphere", (-1.0, offset, 0.0), (0.3, 0.3, 0.3)),
        Body("box", "cube", (0.3, 0.0, 0.0), (0.4, 0.6, 0.5), TURNED, mass=8.0),
        Body("cylinder", "cylinder", (-0.4, -0.9, 0.0), (0.3, 0.3, 0.2), mass=2.0),
    )
    push = Push("ball", (2.0, 0.0, 0.0), frame=1)
    camera = Camera((0.2, -3.0, 1.6), (-0.3, 0.0, 0.1))
    return Scene(name, "collide", bodies, Roles("ball", "box"), camera, pushes=(push,))


def batch_of(made: Scene, size: int = 128, **changed: Any) -> Batch:
    """Return what the model gets of a scene."""
    model = build_model("seeing-simulation", image_size=size)
    frames = np.array(model.spec.context_frames(), np.int64)
    motion = Motion(made, simulate(made, frames=45))
    reader = MotionRenderer(
        {made.name: motion}, model.spec.inputs, size, 10, {made.name: "redyellow"}
    )
    arrays = {key: value[None] for key, value in reader.read(made.name, frames).items()}
    valid = np.ones((1, len(frames)), np.bool_)
    return Batch((made.name,), frames[None], valid, **{**arrays, **changed})


@pytest.fixture(scope="module")
def rolling() -> Batch:
    return batch_of(scene())


@pytest.fixture(scope="module")
def first(rolling: Batch) -> SeenFrame:
    return picture_of(rolling.ids[0, 0], rolling.depth[0, 0], rolling.camera[0])


def test_points_of_a_mask_lie_on_the_true_surfaces(first: SeenFrame) -> None:
    box = scene().bodies[1]
    points = first.points(first.ids == 2) - box.position
    cosine, sine = math.cos(0.6), math.sin(0.6)
    x, y = cosine * points[:, 0] + sine * points[:, 1], cosine * points[:, 1] - sine * points[:, 0]
    outside = np.max([abs(x) - 0.2, abs(y) - 0.3, abs(points[:, 2] - 0.25) - 0.25], axis=0)
    assert len(points) > 300 and np.abs(outside).max() < 1e-4
    ball = first.points(first.ids == 1) - (-1.0, 0.0, 0.15)
    assert np.abs(np.linalg.norm(ball, axis=1) - 0.15).max() < 0.003  # the mesh has 32 sides
    assert floor_height(first) == pytest.approx(0.0, abs=1e-4)


def ray(y: float, depth: float, on: bool) -> Rays:
    """Return a ray along x from (-2, y, 0.5)."""
    return Rays(
        np.array([-2.0, y, 0.5]), np.array([[1.0, 0.0, 0.0]]), np.array([depth]), np.array([on])
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "y", "depth", "on", "expected"),
    [
        ("cube", 0.1, 1.4, True, 0.1),  # 0.1 m before the face at x = -0.5
        ("cube", 0.1, 1.7, True, -0.2),  # behind it
        ("cube", 0.7, 2.0, True, 0.2),  # past the solid
        ("cube", 0.1, 9.0, False, 0.4),  # through the middle, 0.4 m from the nearest face
        ("cube", 0.1, 1.2, False, 0.0),  # seen before the solid
        ("cube", 0.7, 9.0, False, 0.0),
        ("sphere", 0.0, 1.4, True, 0.6 - BALL),
        ("sphere", 0.0, 1.6, True, 0.4 - BALL),
        ("sphere", 0.7, 2.0, True, 0.7 - BALL),
        ("sphere", 0.3, 9.0, False, BALL - 0.3),
        ("sphere", 0.6, 9.0, False, 0.0),
    ],
)
def test_residuals_are_distances_in_metres(
    shape: str, y: float, depth: float, on: bool, expected: float
) -> None:
    placed = Placed(solid(shape), np.zeros(3), np.eye(3), np.ones(3))
    assert residuals(placed, ray(y, depth, on))[0] == pytest.approx(expected, abs=1e-9)


def pole_with_rings() -> Scene:
    """Return a pole on a foot, hidden below by rings of which each hides a part of the next."""
    heights = (0.72, 0.802, 0.895, 1.002, 1.12, 1.252, 1.395)
    rings = [
        Body(f"ring {n}", "torus", (0.0, 0.0, height), (0.325 + 0.05 * n,) * 3)
        for n, height in enumerate(heights)
    ]
    bodies = (
        rings[3],
        Body("box", "cube", (1.2, 0.0, 0.0), (0.3, 0.3, 0.3)),
        Body("foot", "cylinder", (0.0, 0.0, 0.0), (0.4, 0.4, 0.7), mass=20.0),
        Body("pole", "cylinder", (0.0, 0.0, 0.7), (0.15, 0.15, 1.5), mass=5.0),
        *(ring for ring in rings if ring is not rings[3]),
    )
    camera = Camera((2.3, -3.1, 1.8), (0.0, 0.0, 0.8))
    joints = (Joint("foot", "pole"),)
    return Scene("pole", "link", bodies, Roles("ring 3", "box"), camera, joints=joints)


@pytest.mark.slow
def test_rings_and_poles_that_are_hidden_at_both_ends_are_found() -> None:
    made = pole_with_rings()
    batch = batch_of(made, 256)
    (seen,) = SeeingSimulation(build_model("seeing-simulation").settings).see(batch)
    assert seen.trial is not None
    numbers = object_ids(made)[1:].tolist()
    found = {body.name: body for body in seen.trial.scene.bodies}
    for number, body in zip(numbers, made.bodies, strict=True):
        assert found[str(number)].shape == body.shape, body.name
        assert found[str(number)].scale == pytest.approx(body.scale, rel=0.08), body.name


def seen_first(bodies: tuple[Body, ...], camera: Camera) -> dict[str, Placed]:
    """Return what is fitted to bodies in the first frame, by name."""
    made = replace(scene(), bodies=(*scene().bodies[:2], *bodies), camera=camera)
    batch = batch_of(made, 256)
    seen = see_trial("a", batch.frames[0], batch.ids[0], batch.depth[0], batch.camera[0])
    numbers = object_ids(made)[1:].tolist()
    names = {number: body.name for number, body in zip(numbers, made.bodies, strict=True)}
    return {names[track.number]: track.placed[0] for track in seen.tracks}


@pytest.mark.slow
def test_shapes_in_any_rotation_and_hollow_ones_are_found() -> None:
    turned = (0.5, 0.7, -0.4, 0.3)
    length = math.sqrt(sum(q * q for q in turned))
    turned = tuple(q / length for q in turned)  # type: ignore[assignment]
    bodies = (
        Body("cone", "cone", (-0.6, -0.4, 1.0), (0.35, 0.35, 0.35), turned),
        Body("pyramid", "pyramid", (0.4, -0.5, 1.0), (0.4, 0.4, 0.4), turned),
        Body("pipe", "pipe", (-0.2, 0.9, 0.0), (0.5, 0.5, 0.4)),
    )
    found = seen_first(bodies, Camera((0.2, -2.6, 2.6), (-0.2, 0.1, 0.4)))
    for body in bodies:
        placed = found[body.name]
        assert placed.solid.name == body.shape
        assert placed.cost < 0.001
        assert placed.scale == pytest.approx(body.scale, abs=0.005)
    # A ball is drawn with corners on the true radius.
    assert found["ball"].scale == pytest.approx((0.3, 0.3, 0.3), abs=0.001)


@pytest.mark.slow
def test_a_pole_reaches_up_to_what_stands_on_it() -> None:
    bodies = (
        Body("foot", "cylinder", (-0.4, 0.6, 0.0), (0.5, 0.5, 0.3), mass=20.0),
        Body("pole", "cylinder", (-0.4, 0.6, 0.3), (0.15, 0.15, 0.8), mass=4.0),
        Body("lid", "cylinder", (-0.4, 0.6, 1.1), (0.5, 0.5, 0.2), mass=1.0),
    )
    found = seen_first(bodies, Camera((0.2, -2.4, 2.4), (-0.3, 0.0, 0.5)))
    assert found["pole"].extent_z() == pytest.approx((0.3, 1.1), abs=0.005)
    assert found["lid"].extent_z() == pytest.approx((1.1, 1.3), abs=0.005)


@pytest.mark.slow
def test_of_two_alike_dominoes_one_shows_the_size_of_the_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bodies = (
        Body("domino", "cube", (-0.5, 0.9, 0.0), (0.25, 0.1, 0.5), TURNED, mass=2.0),
        Body("half hidden", "cube", (0.35, 0.75, 0.0), (0.25, 0.1, 0.5), mass=2.0),
        Body("other", "cube", (-1.0, 0.5, 0.0), (0.25, 0.25, 0.2), mass=2.0),
    )
    camera = Camera((0.2, -3.0, 1.0), (-0.2, 0.0, 0.2))
    found = seen_first(bodies, camera)
    assert sorted(found["half hidden"].scale) == pytest.approx([0.1, 0.25, 0.5], abs=0.01)
    assert sorted(found["half hidden"].scale) == pytest.approx(sorted(found["domino"].scale))
    assert sorted(found["other"].scale) == pytest.approx([0.2, 0.25, 0.25], abs=0.01)
    monkeypatch.setattr("physion.models.seeing.scenes.alike", lambda found, *_: dict(found))
    assert min(seen_first(bodies, camera)["half hidden"].scale) < 0.08


def test_a_hole_is_free() -> None:
    down = np.array([[0.0, 0.0, -1.0]])
    rays = Rays(np.array([0.0, 0.0, 3.0]), down, np.array([3.0]), np.array([False]))
    placed = [Placed(solid(n), np.zeros(3), np.eye(3), np.ones(3)) for n in ("torus", "cube")]
    assert [float(residuals(each, rays)[0]) for each in placed] == [0.0, 0.5]


@pytest.mark.slow
def test_shapes_scales_and_poses_are_found(first: SeenFrame) -> None:
    for number, body in zip(object_ids(scene())[1:].tolist(), scene().bodies, strict=True):
        rays = first.rays(number)
        assert rays is not None
        found = find(rays, Prior())
        true = Placed(
            solid(body.shape),
            np.array(body.position),
            rotation_matrices(body.rotation),
            np.array(body.scale),
        )
        assert found.solid.name == body.shape
        assert np.linalg.norm(found.middle() - true.middle()) < 0.003
        assert sorted(found.scale) == pytest.approx(sorted(body.scale), abs=0.006)
        assert found.cost <= cost_of(true, rays) + 0.005


@pytest.mark.slow
def test_what_has_turned_and_moved_is_followed(first: SeenFrame, rolling: Batch) -> None:
    rays = first.rays(2)
    assert rays is not None
    box = scene().bodies[1]
    true = Placed(
        solid("cube"), np.array(box.position), rotation_matrices(TURNED), np.array(box.scale), 0.0
    )
    assert follow(true, rays, 0.0) == (true, False)
    away = replace(true, position=true.position + 0.05, rotation=np.eye(3))
    found, moved = follow(away, rays, 0.0)
    assert moved and np.linalg.norm(found.position - true.position) < 0.002


def track(places: NDArray[np.float64], shape: str = "sphere") -> Track:
    """Return an object that was seen at places (3, 3) in frames 40, 42, 44."""
    scale = np.full(3, 0.2)
    placed = tuple(Placed(solid(shape), place, np.eye(3), scale) for place in places)
    return Track(3, (40, 42, 44), placed)


def test_velocities_of_falling_rolling_and_still_objects() -> None:
    times = np.array([0.4, 0.42, 0.44])
    falling = np.outer(times, (1.0, 0.5, 0.0)) - np.outer(times**2, (0, 0, 9.81 / 2))
    velocity, spin, flies = velocities(track(falling))
    assert flies and velocity == pytest.approx((1.0, 0.5, -9.81 * 0.435), abs=1e-6)
    assert spin == pytest.approx(0)
    # With v of 1 m/s, then 0.8 m/s, a is -10 m/s2; friction turns a ball by 2.5 (v0 - v) / r.
    slowed = np.array([[0.0, 0, 0], [0.02, 0, 0], [0.036, 0, 0]])
    velocity, spin, flies = velocities(track(slowed))
    assert not flies and velocity == pytest.approx((0.75, 0.0, 0.0))
    assert spin == pytest.approx((0.0, 2.5 * 0.25 / 0.1, 0.0))
    velocity, spin, _ = velocities(track(np.zeros((3, 3)), "cube"))
    assert not velocity.any() and not spin.any()


@pytest.mark.slow
def test_the_scene_at_the_last_frame_is_near_the_true_one(rolling: Batch) -> None:
    seen = see_trial("a", rolling.frames[0], rolling.ids[0], rolling.depth[0], rolling.camera[0])
    assert seen.trial is not None and seen.note == ""
    true = simulate(scene(), frames=45)
    found = seen.trial.scene
    assert [body.shape for body in found.bodies] == ["sphere", "cube", "cylinder"]
    assert (found.roles.agent, found.roles.patient) == ("1", "2")
    for index in range(2):
        assert seen.trial.state.velocities[index] == pytest.approx(
            true.velocities[44, index].astype(float), abs=0.06
        )
    assert not seen.trial.observed_contact and found.floor == 0.0
    assert not any(body.kinematic for body in found.bodies)


@pytest.mark.slow
def test_what_is_predicted_follows_from_what_is_seen(rolling: Batch) -> None:
    model: SeeingSimulation = build_model("seeing-simulation", samples=4, image_size=128)  # type: ignore[assignment]
    hit = model.imagine(rolling, 4, 0)
    missed = model.imagine(batch_of(scene(-0.8)), 4, 0)
    assert hit.contact.tolist() == [[True] * 4] and missed.contact.tolist() == [[False] * 4]
    shown = model.imagine(replace(rolling, future=2), 4, 0, show=1.0).shown["rgb"]
    assert shown.shape == (1, 4, 2, 128, 128, 3)
    red = (shown[0, 0, 0, :, :, 0] > 90) & (shown[0, 0, 0, :, :, 1] < 60)
    assert red.sum() > 20


@pytest.mark.slow
def test_an_agent_that_is_never_seen_leaves_the_answer_open(rolling: Batch) -> None:
    hidden = np.where(rolling.ids == 1, 0, rolling.ids).astype(np.uint8)
    model = build_model("seeing-simulation", samples=4, image_size=128)
    batch = replace(rolling, ids=hidden)
    assert model.imagine(batch, 4, 0).contact.sum() == 2
    assert model.notes(batch) == ["the agent is never seen"]


# Depth with an error.

ERROR = 0.02


def with_errors(batch: Batch, seed: int = 0) -> Batch:
    """Return every second frame of a batch, with errors of depth of 2 %, as `ERROR` says.

    Each object has one, and each pixel another one.
    """
    rng = np.random.default_rng(seed)
    assert batch.ids is not None and batch.depth is not None
    batch = replace(
        batch, frames=batch.frames[:, ::2], valid=batch.valid[:, ::2], ids=batch.ids[:, ::2],
        depth=batch.depth[:, ::2],
    )  # fmt: skip
    assert batch.ids is not None and batch.depth is not None
    wrong = 1 + ERROR * rng.standard_normal(batch.depth.shape)
    for number in range(1, 4):
        wrong[batch.ids == number] *= 1 + ERROR * rng.standard_normal()
    return replace(batch, depth=(batch.depth * wrong).astype(np.float32))


@pytest.mark.parametrize(
    ("shape", "y", "depth", "on", "entry", "distance"),
    [
        ("cube", 0.1, 1.4, True, 1.5, 0.0),
        ("cube", 0.7, 2.0, True, math.nan, 0.2),  # misses, 0.2 m from the face
        ("cube", 0.1, 9.0, False, math.nan, 0.4),  # halfway, 0.4 m below the nearest face
        ("cube", 0.1, 1.6, False, math.nan, 0.05),  # free for the first 0.1 m only
        ("cube", 0.1, 1.2, False, math.nan, 0.0),
        ("sphere", 0.3, 1.4, True, 1.6, 0.0),
        ("sphere", 0.7, 2.0, True, math.nan, 0.2),
        ("sphere", 0.3, 9.0, False, math.nan, 0.2),
        ("sphere", 0.6, 9.0, False, math.nan, 0.0),
    ],
)
def test_rays_meet_or_miss_a_solid(
    shape: str, y: float, depth: float, on: bool, entry: float, distance: float
) -> None:
    placed = Placed(solid(shape), np.zeros(3), np.eye(3), np.ones(3))
    entries, out = traced(placed, ray(y, depth, on))
    assert entries[0] == pytest.approx(entry, nan_ok=True)
    assert out[0] == pytest.approx(distance, abs=1e-9)


@pytest.mark.slow
def test_what_stands_on_the_floor_is_found_in_spite_of_errors(rolling: Batch) -> None:
    batch, made = with_errors(rolling), scene()
    assert batch.ids is not None and batch.depth is not None
    picture = uncertain_frame(
        picture_of(batch.ids[0, 0], batch.depth[0, 0], batch.camera[0]), ERROR
    )
    rays = picture.rays(2)
    assert rays is not None
    box = made.bodies[1]
    true = Placed(
        solid("cube"), np.array(box.position), rotation_matrices(TURNED), np.array(box.scale)
    )
    fit = MaskFit(rays, ERROR, rest=0.0)
    away = replace(
        true, position=true.position + np.array([0.05, 0.1, 0.0]), scale=true.scale * 1.1
    )
    found = fit.solve(away, 20)
    assert found.extent_z()[0] == pytest.approx(0, abs=1e-9)
    assert np.linalg.norm(found.middle() - true.middle()) < 0.02
    # By itself it is as far off as its depth.
    alone = MaskFit(rays, ERROR).solve(away, 20)
    assert np.linalg.norm(alone.middle() - true.middle()) < 0.15
    # Solids that are drawn from the spread of a fit fit nearly as well.
    draws = np.random.default_rng(0).standard_normal((20, len(fit.values)))
    squares = [np.mean(fit.residuals(fit.values + fit.spread() @ u) ** 2) for u in draws]
    assert found.cost < np.median(squares) < found.cost + 0.5


@pytest.mark.slow
def test_what_stands_on_something_still_does_with_other_sizes() -> None:
    bodies = (
        Body("ball", "sphere", (-0.9, 0.3, 0.0), (0.3, 0.3, 0.3)),
        Body("plate", "cube", (0.2, 0.0, 0.0), (1.4, 1.4, 0.01), kinematic=True),
        Body("lower", "cube", (0.2, 0.1, 0.01), (0.4, 0.4, 0.3), mass=2.0),
        Body("upper", "cylinder", (0.2, 0.1, 0.31), (0.3, 0.3, 0.3), mass=1.0),
    )
    made = replace(scene(), bodies=bodies, pushes=(), roles=Roles("ball", "plate"))
    batch = with_errors(batch_of(made, 256))
    assert batch.ids is not None and batch.depth is not None
    pictures = {
        frame: uncertain_frame(
            picture_of(batch.ids[0, row], batch.depth[0, row], batch.camera[0]), ERROR
        )
        for row, frame in enumerate((0, 2))
    }
    found = resting_scene(pictures, [1, 2, 3, 4], ERROR, {})
    numbers = {name: int(n) for name, n in zip(made.names(), object_ids(made)[1:], strict=True)}
    lower, upper = numbers["lower"], numbers["upper"]
    assert (found[lower].support, found[upper].support) == (2, lower)
    assert found[upper].placed.solid.name == "cylinder"
    for name, body in zip(made.names(), made.bodies, strict=True):
        place = found[numbers[name]].placed
        assert place.extent_z()[0] == pytest.approx(body.position[2], abs=0.02)
        assert np.hypot(*(place.middle()[:2] - body.position[:2])) < 0.06
    count = sum(one.spread.shape[1] for one in found.values())
    drawn = stacked(found, np.random.default_rng(1).standard_normal(count))
    assert drawn[upper].extent_z()[0] == pytest.approx(drawn[lower].extent_z()[1])
    assert drawn[lower].extent_z()[1] != found[lower].placed.extent_z()[1]


@pytest.mark.slow
def test_a_push_is_found_by_simulation() -> None:
    made = scene()
    batch = with_errors(batch_of(made, 256))
    arrays = batch.ids[0], batch.depth[0], batch.camera[0]  # type: ignore[index]
    frames = [int(frame) for frame in batch.frames[0]]
    seen = see_uncertain(frames, *arrays, ERROR, make_engine())
    true = simulate(made, frames=45)
    assert seen.trial is not None and seen.note == ""
    names = list(seen.trial.scene.names())
    ball = names.index("1")
    assert seen.trial.scene.bodies[ball].shape == "sphere"
    box = seen.trial.scene.bodies[names.index("2")]
    assert box.shape == "cube" and box.scale[2] == pytest.approx(0.5, abs=0.05), "no plate"
    found = seen.trial.state
    assert found.positions[ball] == pytest.approx(true.positions[44, 0].astype(float), abs=0.1)
    assert found.velocities[ball] == pytest.approx(true.velocities[44, 0].astype(float), abs=0.3)
    assert len(seen.weighted) > 1 and seen.weighted[0][1] == max(w for _, w in seen.weighted)
    again = see_uncertain(frames, *arrays, ERROR, make_engine())
    assert np.array_equal(again.trial.state.positions, found.positions)  # type: ignore[union-attr]
    model: Any = build_model("seeing-simulation", samples=8, depth_error=ERROR)
    assert model.imagine(batch, 8, 0).contact.mean() > 0.5
    missed = with_errors(batch_of(scene(-0.8), 256))
    assert model.imagine(missed, 8, 0).contact.mean() < 0.5
    only_masks: Any = build_model("seeing-simulation", samples=8, depth=False)
    assert only_masks.spec.inputs == ("ids", "camera")
    assert only_masks.imagine(replace(batch, depth=None), 8, 0).contact.shape == (1, 8)
    [without] = only_masks.see(replace(batch, depth=None))
    assert without.trial is not None and {"1", "2"} <= set(without.trial.scene.names())


def video_of(made: Scene) -> Video:
    """Return the masks of every second frame of a scene."""
    batch = batch_of(made, 256)
    ids, camera = batch.ids[0, ::2], batch.camera[0]  # type: ignore[index]
    depth = assumed_depth(ids, camera)
    seen = zip(batch.frames[0, ::2].tolist(), ids, depth, strict=True)
    pictures = {n: uncertain_frame(picture_of(i, d, camera), ERROR) for n, i, d in seen}
    return Video(pictures, camera, (1, 2, 3), depth=False)


@pytest.mark.parametrize("frame", [0, 5])
@pytest.mark.parametrize("velocity", [(2.0, 0.5, 3.0), (3.0, -0.4, 1.5), (2.0, 0.0, 0.0)])
def test_what_is_thrown_is_seen_to_fly_and_what_rolls_is_not(velocity: Any, frame: int) -> None:
    made = scene()
    made = replace(made, pushes=(Push("ball", velocity, frame=frame),))
    ball = made.bodies[0]
    placed = Placed(
        solid(ball.shape), np.array(ball.position), np.eye(3), np.array(ball.scale), 0.0
    )
    found = _flight(video_of(made), 0, frame // 2 + 1, placed)
    if velocity[2] == 0:
        assert found is None
    else:
        assert found is not None and found.number == 1
        # What is least certain is the velocity away from the camera.
        wrong = np.abs(found.mean[[0, 1, 5]] - velocity)
        assert (wrong < [0.4, 1.2, 0.4]).all() and found.mean[4] == max(frame, 1)


def test_a_hypothesis_that_moves_what_has_not_moved_is_found() -> None:
    video = video_of(scene(0.2))
    assert video.still.tolist() == [False, True, True]
    # With a stronger push and a lighter box the ball moves the box before the last frame.
    ball, box, cylinder = scene(0.2).bodies
    light = (ball, replace(box, mass=0.2), cylinder)
    harder = replace(scene(0.2), bodies=light, pushes=(Push("ball", (6.0, 0.0, 0.0), frame=1),))
    assert not video.moved(scene(0.2), simulate(scene(0.2), frames=45)).any()
    path = simulate(harder, frames=45)
    assert video.moved(harder, path).tolist() == [False, True, False]
    joined = replace(harder, joints=(Joint("box", "cylinder"),))
    assert video.moved(joined, path).tolist() == [False, True, True]


def test_samples_are_shared_by_weight() -> None:
    trials: Any = ["first", "second", "third"]
    seen = SeenTrial(trials[0], (), "", tuple(zip(trials, (2.0, 1.0, 0.001), strict=True)))
    assert seen.shared(9) == [("first", 6), ("second", 3)]
    assert SeenTrial(trials[0], (), "").shared(4) == [("first", 4)]
    assert SeenTrial(None, (), "").shared(4) == []


def test_bad_input_says_what_is_wrong(rolling: Batch) -> None:
    model = build_model("seeing-simulation", samples=1, image_size=128)
    with pytest.raises(BadInputError, match="needs masks, depth and camera"):
        model.imagine(replace(rolling, depth=None), 1, 0)
    flat = rolling.camera.copy()
    flat[0, 1, 3] = (0, 0, 0, 1)
    with pytest.raises(BadInputError, match="needs a pinhole camera"):
        model.imagine(replace(rolling, camera=flat), 1, 0)
    many = rolling.ids.copy()
    many[0, 0, 0, :16] = np.arange(1, 17)
    with pytest.raises(BadInputError, match=r"a trial shows 16 objects; .* at most 15"):
        model.imagine(replace(rolling, ids=many), 1, 0)
    with pytest.raises(BadInputError, match="at least one sample"):
        build_model("seeing-simulation", samples=0)
    with pytest.raises(BadInputError, match=r"must be 0, or from 0.005 to 0.04, not 0.5"):
        build_model("seeing-simulation", depth_error=0.5)
    with pytest.raises(BadInputError, match="depth_error is for depth that is seen"):
        build_model("seeing-simulation", depth_error=0.02, depth=False)


class Noted(Model):
    """Model that says something about the second of two trials."""

    spec = Spec(inputs=(), future=0)

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        return Rollout(contact=np.ones((2, samples), np.bool_))

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        return np.full(len(batch), 0.5)

    def notes(self, batch: Batch) -> list[str]:
        return ["é unseen" if trial == "b" else "" for trial in batch.trials]

    def provenance(self) -> Provenance:
        return Provenance("noted", "none")

    def digest(self) -> str:
        return "0" * 64


def test_notes_of_a_model_reach_the_table(tmp_path: Any) -> None:
    batch = Batch(("a", "b"), np.zeros((2, 1), np.int64), np.ones((2, 1), np.bool_))
    rows = imagine_clips(Noted(), batch, 3, 0, {})
    files = {
        trial: write_features(tmp_path / trial, row)
        for trial, row in zip(batch.trials, rows, strict=True)
    }
    imagined = Imagined("noted", files)
    assert (imagined.note("a"), imagined.note("b")) == ("", "é unseen")
    decided = Decided(np.array([0.5, 0.5]), 0.5, note="fit", notes={"b": imagined.note("b")})
    part = ScenarioPredictions("drop", "full", ("a", "b"), decided, 0, -1, "", note="fit")
    index = pd.DataFrame(
        {"trial": ["a", "b"], "scenario": "drop", "contact": True, "recorded_contact": None,
         "observed_contact": False}
    )  # fmt: skip
    table = make_table([part], Noted().provenance(), index)
    assert table["note"].tolist() == ["fit", "fit; é unseen"]


@pytest.mark.slow
def test_what_hides_the_lower_end_of_an_object_does_not_shorten_it() -> None:
    """A domino behind another one, of which only the upper part is seen, stands on the floor."""
    bodies = (
        Body("ball", "sphere", (-1.0, 0.0, 0.0), (0.3, 0.3, 0.3)),
        Body("box", "cube", (0.7, 0.0, 0.0), (0.3, 0.3, 0.3)),
        Body("domino", "cube", (-0.2, 0.6, 0.0), (0.4, 0.1, 0.8), mass=2.0),
        Body("wall", "cube", (-0.2, 0.2, 0.0), (0.9, 0.1, 0.5), mass=9.0),
    )
    batch = batch_of(replace(scene(), bodies=bodies))
    seen = see_trial("a", batch.frames[0], batch.ids[0], batch.depth[0], batch.camera[0])
    lowest = {track.number: track.placed[0].extent_z() for track in seen.tracks}
    assert lowest[3] == pytest.approx((0.0, 0.8), abs=0.01)


@pytest.mark.slow
def test_a_sheet_of_cloth_falls_over_what_is_under_it() -> None:
    made = sample_scene("drape", 3)
    batch = batch_of(made, 256)
    seen = see_trial("a", batch.frames[0], batch.ids[0], batch.depth[0], batch.camera[0])
    assert seen.trial is not None and len(seen.tracks) == len(made.bodies)
    (found,), (true,) = seen.trial.scene.cloths, made.cloths
    assert found.position == pytest.approx(true.position, abs=0.01)
    assert found.size == pytest.approx(true.size, abs=0.02) and found.stretch == 0.5
    assert all(body.kinematic for body in seen.trial.scene.bodies)
    assert "object 1 is taken for a sheet of cloth" in seen.note
    shared = seen.shared(20)
    assert [count for _, count in shared] == [2] * 10
    assert len({trial.scene.cloths[0].stretch for trial, _ in shared}) == 10
    # Each has noise of its own.
    starts = [add_noise(trial, NoiseLevels(), 1.0, 0, 0)[1] for trial, _ in shared]
    moved = [
        (start.cloth_vertices - trial.state.cloth_vertices)[0, 0]
        for start, (trial, _) in zip(starts, shared, strict=True)
    ]
    assert len(set(np.round(moved, 5))) == 10
    falling = simulate(made, frames=45).state(44).cloth_vertices
    apart = np.abs(seen.trial.state.cloth_vertices - falling)
    assert np.quantile(apart, 0.9) < 0.02


def flat(height: float = 1.0, hidden: bool = False, narrow: bool = False) -> SeenFrame:
    """Return a sheet of 0.8 m above a floor, from a camera that looks down; 1 is the sheet.

    ``hidden``: something nearer hides its left third, and what is left of it. ``narrow``: only one
    row of pixels is seen.
    """
    x, y = np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-1, 1, 80))
    vectors = np.stack([x, y, -np.ones_like(x)], axis=-1)
    on = (np.abs(vectors[..., :2] * (3.0 - height)) < 0.4).all(axis=-1)
    ids, depth = np.where(on, 1, SCENERY_ID).astype(np.uint8), np.where(on, 3.0 - height, 3.0)
    covered = x < -0.13 / (3.0 - height) if hidden else np.zeros_like(on)
    if narrow:
        covered[np.arange(80) != 40] = True
    ids[covered], depth[covered] = 5, 0.5
    return SeenFrame(ids, depth, np.array([0.0, 0.0, 3.0]), vectors)


def test_a_flat_sheet_that_falls_is_found_also_where_an_edge_is_hidden() -> None:
    fallen, look = flat(0.97), Look()
    sheet = sheet_of(1, flat(), fallen, 0.0, look)
    assert sheet is not None and sheet.size[0] == pytest.approx(0.8, abs=0.05)
    assert sheet.position == pytest.approx((0.0, 0.0, 1.0), abs=0.01)
    partly = sheet_of(1, flat(hidden=True), fallen, 0.0, look)
    assert partly is not None and partly.position == pytest.approx((0.0, 0.0, 1.0), abs=0.03)
    pierced = flat()
    pierced.depth[36:44, 36:44] -= 0.1
    assert sheet_of(1, pierced, fallen, 0.0, look) == sheet
    tilted = flat()
    tilted.depth[:40] += 0.02
    for first in (tilted, flat(narrow=True)):
        assert sheet_of(1, first, fallen, 0.0, look) is None
    assert sheet_of(1, flat(), flat(), 0.0, look) is None  # a board at rest
    assert sheet_of(1, flat(0.2), flat(0.17), 0.0, look) is None  # near the floor
    assert sheet_of(7, flat(), fallen, 0.0, look) is None


@pytest.mark.slow
def test_only_the_cloth_of_official_scenes_is_taken_for_cloth() -> None:
    found = set()
    for trial in official().trials[::20]:
        motion = Motion(trial.scene, simulate(trial.scene, frames=45))
        name, inputs = trial.scene.name, ("ids", "depth", "camera")
        reader = MotionRenderer({name: motion}, inputs, 256, 15, {name: "redyellow"})
        read = reader.read(name, np.array((0, 8), np.int64))
        first, second = (
            picture_of(read["ids"][i], read["depth"][i], read["camera"]) for i in range(2)
        )
        for number in np.unique(first.ids[first.ids != SCENERY_ID]).tolist():
            sheet = sheet_of(number, first, second, floor_height(first), Look())
            assert (sheet is not None) == (number == 1 and trial.scene.scenario == "drape"), name
        found.add(trial.scene.scenario)
    assert found == set(SCENARIOS)


def test_a_pole_is_joined_to_its_base_until_they_move_apart() -> None:
    base = Placed(solid("cylinder"), np.zeros(3), np.eye(3), np.array([0.4, 0.4, 0.2]))
    pole = Placed(
        solid("cylinder"), np.array([0.0, 0.0, 0.2]), np.eye(3), np.array([0.1, 0.1, 0.8])
    )
    bodies = [Body("3", "cylinder", (0.0, 0.0, 0.0)), Body("4", "cylinder", (0.0, 0.0, 0.2))]
    tracks = [Track(3, (0, 44), (base, base)), Track(4, (0, 44), (pole, pole))]
    assert joints_of(tracks, bodies) == (Joint("3", "4"),)
    fallen = replace(pole, position=np.array([0.3, 0.0, 0.0]))
    assert joints_of([tracks[0], Track(4, (0, 44), (pole, fallen))], bodies) == ()
    wide = replace(pole, scale=np.array([0.4, 0.4, 0.8]))
    assert joints_of([tracks[0], Track(4, (0, 44), (wide, wide))], bodies) == ()


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A trial that was written as an official HDF5 file and imported again."""
    folder = tmp_path_factory.mktemp("seeing")
    trials = make_dataset(folder / "trials", touch=False)
    export_official(trials, folder / "official", executor=SerialExecutor())
    import_official(folder / "official", folder / "imported", executor=SerialExecutor())
    return Dataset(folder / "imported")


@pytest.mark.slow
def test_an_imported_official_trial_is_seen_and_answered(imported: Dataset, tmp_path: Path) -> None:
    model: Any = build_model("seeing-simulation")
    source = observed_source(imported, model.spec)
    (seen,) = model.see(source.context([RIGID]))
    true = imported.trial(RIGID)
    roles = true.scene.roles
    # Later these bodies, whose motion is made up, turn through the floor.
    for name, number in ((roles.agent, 1), (roles.probe, 3)):
        index = true.scene.index(str(name))
        body, state = true.scene.bodies[index], true.trajectory.state(0)
        pose = state.positions[index], rotation_matrices(state.rotations[index])
        expected = Placed(solid(body.shape), *pose, np.array(body.scale))
        found = next(track.placed[0] for track in seen.tracks if track.number == number)
        assert found.solid.name == body.shape
        assert np.linalg.norm(found.middle() - expected.middle()) < 0.005
    done = evaluate(
        "seeing-simulation", imported, tmp_path, options={"samples": 4}, executor=SerialExecutor()
    )
    (row,) = done.predictions.to_dict("records")
    assert (row["stimulus"], row["readout"]) == (RIGID, "observed+simulated")
    assert row["p_contact"] in {0.1, 0.3, 0.5, 0.7, 0.9}, "k + 1/2 of 4 + 1"


@pytest.mark.slow
def test_the_viewer_gets_pictures_of_what_follows(imported: Dataset) -> None:
    (shown,) = imagine_with(imported, ["seeing-simulation"], {"samples": 2})([RIGID])[RIGID]
    pictures = shown.shown["rgb"]
    assert pictures.shape[1:] == (128, 128, 3) and len(pictures) == len(shown.frames)
    assert shown.frames[0] == 45 and shown.probability in {0.5 / 3, 1.5 / 3, 2.5 / 3}
    red = (pictures[0, ..., 0] > 90) & (pictures[0, ..., 1] < 60)
    assert red.any(), "the agent"


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(
    "scenario", ["collide", "contain", "dominoes", "drop", "link", "roll", "support"]
)
def test_scenes_of_every_scenario_are_recovered(scenario: str) -> None:
    """Half of the movable objects are seen within 1 cm; three of four have the right shape."""
    errors, right = [], []
    for seed in (1, 2):
        made = sample_scene(scenario, seed)
        start = simulate(made, frames=1)
        batch = batch_of(made, 256)
        seen = see_trial("a", batch.frames[0], batch.ids[0], batch.depth[0], batch.camera[0])
        tracks = {track.number: track.placed[0] for track in seen.tracks}
        for index, body in enumerate(made.bodies):
            number = int(object_ids(made)[1 + index])
            if body.scenery or body.kinematic or number not in tracks:
                continue
            true = Placed(
                solid(body.shape),
                start.positions[0, index],
                rotation_matrices(start.rotations[0, index]),
                np.array(body.scale),
            )
            errors.append(np.linalg.norm(tracks[number].middle() - true.middle()))
            right.append(tracks[number].solid.name == body.shape)
    assert np.median(errors) < 0.01 and np.mean(right) >= 0.75


def test_what_would_be_behind_the_camera_is_not_fitted_again(rolling: Batch) -> None:
    assert rolling.ids is not None and rolling.depth is not None and rolling.camera is not None
    camera = rolling.camera[0]
    rays = picture_of(rolling.ids[0, 0], rolling.depth[0, 0], camera).rays(1)
    assert rays is not None
    axis = camera[0, 2, :3]
    behind = rays.origin - 0.75 * axis
    start = Placed(solid("cube"), behind, np.eye(3), np.full(3, 0.5))
    one: Any = SimpleNamespace(fit=SimpleNamespace(log_factor=0.0, error=ERROR))
    assert _refitted(one, start, rays, axis) is start
    # A large one at .6 m has the camera inside.
    start = replace(start, position=rays.origin + 0.6 * axis, scale=np.full(3, 2.0))
    assert np.isfinite(_refitted(one, start, rays, axis).position).all()
