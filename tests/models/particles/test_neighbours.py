"""Neighbours within a step, compared with all pairs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from physion.models.particles.neighbours import gap_over_time, near_edges, swept_edges

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
