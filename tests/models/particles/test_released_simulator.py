"""Simulators of the size ``released``: training, rollouts and decision of the published code."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist, pdist
from torch import Tensor, nn

from physion import sample_scene
from physion.clips.batch import Batch, Motion, cut_to_observed
from physion.core.errors import BadInputError
from physion.models.baselines.motion import FAR
from physion.models.build import build_model
from physion.models.particles.bodies import (
    CLOTH,
    FREE,
    Poses,
    SceneParticles,
    particle_positions,
    poses_of,
    scene_particles,
)
from physion.models.particles.config import ParticleOptions
from physion.models.particles.released import ReleasedGraph, simulator
from physion.models.particles.released.config import released_config
from physion.models.particles.released.contact import contact_distance, particle_distance
from physion.models.particles.released.simulator import ReleasedSimulator
from physion.physics.engine import simulate
from physion.readout.rollout_error import motion_error

NAMES = ("gns", "gns-ransac", "dpi")


class ConstantVelocity(nn.Module):
    """Network that predicts the velocities it gets, and keeps the graphs."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1))
        self.graphs: list[ReleasedGraph] = []

    def forward(self, graph: ReleasedGraph) -> Tensor:
        self.graphs.append(graph)
        return self.weight * graph.velocities


def tiny(name: str, limit: int = 60) -> ReleasedSimulator:
    """Return a model with few particles and a narrow network."""
    keep_rigid = name == "gns-ransac"
    config = released_config("objects" if name == "dpi" else "messages", keep_rigid=keep_rigid)
    particles = dataclasses.replace(
        config.particles, limit=limit, still_limit=limit, cloth_step=8, spacing=0.1
    )
    config = dataclasses.replace(
        config, particles=particles, width=16, rounds=2, rollout_limit=limit, radius=0.15
    )
    return ReleasedSimulator(name, config, ParticleOptions(size="released"))


def motion(scenario: str, seed: int) -> Motion:
    scene = sample_scene(scenario, seed)
    return Motion(scene, simulate(scene))


@pytest.fixture(scope="module")
def collide() -> Motion:
    return motion("collide", 3)


@pytest.fixture(scope="module")
def drape() -> Motion:
    return motion("drape", 1)


def batch_of(frames: range, *motions: Motion) -> Batch:
    rows = np.array([list(frames)] * len(motions))
    names = tuple(m.scene.name for m in motions)
    return Batch(names, rows, np.ones_like(rows, np.bool_), state=motions)


def window(*motions: Motion) -> Batch:
    return batch_of(range(60, 69, 3), *motions)


def observed(*motions: Motion) -> Batch:
    cut = [Motion(m.scene, cut_to_observed(m.scene, m.trajectory)) for m in motions]
    return batch_of(range(2, 45, 3), *cut)


def future(model: ReleasedSimulator, *motions: Motion) -> tuple[SceneParticles, Poses]:
    """Return particles and motion of the first of some trials."""
    return model.futures(observed(*motions).state or (), 1, 0)[0][0]


@pytest.mark.parametrize(
    ("name", "weights"), [("gns", 532_603), ("gns-ransac", 532_603), ("dpi", 1_978_810)]
)
def test_the_published_network_and_settings(name: str, weights: int) -> None:
    model = build_model(name, size="released")
    assert isinstance(model, ReleasedSimulator)
    assert model.provenance().model == f"{name}-released" and model.decision == "touch"
    assert sum(value.numel() for value in model.parameters()) == weights
    settings = model.training_settings
    assert (settings.batch, settings.accumulate, settings.learning_rate) == (1, 2, 1e-4)
    assert settings.schedule == "plateau" and model.diet == "states" and model.window == 3
    assert model.config.keep_rigid == (name == "gns-ransac")


def test_digests_tell_forms_and_weights_apart() -> None:
    models = [build_model("gns", size=size) for size in ("small", "released")]
    models += [build_model("gns-ransac", size="released"), build_model("dpi", size="released")]
    models += [build_model("gns", size="released", seed=1)]
    assert len({model.digest() for model in models}) == len(models)
    assert build_model("dpi", size="released").digest() == models[3].digest()


@pytest.mark.parametrize("name", ["gns", "dpi"])
def test_the_loss_of_one_window_falls(name: str, collide: Motion, drape: Motion) -> None:
    model = tiny(name)
    batch = window(collide, drape)
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    torch.manual_seed(0)
    losses = []
    for _ in range(80):
        optimizer.zero_grad()
        loss = model.loss(batch)["loss"]
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.3 * losses[0]


def test_inputs_and_label_of_the_training(collide: Motion) -> None:
    """Velocities are differences over 0.03 s; without noise constant velocity is the baseline."""
    model = tiny("gns")
    model.network = ConstantVelocity()
    model.config = dataclasses.replace(model.config, velocity_noise=0.0)
    batch = window(collide)
    assert float(model.loss(batch)["loss"].detach()) == pytest.approx(float(model.baseline(batch)))
    (graph,) = model.network.graphs
    own = scene_particles(collide.scene, model.config.particles)
    places = particle_positions(own, poses_of(own, collide, [60, 63, 66]))
    assert np.allclose(graph.positions, places[1], atol=1e-5)
    assert np.allclose(graph.velocities, (places[1] - places[0]) / 0.03, atol=1e-4)
    squares = ((places[2] - 2 * places[1] + places[0]) / 0.03) ** 2
    assert float(model.baseline(batch)) == pytest.approx(squares.mean(), rel=1e-4)
    assert squares.mean() > 0


def test_noise_is_one_vector_for_a_window(collide: Motion) -> None:
    """A drift of all particles of a scene, which moves them by a step too; the label is clean."""
    model = tiny("gns")
    model.network = ConstantVelocity()
    batch = window(collide, motion("roll", 2))
    quiet = dataclasses.replace(model.config, velocity_noise=0.0)
    loud = dataclasses.replace(model.config, velocity_noise=0.3)
    torch.manual_seed(1)
    graphs = []
    for config in [quiet] + 100 * [loud]:
        model.config = config
        model.loss(batch)
        graphs.append(model.network.graphs.pop())
    clean, *noisy = graphs
    drifts = [graph.velocities - clean.velocities for graph in noisy]
    for graph, drift in zip(noisy[:3], drifts, strict=False):
        assert len(torch.unique(drift.round(decimals=3), dim=0)) == 2, "a vector for each scene"
        assert torch.allclose(graph.positions - clean.positions, drift * 0.03, atol=1e-5)
    vectors = torch.stack([drift[[0, -1]] for drift in drifts])
    assert float(vectors.std()) == pytest.approx(0.3 / 2**0.5, rel=0.15)
    assert abs(float(vectors.mean())) < 0.05


@pytest.mark.parametrize("name", NAMES)
def test_rollouts_are_finite(name: str, collide: Motion, drape: Motion) -> None:
    model = tiny(name)
    rollout = model.imagine(observed(collide, drape), 1, 0, show=1.0)
    assert np.isfinite(rollout.gap).all() and rollout.gap.shape == (2, 1)
    shown = rollout.shown["particles"]
    assert shown.shape[2] <= 40, "55 steps, 15 of them observed"
    there = rollout.shown["things"] >= 0
    assert np.isfinite(shown[0, 0, 0][there[0]]).all()


def shapes(particles: SceneParticles, poses: Poses) -> list[float]:
    """Return for every body how much distances between its particles change after frame 44."""
    changes = []
    for row in np.flatnonzero(particles.kinds == FREE):
        own = poses.loose[:, particles.owners[particles.loose] == row]
        changes.append(float(np.abs(pdist(own[-1]) - pdist(own[14])).max()))
    return changes


def test_gns_deforms_bodies_and_the_fit_keeps_them_rigid(collide: Motion) -> None:
    free = shapes(*future(tiny("gns"), collide))
    rigid = shapes(*future(tiny("gns-ransac"), collide))
    assert max(free) > 1e-3 and max(rigid) < 1e-6


def test_kinematic_bodies_are_predicted_too(collide: Motion) -> None:
    particles, poses = future(tiny("gns"), collide)
    assert collide.scene.bodies[int(particles.things[particles.patient])].kinematic
    own = particles.owners == particles.patient
    assert np.abs(poses.loose[-1, own] - poses.loose[14, own]).max() > 1e-4


def test_constant_velocity_goes_straight_on(drape: Motion) -> None:
    """Also where coordinates are enlarged: what comes back is in metres."""
    model = tiny("gns")
    model.network = ConstantVelocity()
    particles, poses = future(model, drape)
    steps = np.arange(1, len(poses.loose) - 14)[:, None, None]
    expected = poses.loose[14] + steps * (poses.loose[14] - poses.loose[13])
    assert len(steps) > 5 and np.allclose(poses.loose[15:], expected, atol=1e-4)
    assert (particles.kinds == CLOTH).any()
    graph = model.network.graphs[0]
    size = (graph.positions.amax(0) - graph.positions.amin(0)).numpy()
    assert np.allclose(size, np.ptp(poses.loose[14], axis=0) * 0.05 / 0.035, atol=1e-4)
    assert graph.rigid.tolist() == (particles.kinds != CLOTH).tolist()


def test_the_error_of_the_motion_counts_what_can_move(drape: Motion) -> None:
    """Not the kinematic bodies, though they are predicted; constant velocity has its own error."""
    model = tiny("gns")
    model.network = ConstantVelocity()
    particles, poses = future(model, drape)
    rows = motion_error(drape, particles, poses, 3, 9)
    assert rows["Error"].to_list() == pytest.approx(rows["Constant Velocity Error"], abs=1e-5)
    assert (rows["Error"] > 1e-4).all()
    still = next(row for row, body in enumerate(drape.scene.bodies) if body.kinematic)
    poses.centers[:, np.flatnonzero(particles.things == still)] += 9.0
    assert motion_error(drape, particles, poses, 3, 9).equals(rows)


@pytest.mark.parametrize("name", NAMES)
def test_scenes_in_one_graph_do_not_touch_each_other(
    name: str, collide: Motion, drape: Motion
) -> None:
    model = tiny(name)
    _, alone = future(model, collide)
    _, together = future(model, collide, drape)
    assert np.allclose(alone.loose[:20], together.loose[:20], atol=1e-4)


def test_scenes_beyond_the_limit_go_in_parts(
    collide: Motion, drape: Motion, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tiny("dpi")
    whole = model.imagine(observed(collide, drape), 1, 0).gap
    monkeypatch.setattr(simulator, "PARTICLES_AT_ONCE", 10)
    assert np.allclose(model.imagine(observed(collide, drape), 1, 0).gap, whole, atol=1e-3)


@pytest.mark.parametrize("scenario", ["collide", "drape"])
@pytest.mark.parametrize("name", NAMES)
def test_what_follows_the_observed_part_is_not_seen(
    name: str,
    scenario: str,
    poisoned: Callable[[Motion], Motion],
    request: pytest.FixtureRequest,
) -> None:
    model = tiny(name)
    clean: Motion = request.getfixturevalue(scenario)
    changed = poisoned(clean)

    def imagined(batch: Batch) -> bytes:
        rollout = model.imagine(batch, 2, 5, show=1.0)
        shown = rollout.shown["particles"]
        assert shown.shape[2] > 0 and np.isfinite(shown).all(), "something is imagined"
        return rollout.gap.tobytes() + shown.tobytes()

    found = imagined(observed(clean))
    assert found == imagined(observed(changed)) == imagined(batch_of(range(2, 45, 3), changed))
    model.network = ConstantVelocity()
    assert found != imagined(observed(clean)), "the network moves something"


def test_contact_is_decided_by_particles_at_the_steps(collide: Motion) -> None:
    model = tiny("gns")
    particles, poses = future(model, collide)
    own = [poses.loose[:, particles.owners == row] for row in (particles.agent, particles.patient)]
    expected = min(cdist(a, b).min() for a, b in zip(*own, strict=True))
    assert particle_distance(particles, poses) == pytest.approx(min(expected, FAR))
    gap = model.imagine(observed(collide), 1, 0).gap
    assert gap[0, 0] == pytest.approx(expected - 0.075)
    absent = dataclasses.replace(particles, agent=-1)
    assert particle_distance(absent, poses) == FAR


def test_published_distances_of_contact(collide: Motion, drape: Motion) -> None:
    """In Drape 0.17465 m where coordinates are enlarged."""
    assert contact_distance(collide.scene) == 0.075
    assert contact_distance(drape.scene) * 0.05 / 0.035 == pytest.approx(0.17465, abs=1e-5)
    for scenario in ("contain", "drop"):
        assert contact_distance(sample_scene(scenario, 0)) == 0.05


def test_rollouts_have_fewer_particles_than_the_training(collide: Motion) -> None:
    model = tiny("gns")
    model.config = dataclasses.replace(model.config, rollout_limit=5)
    particles, _ = future(model, collide)
    assert np.bincount(particles.owners).max() == 5
    model.network = ConstantVelocity()
    model.loss(window(collide))
    assert int(torch.bincount(model.network.graphs[0].owners).max()) > 5


def test_particles_that_fall_together_are_an_error(
    collide: Motion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulator, "MAX_EDGES", 10)
    with pytest.raises(BadInputError, match="they fell together; train longer"):
        tiny("gns").loss(window(collide))


def test_no_released_weights_are_shipped() -> None:
    with pytest.raises(BadInputError, match="shipped for size=small"):
        build_model("gns", size="released", weights="shipped")
