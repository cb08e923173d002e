"""Neighbours within a step, on the CPU and by the cell list, compared with all pairs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from physion.core import seeds
from physion.core.errors import BadInputError
from physion.models.particles import neighbours as cell_list
from physion.models.particles.neighbours import gap_over_time, swept_edges, swept_edges_on_device

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


@pytest.mark.parametrize("seed", range(8))
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


def test_a_fast_body_meets_what_it_passes() -> None:
    points = np.array([[0.0, 0, 0], [0.5, 0.05, 0]])
    steps = np.array([[1.0, 0, 0], [0, 0, 0]])
    starts, scene, moves = np.array([0, 1, 2]), np.zeros(2, np.int64), np.array([True, False])
    swept = swept_edges(points, steps, starts, scene, moves, 0.08)
    plain = swept_edges(points, 0 * steps, starts, scene, moves, 0.08)
    assert swept[0].tolist() == [0, 1] and swept[1].tolist() == [1, 0] and not len(plain[0])
    moving = np.stack([points, points + steps])
    assert gap_over_time(moving[:, :1], moving[:, 1:]) == pytest.approx(0.05)


@pytest.mark.parametrize("seed", range(4))
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


# Cell list: the pairs are those of a search among all pairs.

RADIUS = 0.08


def radius_edges(points: Tensor, scene: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Return the pairs of particles that do not move."""
    return swept_edges_on_device(points, torch.zeros_like(points), scene, radius)


def random_points(seed: str, count: int, size: float, scenes: int = 3) -> tuple[Tensor, Tensor]:
    """Return points in a cube, at least 2 of them the same, and their scenes without order."""
    rng = seeds.generator("cell list", seed)
    points = rng.uniform(-size / 2, size / 2, (count, 3))
    scene = rng.integers(0, scenes, count)
    points[1::20], scene[1::20] = points[::20][: len(points[1::20])], scene[0]
    points[::20], scene[::20] = points[0], scene[0]
    return torch.tensor(points), torch.tensor(scene)


def all_swept(points: Tensor, moves: Tensor, scene: Tensor, radius: float) -> list[list[int]]:
    """Return receivers and senders by the definition, for all pairs."""
    d, w = points[None] - points[:, None], moves[None] - moves[:, None]
    # The squared distance |d + s w|^2 is a parabola in s: its minimum is at an end, or within.
    at_rest = (w * w).sum(2) == 0
    s = -(d * w).sum(2) / torch.where(at_rest, 1.0, (w * w).sum(2))
    closest = torch.minimum(d.norm(dim=2), (d + w).norm(dim=2))
    within = (d + s[..., None] * w).norm(dim=2)
    closest = torch.where((s > 0) & (s < 1) & ~at_rest, torch.minimum(closest, within), closest)
    close = (closest <= radius) & (scene[None] == scene[:, None])
    return close.fill_diagonal_(False).nonzero().T.tolist()


def listed(edges: tuple[Tensor, Tensor]) -> list[list[int]]:
    return [part.tolist() for part in edges]


@pytest.mark.parametrize(("count", "size"), [(2, 0.1), (60, 0.2), (400, 0.6), (400, 50.0)])
def test_radius_pairs_match_all_pairs(count: int, size: float) -> None:
    points, scene = random_points(f"{count} {size}", count, size)
    edges = listed(radius_edges(points, scene, RADIUS))
    assert edges == all_swept(points, torch.zeros_like(points), scene, RADIUS)


@pytest.mark.parametrize("speed", [0.0, 0.1, 1.0, 4.0, 30.0, 3000.0])
@pytest.mark.parametrize("fast", [0.05, 1.0])
def test_swept_pairs_match_all_pairs(speed: float, fast: float) -> None:
    """Displacements from 0 to 3000 radii, of few particles or of all."""
    points, scene = random_points(f"swept {speed} {fast}", 300, 0.5)
    rng = seeds.generator("displacements", str(speed), str(fast))
    moves = torch.tensor(rng.normal(size=points.shape)) * speed * RADIUS
    moves[torch.tensor(rng.random(len(points)) >= fast)] *= 0.02
    moves[0] = moves[20]
    edges = listed(swept_edges_on_device(points, moves, scene, RADIUS))
    assert edges == all_swept(points, moves, scene, RADIUS)
    plain = listed(radius_edges(points, scene, RADIUS))
    assert set(zip(*plain, strict=True)) <= set(zip(*edges, strict=True))


def test_blocks_of_pairs_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    points, scene = random_points("blocks", 300, 0.4)
    moves = points.flip(0) / 5
    whole = listed(radius_edges(points, scene, RADIUS))
    swept = listed(swept_edges_on_device(points, moves, scene, RADIUS))
    monkeypatch.setattr(cell_list, "CANDIDATES_AT_ONCE", 50)
    assert listed(radius_edges(points, scene, RADIUS)) == whole
    assert listed(swept_edges_on_device(points, moves, scene, RADIUS)) == swept


def test_pairs_at_exactly_the_radius_count() -> None:
    """On a grid whose step is the radius, where rounding decides in which cube a point lies."""
    grid = np.stack(np.meshgrid(*[np.arange(7) * 0.25 - 1e3] * 3), -1).reshape(-1, 3)
    points, scene = torch.tensor(grid), torch.zeros(len(grid), dtype=torch.int64)
    receivers, _ = radius_edges(points, scene, 0.25)
    assert len(receivers) == 2 * 3 * 7 * 7 * 6


def test_all_particles_in_one_point_are_neighbours() -> None:
    points, scene = torch.zeros(40, 3), torch.zeros(40, dtype=torch.int64)
    for edges in (
        radius_edges(points, scene, RADIUS),
        swept_edges_on_device(points, points + 9, scene, RADIUS),
    ):
        assert len(edges[0]) == 40 * 39


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_particles_have_no_neighbours(count: int) -> None:
    points, scene = torch.zeros(count, 3), torch.zeros(count, dtype=torch.int64)
    assert listed(radius_edges(points, scene, RADIUS)) == [[], []]
    assert listed(swept_edges_on_device(points, points + 1, scene, RADIUS)) == [[], []]


def test_far_particles_do_not_overflow() -> None:
    """The number of cubes between particles at opposite ends of space does not fit in 64 bits."""
    points = torch.tensor([[-9e8] * 3, [9e8] * 3, [9e8] * 3], dtype=torch.float64)
    edges = radius_edges(points, torch.tensor([0, 0, 0]), 1e-3)
    assert listed(edges) == [[1, 2], [2, 1]]


@pytest.mark.parametrize(
    ("points", "radius", "message"),
    [
        (torch.tensor([[0.0, 0, torch.nan]]), 0.1, "diverged"),
        (torch.tensor([[0.0, 0, torch.inf]]), 0.1, "diverged"),
        (torch.zeros(1, 3), 0.0, "radius above 0"),
        (torch.zeros(2, 3), 0.1, "the scene of each"),
    ],
)
def test_bad_input_is_refused(points: Tensor, radius: float, message: str) -> None:
    scene = torch.zeros(1, dtype=torch.int64)
    with pytest.raises(BadInputError, match=message):
        radius_edges(points, scene, radius)
    with pytest.raises(BadInputError, match=message):
        swept_edges_on_device(torch.zeros(1, 3), points, scene, radius)
