"""Particle simulators: symmetries, training, weights, rollouts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from physion import sample_scene
from physion.clips.batch import Batch, Motion, cut_to_observed
from physion.core.errors import BadInputError
from physion.models.build import build_model
from physion.models.checkpoint import tensors_of, write_checkpoint
from physion.models.particles.bodies import (
    KINEMATIC,
    RIGID,
    Poses,
    Sampling,
    particle_positions,
    poses_of,
    rotation_from_vector,
    scene_particles,
)
from physion.models.particles.networks import (
    JoinedInputs,
    ObjectState,
    drift_of,
    join_poses,
    join_scenes,
)
from physion.models.particles.rollout import (
    Window,
    disturbed,
    point_distances,
    read_window,
    smallest_distance,
)
from physion.models.particles.simulator import CONTACT_SPACINGS, ParticleSimulator, observed_start
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.scenes.scene import BodyEvent, Ending
from support.crossing_bodies import replace_future
from support.rendered_scenes import body, scene_of, trajectory_of

NAMES = ("gns", "gns-ransac", "dpi")
RIGID_FITS = ("ransac", "released")


def motion(scenario: str, seed: int, frames: int = 75) -> Motion:
    """Return a trial; with few frames a model imagines few steps."""
    scene = replace(sample_scene(scenario, seed), ending=Ending(frames, frames))
    return Motion(scene, simulate(scene))


@pytest.fixture(scope="module")
def collide() -> Motion:
    return motion("collide", 3)


def window(*motions: Motion, start: int = 30, steps: int = 3) -> Batch:
    frames = np.arange(start, start + 3 * steps, 3)[None].repeat(len(motions), 0)
    names = tuple(m.scene.name for m in motions)
    return Batch(names, frames, np.ones_like(frames, np.bool_), state=motions)


def observed(*motions: Motion) -> Batch:
    cut = tuple(Motion(m.scene, cut_to_observed(m.scene, m.trajectory)) for m in motions)
    frames = np.arange(2, 45, 3)[None].repeat(len(cut), 0)
    names = tuple(m.scene.name for m in cut)
    return Batch(names, frames, np.ones_like(frames, np.bool_), state=cut)


def model_of(name: str, **options: object) -> ParticleSimulator:
    model = build_model(name, **{"weights": "random", **options})
    assert isinstance(model, ParticleSimulator)
    return model


def silent(name: str, **options: object) -> ParticleSimulator:
    """Return a model whose network says 0, so that everything keeps its velocity."""
    model = model_of(name, **options)
    with torch.no_grad():
        for weight in model.parameters():
            weight.zero_()
    return model


def last_states(model: ParticleSimulator, *motions: Motion):  # type: ignore[no-untyped-def]
    """Return layout and the last two observed states."""
    particles = [scene_particles(m.scene, model.settings.sampling) for m in motions]
    poses = [poses_of(p, m, [41, 44]) for p, m in zip(particles, motions, strict=True)]
    layout = join_scenes(particles, model.device)
    return layout, join_poses(poses, 0, model.device), join_poses(poses, 1, model.device)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_shift_of_scene_and_floor_shifts_the_prediction(name: str, collide: Motion) -> None:
    model = model_of(name)
    layout, before, now = last_states(model, collide, motion("drape", 1))
    shift = torch.tensor([3.7, -1.9, 0.4], dtype=torch.float64)
    raised = replace(layout, floor=layout.floor + 0.4)

    def moved(state: ObjectState) -> ObjectState:
        return ObjectState(state.centers + shift, state.rotations, state.loose + shift)

    with torch.no_grad():
        after = model.step(layout, before, now).positions(layout)
        shifted = model.step(raised, moved(before), moved(now)).positions(layout)
        alone = silent(name).step(layout, before, now).positions(layout)
    assert (shifted - shift - after).abs().max() < 1e-6
    for scene in (0, 1):
        own = (layout.scene == scene)[layout.owners]
        assert (after - alone)[own].abs().max() > 1e-3, "the network moves something"


@pytest.mark.parametrize("name", NAMES)
def test_bodies_stay_rigid_and_kinematic_ones_stay(name: str, collide: Motion) -> None:
    model = model_of(name)
    layout, before, now = last_states(model, collide)
    with torch.no_grad():
        after = model.step(layout, before, now)
    eye = torch.eye(3, dtype=torch.float64)
    assert torch.allclose(after.rotations @ after.rotations.mT, eye.expand_as(after.rotations))
    still = layout.kinds == KINEMATIC
    assert still.any() and torch.equal(after.centers[still], now.centers[still])
    assert torch.equal(after.rotations[still], now.rotations[still])


@pytest.mark.parametrize(
    ("name", "options", "free"),
    [
        ("gns", {"size": "paper"}, True),
        ("gns-ransac", {"size": "paper"}, False),
        ("dpi", {"size": "paper"}, False),
        ("gns", {"rigid": "free"}, True),
        ("gns", {}, False),
        ("gns-ransac", {}, False),
    ],
)
def test_bodies_deform_where_they_are_free(
    name: str, options: dict[str, str], free: bool, collide: Motion
) -> None:
    """Distances of the particles of each body, before and after a rollout."""
    model = model_of(name, **options)
    model.settings = replace(model.settings, limit=20, still_limit=20)
    ((particles, poses),) = model.futures([collide], 1, 0)[0]
    positions = particle_positions(particles, poses)
    assert particles.free == free and len(positions) > model.spec.context
    for row in np.flatnonzero(particles.kinds == RIGID):
        own = positions[:, particles.owners == row]
        apart = np.linalg.norm(own[:, :, None] - own[:, None], axis=-1)
        changed = np.abs(apart[-1] - apart[0]).max()
        assert changed > 1e-3 if free else changed < 1e-5
        assert np.allclose(own.mean(axis=1), poses.centers[:, row])


def test_the_steps_of_a_rollout_can_be_limited(collide: Motion) -> None:
    """The first steps are the same; a limit beyond the trial's end changes nothing."""
    whole, few, many = (silent("dpi", future=steps) for steps in (None, 4, 10_000))
    ((_, full),), ((_, short),), ((_, long),) = (
        model.futures([collide], 1, 0)[0] for model in (whole, few, many)
    )
    observed = whole.spec.context
    assert len(short.centers) == observed + 4 < len(full.centers) == len(long.centers)
    assert np.array_equal(short.centers, full.centers[: observed + 4])
    assert whole.digest() != few.digest()
    assert model_of("dpi", weights="shipped", future=4).settings.future == 4
    with pytest.raises(BadInputError, match="future must be at least 1, not 0"):
        model_of("dpi", future=0)


@pytest.mark.parametrize("size", ["small", pytest.param("paper", marks=pytest.mark.slow)])
def test_gns_and_gns_ransac_are_one_network_with_one_training(size: str, collide: Motion) -> None:
    own, robust = (model_of(name, seed=1, size=size) for name in ("gns", "gns-ransac"))
    batch = window(collide, motion("drape", 1), steps=4)
    losses = []
    for model in (own, robust):
        model.settings = replace(model.settings, limit=30, still_limit=30, cloth_step=8)
        torch.manual_seed(0)
        losses.append(float(model.loss(batch)["loss"].detach()))
    assert losses[0] == losses[1]
    # They differ in a rollout: there the rigid motion is fitted to what agrees, or to all.
    layout, *states = last_states(robust, collide)
    steps = [model_of("gns-ransac", seed=1, rigid=r).step(layout, *states) for r in RIGID_FITS]
    with torch.no_grad():
        assert not torch.allclose(steps[0].centers, steps[1].centers, atol=1e-7)
    with pytest.raises(BadInputError, match="rigid=ransac is not for this model"):
        model_of("dpi", rigid="ransac")


def test_a_body_that_was_rigid_drifts_as_a_rigid_one(collide: Motion) -> None:
    free, rigid = model_of("gns", rigid="free"), model_of("gns-ransac")
    drifts = [drift_of(*last_states(model, collide)) for model in (free, rigid)]
    assert drifts[1].spin.norm(dim=-1).max() > 1e-3, "a body turns"
    for name in ("velocity", "spin", "positions", "normals", "moves"):
        assert torch.allclose(*(getattr(drift, name) for drift in drifts), atol=1e-7)


def test_noise_of_a_free_body_moves_it_and_its_particles(collide: Motion) -> None:
    model = model_of("gns", free_training=True)
    states = read_window(window(collide), model.settings.training_sampling, model.device)
    layout = states.layout
    torch.manual_seed(0)
    noisy = disturbed(states, 0.003, 0.0).before
    rotated = (noisy.rotations[layout.owners] @ layout.shape[..., None])[..., 0]
    own = (noisy.positions(layout) - noisy.centers[layout.owners] - rotated)[layout.loose]
    assert own.std(0).numpy() == pytest.approx(np.full(3, 0.003), rel=0.15)
    moved = (noisy.centers - states.before.centers)[layout.soft_bodies]
    assert 0.001 < moved.std() < 0.006


@pytest.mark.parametrize("name", ["gns", "dpi"])
def test_the_graph_of_the_size_paper_joins_near_particles_of_one_body(
    name: str, collide: Motion
) -> None:
    model = model_of(name, size="paper")
    model.settings = replace(model.settings, limit=60, still_limit=60)
    layout, before, now = last_states(model, collide)
    graph = model._graph(layout, drift_of(layout, before, now))
    positions, moves = now.positions(layout), layout.kinds != KINEMATIC
    near = torch.cdist(positions, positions) < model.settings.radius
    same = layout.owners[:, None] == layout.owners
    some = moves[layout.owners][:, None] | moves[layout.owners]
    expected = near & some & ~torch.eye(len(near), dtype=torch.bool)
    found = torch.zeros_like(near)
    found[graph.rows[graph.receivers], graph.rows[graph.senders]] = True
    assert model.settings.radius == 0.08 and (expected & same).any()
    assert torch.equal(found, expected)
    assert set(moves[layout.owners].nonzero()[:, 0].tolist()) <= set(graph.rows.tolist())


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_scenes_in_one_graph_do_not_touch_each_other(name: str, collide: Motion) -> None:
    model = model_of(name)
    others = [motion("roll", 2), motion("drop", 4)]
    together = model.futures([*others, collide], 1, 0)[-1][0][1]
    alone = model.futures([collide], 1, 0)[0][0][1]
    assert np.allclose(together.centers, alone.centers, atol=1e-5)
    straight = silent(name).futures([collide], 1, 0)[0][0][1]
    first = model.spec.context  # the first imagined row: later ones differ by what adds up
    assert np.abs(alone.centers[first] - straight.centers[first]).max() > 1e-3


def test_drift_is_constant_motion(collide: Motion) -> None:
    """A body that keeps velocity and spin is where the drift says."""
    model = model_of("dpi")
    layout, _, now = last_states(model, collide)
    velocity = torch.tensor([0.03, 0.01, -0.02], dtype=torch.float64)
    spin = torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64)
    back = rotation_from_vector(-spin)
    free = (layout.kinds != KINEMATIC)[:, None]
    before = ObjectState(
        torch.where(free, now.centers - velocity, now.centers),
        torch.where(free[..., None], back @ now.rotations, now.rotations),
        now.loose,
    )
    after = ObjectState(
        torch.where(free, now.centers + velocity, now.centers),
        torch.where(free[..., None], rotation_from_vector(spin) @ now.rotations, now.rotations),
        now.loose,
    )
    drift = drift_of(layout, before, now)
    assert torch.allclose(drift.positions + drift.moves, after.positions(layout), atol=1e-9)


def test_the_graph_of_dpi_has_only_particles_near_something(collide: Motion) -> None:
    """In the graph is what has an edge, or comes nearer to the floor than the radius in a step; in
    the graph of GNS all that can move."""
    model, gns = model_of("dpi"), model_of("gns")
    layout, _, now = last_states(model, collide)
    free = (layout.kinds != KINEMATIC)[layout.owners]
    heights = now.positions(layout)[:, 2] - layout.floor[layout.owners]

    def at(height: float, apart: float = 0.0) -> ObjectState:
        shift = torch.zeros_like(now.centers)
        shift[layout.kinds == RIGID, 2] = height - heights[free].min()
        shift[:, 0] = apart * torch.arange(len(shift))
        return replace(now, centers=now.centers + shift)

    def kept(of: ParticleSimulator, before: ObjectState, now: ObjectState) -> torch.Tensor:
        graph = of._graph(layout, drift_of(layout, before, now))
        found, edges = torch.zeros_like(free), torch.zeros_like(free)
        found[graph.rows] = edges[graph.rows[graph.receivers]] = True
        drift = drift_of(layout, before, now)
        lowest = torch.minimum(drift.positions, drift.positions + drift.moves)[:, 2]
        low = lowest - layout.floor[layout.owners] < of.settings.radius
        assert torch.equal(found, edges | (free & low if of is model else free))
        return found & ~edges

    assert kept(model, at(0.0), at(0.0)).any() and not kept(model, at(0.3), at(0.3)).any()
    assert kept(model, at(0.6), at(0.3)).any(), "it falls into the reach of the floor"
    assert kept(gns, at(0.3), at(0.3)).any()
    # Bodies in free fall far from each other leave the graph empty.
    far = at(5.0, 50.0)
    assert not len(model._graph(layout, drift_of(layout, far, far)).nodes)
    assert model.step(layout, far, far).centers.isfinite().all()


def test_all_particles_of_a_cloth_are_in_the_graph() -> None:
    model = model_of("dpi")
    layout, before, now = last_states(model, motion("drape", 3))
    graph = model._graph(layout, drift_of(layout, before, now))
    assert len(layout.loose) > 200 and set(layout.loose.tolist()) <= set(graph.rows.tolist())


def test_joined_inputs_match_one_matrix() -> None:
    torch.manual_seed(0)
    layers, rows = JoinedInputs(3 + 5 + 4, 8), torch.tensor([0, 2, 1, 1, 2, 0])
    first, second, shared = torch.randn(6, 3), torch.randn(6, 5), torch.randn(3, 4)
    expected = torch.cat([first, second, shared[rows]], -1)
    for layer in layers:
        expected = layer(expected)
    found = layers(first, second, shared=shared, rows=rows)
    assert torch.allclose(found, expected, atol=1e-5) and found.std() > 0.1


def test_the_moments_of_an_object_turn_with_it(collide: Motion) -> None:
    model = model_of("dpi")
    layout, _, now = last_states(model, collide)

    def moments(state: ObjectState) -> torch.Tensor:
        xx, yy, zz, xy, xz, yz = model._graph(layout, drift_of(layout, state, state)).moments.T
        rows = [xx, xy, xz, xy, yy, yz, xz, yz, zz]
        return torch.stack(rows, -1).reshape(-1, 3, 3).double()

    still = moments(now)
    assert torch.allclose(still.diagonal(dim1=1, dim2=2).sum(-1), torch.ones(len(still)).double())
    turn = rotation_from_vector(torch.tensor([0.3, -0.5, 0.9], dtype=torch.float64))
    bodies = layout.kinds == RIGID
    expected = (turn @ still @ turn.T)[bodies]
    turned = moments(ObjectState(now.centers, turn @ now.rotations, now.loose))[bodies]
    assert torch.allclose(turned, expected, atol=1e-6)
    assert not torch.allclose(still[bodies], expected, atol=1e-3)


def test_a_body_that_hardly_moves_rests(collide: Motion) -> None:
    model = model_of("dpi")
    rest = model.settings.rest
    layout, _, now = last_states(model, collide)
    free = (layout.kinds == RIGID).nonzero()[:, 0]
    shifts = torch.zeros_like(now.centers)
    shifts[free, 0] = 0.6 * rest
    after = ObjectState(now.centers + shifts, now.rotations, now.loose)
    assert torch.equal(model._rested(layout, now, after).centers, now.centers)
    # With a rotation that moves the rim as far it moves more than that.
    turns = torch.zeros_like(shifts)
    turns[free[0], 2] = 0.6 * rest / layout.size[free[0]]
    after = ObjectState(after.centers, rotation_from_vector(turns) @ now.rotations, now.loose)
    rested = model._rested(layout, now, after)
    assert torch.equal(rested.centers[free[0]], after.centers[free[0]])
    assert torch.equal(rested.rotations[free[0]], after.rotations[free[0]])
    assert torch.equal(rested.centers[free[1:]], now.centers[free[1:]]) and len(free) > 1


@torch.no_grad()
@pytest.mark.parametrize("name", ["gns", "dpi"])
def test_later_steps_of_a_training_start_from_the_prediction(name: str, collide: Motion) -> None:
    model = model_of(name)
    batch = window(collide, steps=4)
    states = read_window(batch, model.settings.sampling, model.device)
    layout, (first, second) = states.layout, states.later
    predicted = model.step(layout, states.before, states.now)
    assert (predicted.centers - first.centers).abs().max() > 1e-3
    alone = model._loss(states, [first])
    after = model._loss(Window(layout, states.now, predicted, (second,)), [second])
    both = model._loss(states, states.later)
    assert float(both) == pytest.approx((float(alone) + float(after)) / 2, rel=1e-6)
    assert model.window == batch.frames.shape[1]


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", ["gns", "dpi"])
def test_a_network_overfits_one_window(
    name: str, collide: Motion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("physion.models.particles.simulator.rotated", lambda window: window)
    model = model_of(name)
    batch = window(collide, motion("drop", 4), start=60)
    model.prepare(batch)
    model.settings = replace(model.settings, velocity_noise=0.0, relative_noise=0.0)
    baseline = float(model.baseline(batch))
    optimizer = torch.optim.Adam(model.parameters(), 2e-3)
    torch.manual_seed(0)
    for _ in range(60):
        optimizer.zero_grad()
        loss = model.loss(batch)["loss"]
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    assert baseline > 0 and float(loss.detach()) < 0.3 * baseline


@pytest.mark.parametrize(("limit", "apart"), [(1, 0.05), (1, 0.0), (50, 0.0)])
@pytest.mark.parametrize("name", NAMES)
def test_single_particles_and_bodies_at_one_place_give_finite_numbers(
    name: str, limit: int, apart: float
) -> None:
    """Sizes, moments, spreads and distances of 0 are divided by, and normalized."""
    model = model_of(name)
    model.settings = replace(model.settings, limit=limit)
    scene = scene_of(body("a"), body("b"))
    starts = np.array([[0.0, 0.0, 0.05], [apart, 0.0, 0.05]])
    path = starts + np.linspace(0, 0.1, 10)[:, None, None]
    own = Motion(scene, trajectory_of(path))
    batch = window(own, start=0, steps=4)
    states = read_window(batch, model.settings.sampling, model.device)
    layout, before, now = states.layout, states.before, states.now
    edges = model._graph(layout, drift_of(layout, before, now)).edges
    outer = edges[edges[:, -1] == 0]
    assert len(layout.owners) == 2 * limit
    assert outer[:, 3].min() * model.settings.radius == pytest.approx(apart, abs=1e-6)
    after = model.step(layout, before, now)
    assert after.centers.isfinite().all() and after.rotations.isfinite().all()
    model.loss(batch)["loss"].backward()  # type: ignore[no-untyped-call]
    gradients = [weight.grad for weight in model.parameters() if weight.grad is not None]
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert any(gradient.any() for gradient in gradients)


@pytest.mark.parametrize(
    ("name", "limit"),
    [("dpi", 1), *((name, limit) for name in ("gns", "gns-ransac") for limit in (1, 2))],
)
def test_bodies_of_few_particles_are_not_turned_by_the_network(name: str, limit: int) -> None:
    model = model_of(name)
    model.settings = replace(model.settings, limit=limit)
    path = np.broadcast_to([0.0, 0.0, 0.05], (10, 2, 3))
    own = Motion(scene_of(body("a"), body("b")), trajectory_of(path))
    states = read_window(window(own, start=0, steps=4), model.settings.sampling, model.device)
    turn = rotation_from_vector(torch.tensor([[0.9, 0.2, 0.1]], dtype=torch.float64))
    now = replace(states.now, rotations=turn @ states.now.rotations)
    before = replace(states.before, rotations=turn @ states.before.rotations)
    with torch.no_grad():
        after = model.step(states.layout, before, now)
    assert torch.allclose(after.rotations, now.rotations, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_errors_of_a_falling_body_count_alike_for_short_and_long_steps(name: str) -> None:
    """A network that says 0 misses g t² in a step of t; the unit of changes grows with t², too."""
    fallen = 0.5 * 9.81 * (0.01 * np.arange(14)) ** 2
    path = np.array([[0.0, 0.0, 3.0]]) - fallen[:, None, None] * np.array([0.0, 0.0, 1.0])
    own = Motion(scene_of(body("a")), trajectory_of(path))
    losses = []
    for stride in (1, 3):
        model = silent(name, stride=stride).eval()  # type: ignore[no-untyped-call]
        assert model.built_as()["stride"] == stride
        frames = np.arange(0, stride * model.window, stride)[None]
        batch = Batch(("a",), frames, np.ones_like(frames, np.bool_), state=(own,))
        losses.append(float(model.loss(batch)["loss"].detach()))
    # g t² is 8.8 mm in 0.03 s; in the unit of 20 mm an error e costs 2 (sqrt(1 + e²) - 1).
    # Trajectories are stored in single precision.
    expected = 2 * (np.hypot(1, 9.81 * 0.03**2 / 0.02) - 1)
    assert losses == pytest.approx([expected, expected], rel=1e-3)
    cut = observed(motion("collide", 3, 60))
    quick = model_of(name, stride=1)
    ((_, poses),) = quick.futures(list(cut.state), 1, 0)[0]
    assert np.isfinite(poses.centers).all() and len(poses.centers) == 45 + 15


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_size_paper_learns_and_imagines(name: str) -> None:
    """With fewer particles, so that it is quick, but all of its network."""
    model = model_of(name, size="paper")
    assert model.provenance().model == f"{name}-paper"
    model.settings = replace(model.settings, limit=40, still_limit=40, cloth_step=8, gap_limit=100)
    motions = [motion("collide", 3, 60), motion("drape", 1, 60)]
    model.loss(window(*motions))["loss"].backward()  # type: ignore[no-untyped-call]
    for weight in model.parameters():
        gradient = weight.grad
        assert gradient is not None and gradient.isfinite().all() and gradient.any()
    futures = model.futures(motions, 1, 0)
    for ((_, poses),) in futures:
        assert len(poses.centers) == 20, "5 steps are imagined"
        assert all(np.isfinite(v).all() for v in (poses.centers, poses.rotations, poses.loose))
    assert np.isfinite(model.gaps(motions, futures)).all()


@pytest.mark.parametrize("scenario", ["collide", pytest.param("drape", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", NAMES)
def test_what_follows_the_observed_part_is_not_seen(name: str, scenario: str) -> None:
    model, straight = model_of(name, samples=2), silent(name, samples=2)
    clean = motion(scenario, 3, 60)
    changed = replace_future(clean)

    def imagined(given: Motion, seed: int, model: ParticleSimulator = model) -> bytes:
        ((first, second),) = model.futures([given], 2, seed)
        assert not np.array_equal(first[1].centers, second[1].centers), "samples differ"
        assert len(first[1].centers) == 20, "5 steps are imagined"
        arrays = (first[1].centers, second[1].rotations, first[1].loose, second[1].loose)
        return b"".join(values.tobytes() for values in arrays)

    found = imagined(clean, 5)
    assert found == imagined(changed, 5)
    assert found not in (imagined(clean, 6), imagined(clean, 5, straight))
    gap = model.imagine(window(clean), 2, 5).gap.tobytes()
    assert gap == model.imagine(window(changed), 2, 5).gap.tobytes()
    assert gap != straight.imagine(window(clean), 2, 5).gap.tobytes()


def test_the_gap_of_the_true_motion_matches_the_label() -> None:
    """Contacts of the engine are found again from poses, misses are misses."""
    right = []
    for scenario in ("collide", "drop", "dominoes"):
        for seed in range(6):
            own = motion(scenario, seed, 200)
            particles = scene_particles(own.scene, model_of("dpi").settings.sampling)
            poses = poses_of(particles, own, range(0, len(own.trajectory), 3))
            gap = smallest_distance(own.scene, particles, poses, 0.04, 300)
            contact = label_contact(own.scene, own.trajectory).contact
            right.append((gap < 0.02) == contact)
    assert np.mean(right) >= 17 / 18


def test_what_an_event_put_somewhere_did_not_go_there(collide: Motion) -> None:
    """A body that is moved at frame 43 starts without velocity, and is in no window before."""
    scene = collide.scene
    name = scene.roles.agent
    row = scene.index(name)
    positions = collide.trajectory.positions.copy()
    positions[43:, row] += 1.0
    event = BodyEvent(43, name, "move", tuple(float(v) for v in positions[43, row]))
    moved = Motion(
        replace(scene, events=(event,)), replace(collide.trajectory, positions=positions)
    )
    model = model_of("dpi")
    start = observed_start(moved, range(2, 45, 3), model.settings.sampling)
    own = start.particles.agent
    assert np.array_equal(start.poses.centers[-2, own], start.poses.centers[-1, own])
    read = read_window(window(moved, start=39), model.settings.sampling, model.device)
    assert len(read.layout.kinds) == len(start.particles.kinds) - 1


def test_the_end_and_the_smallest_distance_of_points() -> None:
    """Unit cubes with faces .3 m apart at frame 44 and .06 m after 8 steps, which then part."""
    whole = (1.0, 1.0, 1.0)
    path = np.zeros((90, 2, 3))
    path[:, 0, 0] = 1.05 + np.abs(np.arange(90) - 69) * 0.01
    passing = Motion(scene_of(body("a", scale=whole), body("b", scale=whole)), trajectory_of(path))
    for name in ("gns", "dpi"):
        model = model_of(name)
        own = scene_particles(passing.scene, model.settings.sampling)
        futures = [[(own, poses_of(own, passing, range(2, 90, 3)))]]
        end, closest = model.point_gaps([passing], futures)
        limit = model.settings.contact_distance
        assert limit == pytest.approx(0.06)
        # Both cubes have points on the same places of their faces.
        assert end[0, 0] + limit == pytest.approx(0.25, abs=1e-6)
        assert closest[0, 0] + limit == pytest.approx(0.06, abs=1e-6)


@pytest.mark.nightly
@pytest.mark.slow
def test_surfaces_that_touch_have_points_within_the_fixed_distance() -> None:
    """Cubes, cylinders and spheres, turned at random and moved together until they touch."""
    rng, spacing = np.random.default_rng(0), 0.04
    scenes, right = [], 0
    for _ in range(60):
        shapes = rng.choice(["cube", "sphere", "cylinder"], 2)
        scale = tuple(float(v) for v in rng.uniform(0.2, 0.4, 3))
        bodies = [
            body(name, shape=str(s), scale=scale) for name, s in zip("ab", shapes, strict=True)
        ]
        scene = scene_of(*bodies)
        scenes.append(scene)
        own = scene_particles(scene, Sampling(spacing=spacing, limit=300))
        turns = rotation_from_vector(torch.from_numpy(rng.normal(size=(2, 3)))).numpy()[None]
        away = rng.normal(size=3)
        away /= np.linalg.norm(away)

        def at(apart: float, away=away, turns=turns) -> Poses:  # type: ignore[no-untyped-def]
            centers = np.stack([np.zeros(3), apart * away])[None]
            return Poses(centers, turns, np.zeros((1, 0, 3)))

        low, high = 0.0, 2.0
        while high - low > 1e-4:
            middle = (low + high) / 2
            touches = smallest_distance(scene, own, at(middle), spacing, 300) <= 0
            low, high = (middle, high) if touches else (low, middle)
        end = point_distances(scene, own, at(high), spacing, 300)[1]
        assert end <= 2 * spacing
        right += end <= CONTACT_SPACINGS * spacing
    assert right >= 0.9 * len(scenes)


def test_gaps_count_from_frame_44() -> None:
    """Unit cubes pass each other at 5 cm in frame 22; in frame 44 they are 2 m apart, and part."""
    path = np.zeros((45, 2, 3))
    path[:, 0, 0], path[:, 0, 1] = (np.arange(45) - 22) * 3 / 22, 1.05
    whole = (1.0, 1.0, 1.0)
    passing = Motion(scene_of(body("a", scale=whole), body("b", scale=whole)), trajectory_of(path))
    gap = silent("dpi").imagine(observed(passing), 1, 0).gap
    assert gap[0, 0] == pytest.approx(np.hypot(2.0, 0.05), abs=2e-3)


def test_an_observed_contact_is_a_yes() -> None:
    """The rule of the label holds in the observed part, whatever is imagined."""
    seen = next(
        own
        for own in (motion("collide", seed) for seed in range(60))
        if label_contact(own.scene, own.trajectory).observed
    )
    model = model_of("dpi")
    model.touch.fill_(-5.0)
    assert model.imagine(observed(seen), 1, 0).gap[0, 0] < -1, "below every fitted threshold"
    unseen = motion("collide", 3)
    assert model.imagine(observed(unseen), 1, 0).gap[0, 0] > 0


def test_imagined_particles_are_shown_on_demand(collide: Motion) -> None:
    model = model_of("dpi")
    batch = observed(collide, motion("drape", 1))
    assert not model.imagine(batch, 1, 0).shown
    shown = model.imagine(batch, 2, 0, show=1.0).shown
    positions, things = shown["particles"], shown["things"]
    assert positions.shape[:2] == (2, 2) and positions.shape[3] == things.shape[1]
    there = things >= 0
    assert np.isfinite(positions[0, 0, 0][there[0]]).all()
    assert np.isnan(positions[0, 0, 0][~there[0]]).all()


def test_calibration_finds_the_distance_that_separates(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a model that repeats the truth, 3 cm too far apart, the threshold lies between contacts
    and misses."""
    monkeypatch.setattr(
        "physion.models.particles.simulator.smallest_distance",
        lambda *of: smallest_distance(*of) + 0.03,
    )
    model = model_of("dpi", calibrated=True)
    motions = [motion("collide", seed, 150) for seed in range(8)]
    truth = {m.scene.name: m for m in motions}

    def futures(given, samples, seed):  # type: ignore[no-untyped-def]
        result = []
        for m in given:
            own = scene_particles(m.scene, model.settings.sampling)
            whole = truth[m.scene.name]
            result.append([(own, poses_of(own, whole, range(2, len(whole.trajectory), 3)))])
        return result

    model.futures = futures  # type: ignore[method-assign]
    model.settings = replace(model.settings, calibrated=False)
    model.calibrate(window(*motions))
    assert not model.touch.any(), "labels are not asked for"
    model.settings = replace(model.settings, calibrated=True)
    model.calibrate(window(*motions))
    assert model.touch[0] >= 0.03 and model.touch[1] == 0, "no cloth is among them"
    labels = [label_contact(m.scene, m.trajectory) for m in motions]
    batch = [m for m, label in zip(motions, labels, strict=True) if not label.observed]
    wanted = [label.contact for label in labels if not label.observed]
    assert len(set(wanted)) == 2, "both outcomes are among the trials"
    touches = model.imagine(observed(*batch), 1, 0).gap[:, 0] <= 0
    assert touches.tolist() == wanted


def test_weights_of_a_file_are_loaded_and_belong_to_a_model(tmp_path: Path) -> None:
    source = model_of("dpi", seed=3)
    path = tmp_path / "model.safetensors"
    write_checkpoint(path, tensors_of(source), {"built_as": source.built_as()})
    loaded = model_of("dpi", weights=str(path))
    assert loaded.trained and loaded.decision == "end" and loaded.init.startswith("local:")
    assert loaded.digest() == source.digest() != model_of("dpi").digest()
    with pytest.raises(BadInputError, match="model was dpi-small and is gns-small"):
        model_of("gns", weights=str(path))
    with pytest.raises(BadInputError, match="swept was True and is False"):
        model_of("dpi", weights=str(path), swept=False)
