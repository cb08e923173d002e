"""Objects as particles, and the rigid motions that fit them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from physion.clips.batch import Motion
from physion.core.errors import BadInputError
from physion.models.particles import bodies as particle_bodies
from physion.models.particles.bodies import (
    CLOTH,
    KINEMATIC,
    RIGID,
    Sampling,
    fit_rigid,
    fit_robust,
    mean_by,
    particle_positions,
    poses_of,
    rotation_from_vector,
    scene_particles,
    surface_points,
    vector_from_rotation,
)
from physion.models.particles.neighbours import gap_over_time, near_edges, swept_edges
from physion.numerics.rotations import rotate_vectors
from physion.scenes.scene import Cloth, Roles
from physion.scenes.shapes.meshes import Mesh
from physion.scenes.shapes.primitives import Shape, shapes
from support.rendered_scenes import body, scene_of, tumbling


def test_points_lie_on_the_box_with_its_corners_and_normals() -> None:
    points, normals = surface_points("cube", (0.4, 0.6, 0.8), 0.1, 10_000)
    low, high = points.min(axis=0), points.max(axis=0)
    assert np.allclose(high - low, (0.4, 0.6, 0.8))
    on = np.isclose(points, low) | np.isclose(points, high)
    assert on.any(axis=1).all(), "every point is on a face"
    assert (on.sum(axis=1) == 3).sum() == 8, "all corners are points"
    inside = on.sum(axis=1) == 1
    outward = np.where(np.isclose(points, high), 1.0, -1.0) * on
    assert np.allclose(normals[inside], outward[inside])
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in sorted(shapes.names()) if ":" not in n])
def test_points_cover_every_shape(name: str) -> None:
    """No point of the surface is farther than the spacing from a particle."""
    points, normals = surface_points(name, (0.3, 0.3, 0.3), 0.1, 10_000)
    fine, _ = surface_points(name, (0.3, 0.3, 0.3), 0.04, 10_000)
    assert cKDTree(points).query(fine)[0].max() <= 0.1 + 0.04
    assert len(points) == 1 or cKDTree(points).query(points, 2)[0][:, 1].min() >= 0.0999
    assert np.isfinite(normals).all()


def test_a_limit_thins_evenly() -> None:
    points, _ = surface_points("cube", (1.0, 1.0, 1.0), 0.02, 50)
    fine, _ = surface_points("cube", (1.0, 1.0, 1.0), 0.1, 10_000)
    assert len(points) == 50
    # 50 points on 6 m^2 are sqrt(.12) = .35 m apart in a square grid.
    assert cKDTree(points).query(fine)[0].max() < 0.35


@pytest.mark.parametrize(("spacing", "limit"), [(0.0, 5), (-1.0, 5), (np.nan, 5), (0.1, 0)])
def test_bad_spacings_and_limits_are_named(spacing: float, limit: int) -> None:
    with pytest.raises(BadInputError, match="spacing above 0 m and a limit of at least 1"):
        surface_points("cube", (1.0, 1.0, 1.0), spacing, limit)
    with pytest.raises(BadInputError, match="particles: the spacing"):
        Sampling(spacing=spacing, limit=limit)


def test_a_shape_without_faces_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = Mesh(np.eye(3), np.zeros((0, 3), np.int32))
    monkeypatch.setattr(particle_bodies, "shape", lambda name: Shape(name, mesh, ()))
    with pytest.raises(BadInputError, match="shape 'test:bare' has no faces"):
        surface_points("test:bare", (1.0, 1.0, 1.0), 0.1, 10)


def test_a_kinematic_body_has_a_limit_of_its_own() -> None:
    scene = scene_of(body("a"), body("b", kinematic=True), body("c", kinematic=True, scenery=True))
    sampling = Sampling(0.1, 20, 70)
    own = scene_particles(scene, sampling)
    assert own.kinds.tolist() == [RIGID, KINEMATIC] and np.bincount(own.owners).tolist() == [20, 70]
    swapped = scene_particles(scene, dataclasses.replace(sampling, limit=70, still_limit=20))
    assert np.bincount(swapped.owners).tolist() == [70, 20]


def test_a_scene_with_too_many_particles_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """All objects of a scene count, up to the number itself."""
    monkeypatch.setattr(particle_bodies, "MAX_PARTICLES", 10)
    scene = scene_of(body("a"), body("b", kinematic=True))
    assert len(scene_particles(scene, Sampling(limit=4, still_limit=6)).owners) == 10
    with pytest.raises(BadInputError, match="'test' has 11 particles, at most 10: use a larger"):
        scene_particles(scene, Sampling(limit=5, still_limit=6))


def test_kinds_scenery_and_absent_bodies() -> None:
    scene = scene_of(body("a"), body("b", kinematic=True), body("c", scenery=True), body("d"))
    own = scene_particles(scene, Sampling())
    assert own.things.tolist() == [0, 1, 3] and own.kinds.tolist() == [RIGID, KINEMATIC, RIGID]
    assert own.agent == 0
    without = scene_particles(scene, Sampling(), (False, True, True, True))
    assert without.things.tolist() == [1, 3] and without.agent == -1
    with pytest.raises(BadInputError, match="no object"):
        scene_particles(scene, Sampling(), (False,) * 4)


def test_a_scene_that_is_read_again_still_has_its_particles_and_another_of_its_name_others() -> (
    None
):
    scene = scene_of(body("a"), body("b"), body("c"))
    again = dataclasses.replace(scene)
    assert again is not scene and scene_particles(again, Sampling()) is scene_particles(
        scene, Sampling()
    )
    other = dataclasses.replace(scene, roles=Roles("b", "c"))
    found = scene_particles(other, Sampling())
    assert (found.agent, found.patient) == (1, 2)
    assert scene_particles(scene, Sampling()).agent != 1


def test_particles_move_with_their_bodies() -> None:
    scene, trajectory = tumbling()
    sampling = Sampling(0.1, 500, 500, cloth_step=1)
    own = scene_particles(scene, sampling)
    frames = range(len(trajectory))
    positions = particle_positions(own, poses_of(own, Motion(scene, trajectory), frames))
    for row in np.flatnonzero(own.kinds != CLOTH):
        mine, thing = positions[:, own.owners == row], own.things[row]
        at_rest = own.shape[own.owners == row] + own.pivots[row]
        turned = rotate_vectors(trajectory.rotations[:, thing, None].astype(np.float64), at_rest)
        assert np.allclose(mine, trajectory.positions[:, thing, None] + turned, atol=1e-5)
        apart = np.linalg.norm(mine[:, :1] - mine, axis=-1)
        assert np.allclose(apart, apart[:1], atol=1e-6), "a body stays rigid"


def test_a_cloth_is_a_grid_of_its_vertices() -> None:
    cloth = Cloth("sheet", (0.0, 0.0, 1.0), resolution=7)
    scene = dataclasses.replace(scene_of(body("a")), cloths=(cloth,))
    own = scene_particles(scene, Sampling(cloth_step=3))
    rows = own.owners == 1
    assert own.kinds[1] == CLOTH and rows.sum() == 9
    assert own.vertices.tolist() == [0, 3, 6, 21, 24, 27, 42, 45, 48]
    first = int(np.flatnonzero(rows)[0])
    middle = own.links[1][own.links[0] == first + 4] - first
    assert sorted(middle) == [0, 1, 2, 3, 5, 6, 7, 8], "sides and diagonals"


def test_a_motion_that_is_not_known_is_refused() -> None:
    scene, trajectory = tumbling()
    unknown = dataclasses.replace(trajectory, positions=np.full_like(trajectory.positions, np.nan))
    own = scene_particles(scene, Sampling())
    with pytest.raises(BadInputError, match="has no motion"):
        poses_of(own, Motion(scene, unknown), [0])


def test_roles_are_found_among_the_objects() -> None:
    scene = dataclasses.replace(scene_of(body("a"), body("b"), body("c")), roles=Roles("c", "b"))
    own = scene_particles(scene, Sampling())
    assert (own.agent, own.patient) == (2, 1)


# Rotations, rigid fits and robust fits against closed forms.


def vectors(scale: float) -> Tensor:
    rng = np.random.default_rng(3)
    return torch.from_numpy(scale * rng.normal(size=(40, 3)))


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-3, 0.1, 1.0])
def test_rotations_of_vectors_and_back(scale: float) -> None:
    given = vectors(scale)
    rotation = rotation_from_vector(given)
    expected = Rotation.from_rotvec(given.numpy())
    assert np.allclose(rotation.numpy(), expected.as_matrix(), atol=1e-12)
    back = vector_from_rotation(rotation).numpy()
    assert np.allclose(back, expected.as_rotvec(), atol=1e-7)


def test_gradients_at_rest_are_finite() -> None:
    given = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    (vector_from_rotation(rotation_from_vector(given)) * torch.arange(3.0)).sum().backward()
    assert given.grad is not None
    assert np.allclose(given.grad.numpy(), [[0, 1, 2]] * 2, atol=1e-6)


def bodies(seed: int, noise: float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(seed)
    owners = np.repeat([0, 1, 2], [30, 5, 12])
    shape = rng.normal(size=(47, 3))
    rotation = Rotation.random(3, random_state=seed).as_matrix()
    shift = rng.normal(size=(3, 3))
    points = np.einsum("pij,pj->pi", rotation[owners], shape) + shift[owners]
    points = points + noise * rng.normal(size=points.shape)
    return tuple(torch.from_numpy(v) for v in (shape, points, owners, rotation, shift))  # type: ignore[return-value]


def test_the_fit_finds_the_motion() -> None:
    shape, points, owners, rotation, shift = bodies(0, 0.0)
    found, moved = fit_rigid(shape, points, owners, 3)
    assert torch.allclose(found, rotation) and torch.allclose(moved, shift)
    # What is mirrored is rotated, too, as well as it can be.
    mirrored, _ = fit_rigid(shape, points * torch.tensor([1.0, 1.0, -1.0]), owners, 3)
    for rotations in (found, mirrored):
        assert torch.allclose(torch.det(rotations), torch.ones(3, dtype=torch.float64))


def test_no_other_motion_fits_better() -> None:
    shape, points, owners, _, _ = bodies(1, 0.2)
    found, moved = fit_rigid(shape, points, owners, 3)

    def error(rotation: Tensor, shift: Tensor) -> Tensor:
        put = (rotation[owners] @ shape[..., None])[..., 0] + shift[owners]
        return mean_by((put - points).pow(2).sum(-1), owners, 3)

    best = error(found, moved)
    for turn in vectors(0.01)[:10]:
        other = rotation_from_vector(turn) @ found
        assert (error(other, moved) > best).all() and (error(found, moved + turn) > best).all()


def test_the_robust_fit_ignores_outliers_and_says_which() -> None:
    shape, points, owners, rotation, shift = bodies(2, 0.0)
    spoilt = points.clone()
    wrong = [0, 3, 7, 20, 30, 40]
    spoilt[wrong] += torch.tensor([0.8, -0.5, 0.3], dtype=torch.float64)
    spoilt[7] = points[7] + torch.tensor([0.0, 0.0, 0.02], dtype=torch.float64)
    draws = torch.rand(16, 4, generator=torch.Generator().manual_seed(0))
    found, moved, inliers = fit_robust(shape, spoilt, owners, 3, 0.01, draws)
    assert torch.allclose(found, rotation) and torch.allclose(moved, shift)
    assert sorted(np.flatnonzero(~inliers.numpy())) == wrong
    plain, _ = fit_rigid(shape, spoilt, owners, 3)
    assert (plain - rotation).abs().max() > 0.01, "the fit to all particles is wrong"


def test_the_robust_fit_of_an_object_does_not_depend_on_the_others() -> None:
    shape, points, owners, _, _ = bodies(4, 0.05)
    draws = torch.rand(16, 4, generator=torch.Generator().manual_seed(0))
    together = fit_robust(shape, points, owners, 3, 0.05, draws)
    for number in range(3):
        own = owners == number
        alone = fit_robust(shape[own], points[own], 0 * owners[own], 1, 0.05, draws)
        assert torch.allclose(alone[0][0], together[0][number])
        assert torch.equal(alone[2], together[2][own])


@pytest.mark.parametrize("axis", [[1.0, 0, 0], [0, -1, 0], [0.6, 0, 0.8], [-0.48, 0.6, 0.64]])
@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-6, np.pi - 1e-3, 3.0])
def test_a_rotation_by_half_a_turn_is_found(axis: list[float], angle: float) -> None:
    given = torch.tensor([axis], dtype=torch.float64) * angle
    rotation = rotation_from_vector(given)
    again = rotation_from_vector(vector_from_rotation(rotation))
    assert (again - rotation).abs().max() < 1e-6


def test_one_particle_and_coincident_particles_give_a_rotation() -> None:
    shape = torch.zeros(4, 3, dtype=torch.float64)
    points = torch.ones(4, 3, dtype=torch.float64)
    found, moved = fit_rigid(shape, points, torch.tensor([0, 1, 1, 1]), 2)
    assert torch.allclose(found @ found.mT, torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
    assert torch.allclose(moved, torch.ones(2, 3, dtype=torch.float64))


# --- neighbours within a step -------------------------------------------------------------------


F64 = NDArray[np.float64]


def closest_by_samples(x: F64, u: F64, y: F64, v: F64) -> float:
    """Return the smallest distance of two moving points at 20001 moments."""
    s = np.linspace(0, 1, 20001)[:, None]
    return float(np.linalg.norm(y + s * v - x - s * u, axis=1).min())


def random_objects(seed: int) -> tuple[F64, F64, NDArray[np.int64], NDArray[np.int64]]:
    rng = np.random.default_rng(seed)
    counts = rng.integers(1, 8, 6)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    scene = np.array([0, 0, 0, 1, 1, 1], np.int64)
    points = rng.normal(size=(starts[-1], 3)) * 0.5
    steps = np.repeat(rng.normal(size=(6, 3)) * 0.4, counts, axis=0)
    return points, steps, starts, scene


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_swept_pairs_are_those_that_come_close(seed: int) -> None:
    points, steps, starts, scene = random_objects(seed)
    moves = np.array([True, False, False, True, True, False])
    receivers, senders = swept_edges(points, steps, starts, scene, moves, 0.2)
    owner = np.repeat(np.arange(6), np.diff(starts))
    expected = []
    for i in range(len(points)):
        for j in range(len(points)):
            a, b = owner[i], owner[j]
            distance = closest_by_samples(points[i], steps[i], points[j], steps[j])
            assert abs(distance - 0.2) > 1e-7, "no pair is undecided"
            pair = a != b and scene[a] == scene[b] and (moves[a] or moves[b])
            if pair and distance <= 0.2:
                expected.append((i, j))
    assert list(zip(receivers.tolist(), senders.tolist(), strict=True)) == sorted(expected)


def test_near_pairs_of_one_object_are_those_within_the_radius() -> None:
    rng = np.random.default_rng(0)
    points, starts = rng.normal(size=(300, 3)), np.array([0, 40, 40, 200, 300])
    owner, moves = np.repeat(np.arange(4), np.diff(starts)), np.array([True, True, True, False])
    receivers, senders = near_edges(points, starts, moves, 0.7)
    near = np.linalg.norm(points[:, None] - points, axis=-1) < 0.7
    near &= (owner[:, None] == owner) & moves[owner] & ~np.eye(300, dtype=bool)
    assert near.sum() > 100
    assert np.array_equal(np.stack([receivers, senders]), np.argwhere(near).T)


def test_a_fast_body_meets_what_it_passes() -> None:
    points = np.array([[0.0, 0, 0], [0.5, 0.05, 0]])
    steps = np.array([[1.0, 0, 0], [0, 0, 0]])
    starts, scene, moves = np.array([0, 1, 2]), np.zeros(2, np.int64), np.array([True, False])
    swept = swept_edges(points, steps, starts, scene, moves, 0.08)
    plain = swept_edges(points, 0 * steps, starts, scene, moves, 0.08)
    assert swept[0].tolist() == [0, 1] and swept[1].tolist() == [1, 0] and not len(plain[0])
    moving = np.stack([points, points + steps])
    assert gap_over_time(moving[:, :1], moving[:, 1:]) == pytest.approx(0.05)


@pytest.mark.parametrize("seed", range(2))
def test_the_gap_over_time_counts_the_time_between_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(5, 7, 3)), rng.normal(size=(5, 4, 3)) + 2
    expected = min(
        closest_by_samples(a[t, i], a[t + 1, i] - a[t, i], b[t, j], b[t + 1, j] - b[t, j])
        for t in range(4)
        for i in range(7)
        for j in range(4)
    )
    assert gap_over_time(a, b) == pytest.approx(expected, abs=1e-4)
    assert gap_over_time(a, b) <= np.linalg.norm(a[:, :, None] - b[:, None], axis=-1).min()
    assert gap_over_time(a[:1], b[:1]) == pytest.approx(
        np.linalg.norm(a[0, :, None] - b[0, None], axis=-1).min()
    )
