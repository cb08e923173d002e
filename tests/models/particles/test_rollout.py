"""Distances of imagined bodies, rollouts, windows for training, and edges of graphs."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import torch

from physion import sample_scene
from physion.clips.batch import Motion
from physion.models.gaps import FAR, TOLERANCE
from physion.models.particles.bodies import (
    KINEMATIC,
    RIGID,
    Poses,
    Sampling,
    SceneParticles,
    rotation_from_vector,
    scene_particles,
    vector_from_rotation,
)
from physion.models.particles.networks import (
    EdgeMessages,
    Graph,
    ObjectState,
    SceneLayout,
    drift_of,
    join_poses,
    join_scenes,
    make_graph,
)
from physion.models.particles.rollout import (
    Start,
    Window,
    disturbed,
    disturbed_start,
    roll_out,
    rotated,
    smallest_distance,
    start_probabilities,
)
from physion.models.particles.simulator import observed_start
from physion.physics.engine import simulate
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import Cloth, Ending, Scene
from support.rendered_scenes import body, scene_of, trajectory_of


def poses(*centers: tuple[float, float, float], rows: int = 1) -> Poses:
    """Return a motion in which objects stay at their centres."""
    shape = (rows, len(centers), 3)
    rotations = np.broadcast_to(np.eye(3), (*shape, 3)).copy()
    where = np.broadcast_to(np.array(centers, float), shape).copy()
    return Poses(where, rotations, np.zeros((rows, 0, 3)))


def two_cubes() -> tuple[Scene, SceneParticles]:
    scene = scene_of(body("a", scale=(1.0, 1.0, 1.0)), body("b", scale=(1.0, 1.0, 1.0)))
    own = scene_particles(scene, Sampling())
    # Centres are those of the particles; here they are to be those of the cubes.
    middle = np.array([0.0, 0.0, 0.5])
    return scene, dataclasses.replace(own, pivots=np.stack([middle, middle]))


@pytest.mark.parametrize("apart", [-0.4, -0.1, 0.0, 0.05, 2.0])
def test_cubes_face_to_face(apart: float) -> None:
    scene, own = two_cubes()
    found = smallest_distance(scene, own, poses((0, 0, 0), (1 + apart, 0.2, 0.1)), 0.1, 100)
    assert found == pytest.approx(apart, abs=TOLERANCE)


def test_a_cube_that_flies_past_between_two_frames() -> None:
    scene, own = two_cubes()
    motion = poses((0, 0, 0), (0, 0, 0), rows=2)
    motion.centers[:, 1] = [[-4, 1.3, 0], [4, 1.3, 0]]
    assert smallest_distance(scene, own, motion, 0.1, 100) == pytest.approx(0.3, abs=TOLERANCE)
    motion.centers[:, 1] = [[-4, 0.3, 0], [4, 0.3, 0]]
    assert smallest_distance(scene, own, motion, 0.1, 100) <= 0


def test_a_corner_that_comes_closest_between_two_frames() -> None:
    """In the middle of a quarter turn the corner of a unit cube is sqrt(1/2) from its centre."""
    scene, own = two_cubes()
    motion = poses((0, 0, 0), (1.5, 0, 0), rows=2)
    motion.rotations[1, 1] = [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]
    found = smallest_distance(scene, own, motion, 0.1, 100)
    assert found == pytest.approx(1.0 - np.sqrt(0.5), abs=2 * TOLERANCE)


def test_an_absent_object_is_far() -> None:
    scene, _ = two_cubes()
    own = scene_particles(scene, Sampling(), (True, False))
    assert smallest_distance(scene, own, poses((0, 0, 0)), 0.1, 100) == FAR


def test_a_cloth_above_a_cube() -> None:
    cloth = Cloth("sheet", (0.0, 0.0, 1.0), size=(1.0, 1.0, 0.0), resolution=11)
    scene = scene_of(body("a", scale=(1.0, 1.0, 1.0)), cloths=[cloth])
    own = scene_particles(scene, Sampling(cloth_step=2))
    top = own.shape[own.owners == 0, 2].max()
    grid = np.linspace(-0.5, 0.5, 6)
    x, y = np.meshgrid(grid, grid, indexing="ij")
    sheet = np.stack([x, y, np.full_like(x, top + 0.3)], -1).reshape(1, -1, 3)
    motion = dataclasses.replace(poses((0, 0, 0), (0, 0, 1)), loose=sheet)
    found = smallest_distance(scene, own, motion, 0.05, 1000)
    assert 0.3 - 1e-9 <= found <= np.hypot(0.3, 0.05), "above points that are at most 0.05 m aside"


# Which windows of a trial particle models are trained on.

STRIDE, LENGTH, ABRUPT = 3, 4, 0.5
JUMP = 60
"""First frame after which a body moves with another velocity."""


@pytest.fixture(scope="module")
def calm() -> Trajectory:
    """Return a motion whose velocities are constant."""
    motion = simulate(sample_scene("collide", 3))
    still = np.zeros_like(motion.velocities)
    return replace(motion, velocities=still, angular_velocities=still.copy())


def test_without_contacts_all_starts_are_equally_frequent(calm: Trajectory) -> None:
    found = start_probabilities(calm, STRIDE, LENGTH, ABRUPT)
    assert len(found) == len(calm.positions) - (LENGTH - 1) * STRIDE
    assert np.ptp(found) == 0 and found.sum() == pytest.approx(1)


@pytest.mark.parametrize("spin", [False, True])
def test_a_jump_of_the_velocity_is_predicted_by_half_of_the_windows(
    calm: Trajectory, spin: bool
) -> None:
    """The jump lies within the predicted steps, frames 3 to 9 of a window."""
    name = "angular_velocities" if spin else "velocities"
    values = getattr(calm, name).copy()
    values[JUMP + 1 :, 0, 0] = 10.0
    found = start_probabilities(replace(calm, **{name: values}), STRIDE, LENGTH, ABRUPT)
    starts = np.arange(len(found))
    holds = (starts + STRIDE <= JUMP) & (starts + (LENGTH - 1) * STRIDE > JUMP)
    rest = (1 - ABRUPT) / len(found)
    np.testing.assert_allclose(found[~holds], rest)
    np.testing.assert_allclose(found[holds], rest + ABRUPT / holds.sum())


def test_what_only_gravity_does_is_not_abrupt(calm: Trajectory) -> None:
    falling = calm.velocities.copy()
    falling[:, 0, 2] = -9.81 * 0.01 * np.arange(len(falling))
    found = start_probabilities(replace(calm, velocities=falling), STRIDE, LENGTH, ABRUPT)
    assert np.ptp(found) == 0


def test_a_short_trial_has_one_start(calm: Trajectory) -> None:
    names = ("positions", "rotations", "velocities", "angular_velocities", "cloth_vertices")
    short = replace(calm, **{name: getattr(calm, name)[:5] for name in names},
                    cloth_distance=calm.cloth_distance[:5])  # fmt: skip
    assert start_probabilities(short, STRIDE, LENGTH, ABRUPT).tolist() == [1.0]


# Rollouts of a given step: when they end, and from which two states they start.

CPU = torch.device("cpu")


def start_of(speed: float, steps: int = 20) -> Start:
    """Return a body that moved along x by ``speed``, m/s, for a step of 0.03 s."""
    own = scene_particles(scene_of(body("a")), Sampling(limit=20))
    motion = poses((0.0, 0.0, 1.0), rows=2)
    motion.centers[1, 0, 0] = 0.03 * speed
    return Start(own, motion, steps)


def straight(layout: SceneLayout, before: ObjectState, now: ObjectState) -> ObjectState:
    return replace(now, centers=2 * now.centers - before.centers)


def test_scenes_are_moved_until_they_rest_or_their_time_is_over() -> None:
    """A scene is over when nothing moved at 7 mm/s for 0.24 s, which are 8 steps of 0.03 s, and
    before a step in which something moves by more than 10 m."""
    speeds = {1.0: 20, 0.0071: 20, 0.0069: 8, 0.0: 8, 330.0: 20, 340.0: 0}
    starts = [start_of(speed) for speed in speeds] + [start_of(1.0, steps=5), start_of(1.0, 0)]
    found = roll_out(starts, straight, CPU, 0.03)
    assert [len(motion.centers) for motion in found] == [*speeds.values(), 5, 0]
    steps = 1 + np.arange(1, 21)
    assert found[0].centers[:, 0, 0] == pytest.approx(0.03 * steps)


@pytest.mark.parametrize("stride", [1, 3])
def test_a_rollout_starts_from_the_last_two_observed_states(stride: int) -> None:
    """Frame 44 and the one a step before, and it ends with the last frame of the trial."""
    path = np.zeros((60, 1, 3))
    path[:, 0, 0] = 0.01 * np.arange(60) ** 2
    scene = replace(scene_of(body("a")), ending=Ending(60, 60))
    frames = range(44 % stride, 45, stride)
    start = observed_start(Motion(scene, trajectory_of(path)), frames, Sampling())
    places = start.poses.centers[-2:, 0, 0] - start.particles.pivots[0, 0]
    assert places == pytest.approx([0.01 * (44 - stride) ** 2, 0.01 * 44**2])
    assert start.steps == 15 // stride


def test_futures_have_noise_of_the_stated_size_on_their_velocities() -> None:
    start = start_of(1.0)
    moved, turned = [], []
    for seed in range(400):
        noisy = disturbed_start(start, 0.003, np.random.default_rng(seed)).poses
        assert np.array_equal(noisy.centers[1], start.poses.centers[1])
        moved.append(noisy.centers[0, 0] - start.poses.centers[0, 0])
        turned.append(vector_from_rotation(torch.from_numpy(noisy.rotations[0, 0])).numpy())
    assert np.std(moved, axis=0) == pytest.approx(np.full(3, 0.003), rel=0.15)
    rim = np.array(turned) * start.particles.sizes[0]
    assert rim.std(axis=0) == pytest.approx(np.full(3, 0.003), rel=0.15)


# Windows for training: noise of the first state, and rotation of the scene.


def many_windows(velocity: float, spin: float, count: int = 600) -> Window:
    """Return windows of a scene with a moving and a kinematic body."""
    scene = scene_of(body("a"), body("b", kinematic=True))
    layout = join_scenes([scene_particles(scene, Sampling(limit=20))] * count, CPU)
    now = join_poses([poses((0.0, 0.0, 1.0), (2.0, 0.0, 0.0), rows=1)] * count, 0, CPU)
    centers, turns = now.centers.clone(), torch.zeros_like(now.centers)
    free = layout.kinds == RIGID
    centers[free, 0] -= velocity
    turns[free, 2] = -spin
    return Window(
        layout, replace(now, centers=centers, rotations=rotation_from_vector(turns)), now, (now,)
    )


def test_noise_of_a_window_has_the_stated_size() -> None:
    """sqrt(0.003^2 + (0.1 (0.04 + 0.05 r))^2) by axis, r the size of the body, rim and centre."""
    window = many_windows(0.04, 0.05)
    free = window.layout.kinds == RIGID
    size = window.layout.size[free]
    expected = float((0.003**2 + (0.1 * (0.04 + 0.05 * size[0])) ** 2).sqrt())
    torch.manual_seed(0)
    noisy = disturbed(window, 0.003, 0.1)
    moved = (noisy.before.centers - window.before.centers)[free]
    turn = noisy.before.rotations @ window.before.rotations.mT
    rim = vector_from_rotation(turn)[free] * size[:, None]
    for values in (moved, rim):
        assert values.std(0).numpy() == pytest.approx(np.full(3, expected), rel=0.15)
    assert abs(np.corrcoef(moved[:, 0], rim[:, 0])[0, 1]) < 0.15
    still = ~free
    assert torch.equal(noisy.before.centers[still], window.before.centers[still])
    assert torch.equal(turn[still], torch.eye(3, dtype=turn.dtype).expand_as(turn[still]))
    assert noisy.now is window.now and noisy.later is window.later


def test_windows_are_rotated_about_the_vertical_by_any_angle() -> None:
    window = many_windows(0.04, 0.0)
    torch.manual_seed(0)
    turned = rotated(window)
    still = window.layout.kinds == KINEMATIC
    places = turned.now.centers[still]
    assert places[:, 2].abs().max() == 0
    assert places.norm(dim=-1).numpy() == pytest.approx(2.0)
    angles = torch.atan2(places[:, 1], places[:, 0])
    assert torch.histc(angles, 4, -np.pi, np.pi).min() > 0.7 * len(angles) / 4
    # All states turn together: the velocity keeps its angle to the other body.
    velocity = (turned.now.centers - turned.before.centers)[~still]
    along = (velocity * places).sum(-1) / 2.0
    assert along.numpy() == pytest.approx(0.04)


# Edges: what they know of two particles, and which node receives.


@pytest.mark.parametrize(
    ("speed", "moment", "closest"),
    [
        (-0.3, 0.5, (0.0, 0.06)),  # they pass each other in the middle of the step
        (-0.1, 1.0, (0.05, 0.06)),  # and come closest at its end
        (0.3, 0.0, (0.15, 0.06)),  # or part
    ],
)
def test_edges_know_the_closest_approach(
    speed: float, moment: float, closest: tuple[float, float]
) -> None:
    """Two particles, the second at (.15, .06) from the first and moving along x."""
    radius, unit = 0.2, 0.02
    own = scene_particles(scene_of(body("a"), body("b")), Sampling(limit=1))
    layout = join_scenes([own], CPU)
    motion = poses((0.0, 0.0, 1.0), (0.15, 0.06, 1.0))
    motion.rotations[:, 1] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    now = join_poses([motion], 0, CPU)
    before = replace(now, centers=now.centers - torch.tensor([[0.0] * 3, [speed, 0.0, 0.0]]))
    graph = make_graph(layout, drift_of(layout, before, now), radius, unit, swept=True)
    assert (graph.receivers.tolist(), graph.senders.tolist()) == ([0, 1], [1, 0])
    for edge, sign in zip(graph.edges, (1, -1), strict=True):
        apart, near = np.array([0.15, 0.06, 0.0]), np.array([*closest, 0.0])
        expected = [
            *(sign * apart / radius), np.linalg.norm(apart) / radius,
            sign * speed / unit, 0.0, 0.0,
            *(sign * near / radius), np.linalg.norm(near) / radius,
        ]  # fmt: skip
        assert edge[:11].tolist() == pytest.approx(expected, abs=1e-5)
        assert edge[15:].tolist() == [pytest.approx(moment), 0.0]
    # Normals are those of the receiver and of the sender: the edge lies along them by so much.
    normals = drift_of(layout, before, now).normals
    along = [*(normals @ now.centers.diff(dim=0)[0] / radius)]
    assert graph.edges[0, 11:13].tolist() == pytest.approx([float(v) for v in along], abs=1e-5)
    assert graph.edges[1, 11:13].tolist() == pytest.approx(
        [-float(v) for v in reversed(along)], abs=1e-5
    )


def test_messages_are_summed_at_the_receiver() -> None:
    torch.manual_seed(0)
    messages, nodes, edges = EdgeMessages(4), torch.randn(3, 4), torch.randn(4, 4)
    receivers, senders = torch.tensor([0, 0, 2, 2]), torch.tensor([1, 2, 1, 0])
    empty = torch.zeros(0)
    graph = Graph(3, empty, receivers, senders, empty, nodes, edges, empty, empty)
    with torch.no_grad():
        expected = torch.zeros(3, 4)
        for edge, (i, j) in enumerate(zip(receivers, senders, strict=True)):
            inner = messages.edge(edges[edge]) + messages.receiver(nodes[i])
            inner = inner + messages.sender(nodes[j])
            expected[i] += messages.out(torch.relu(inner))
        found = messages(nodes, edges, graph)
    assert torch.allclose(found, expected, atol=1e-6) and not found[1].any()
