"""Rotations, rigid fits and robust fits against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from physion.models.particles.bodies import (
    fit_rigid,
    fit_robust,
    mean_by,
    rotation_from_vector,
    vector_from_rotation,
)


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
    assert torch.allclose(torch.det(found), torch.ones(3, dtype=torch.float64))


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
