"""Times of impact of moving hulls against known answers and against distances."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from physion.numerics.rotations import axis_angle_matrix
from physion.physics.rigid.bodies import collision_hulls, inscribed_radius
from physion.physics.rigid.collision.closest_points import CLOSE
from physion.physics.rigid.collision.pairs import new_pair_space
from physion.physics.rigid.collision.sweep import GAP_FRACTION, time_of_impact
from support.hull_pairs import box, hulls_of, random_hull, random_rotation, search

F64 = NDArray[np.float64]
UPRIGHT = np.eye(3)
MARGIN = 1e-4
GAP = GAP_FRACTION * MARGIN
"""Metres at which the hulls of these tests count as touching."""


def impact(
    a: F64, b: F64, shift: ArrayLike, motion: ArrayLike, rot: F64 = UPRIGHT, latest: float = 1.0
) -> tuple[float, F64]:
    """Return the time of impact of ``a``, at ``rot`` and ``shift``, with ``b``; and ``closest``."""
    space = new_pair_space()
    space.rot[:], space.shift[:] = rot, shift
    hulls = hulls_of(a, b, margin=MARGIN)
    time = time_of_impact(hulls, 0, 1, np.array(motion, np.float64), latest, space)
    return time, space.closest.copy()


def ball(radius: float) -> F64:
    """Return the corners of a hull like a ball, with one on every half axis."""
    ring = np.arange(16) * math.pi / 8
    bands = [
        np.stack([np.cos(t) * np.cos(ring), np.cos(t) * np.sin(ring), np.full(16, np.sin(t))], 1)
        for t in np.arange(-3, 4) * math.pi / 8
    ]
    return radius * np.concatenate([*bands, [[0.0, 0, 1], [0, 0, -1]]])


@pytest.mark.parametrize("speed", [2.0, 20.0, 200.0])
def test_ball_against_wall(speed: float) -> None:
    time, closest = impact(ball(0.1), box(0.05, 1, 1), [1.0, 0.2, 0.1], [-speed, 0, 0])
    way = 1.0 - 0.1 - 0.05
    assert time == pytest.approx(way / speed, abs=GAP / speed)
    assert time < way / speed
    assert closest[:3].tolist() == pytest.approx([1, 0, 0], abs=1e-9)
    assert closest[6:9].tolist() == pytest.approx([0.05, 0.2, 0.1], abs=1e-9)


def test_corner_of_a_tilted_box_along_a_slanted_way() -> None:
    # Standing on an edge, the box reaches sqrt(2) of its half side down.
    rot = axis_angle_matrix([1.0, 0, 0], math.pi / 4)
    reach = 0.1 * math.sqrt(2)
    time, closest = impact(box(0.1), box(1, 1, 0.5), [0, 0, 2.0], [0.3, 0.1, -4.0], rot)
    assert time == pytest.approx((2.0 - 0.5 - reach) / 4.0, abs=GAP)
    assert closest[:3].tolist() == pytest.approx([0, 0, 1], abs=1e-6)


def test_crossed_edges() -> None:
    below = box(0.5) @ axis_angle_matrix([1.0, 0, 0], math.pi / 4).T
    rot = axis_angle_matrix([0.0, 1.0, 0.0], math.pi / 4)
    height = 2 * math.sqrt(0.5)
    time, closest = impact(box(0.5), below, [0, 0, height + 1.0], [0, 0, -5.0], rot)
    assert time == pytest.approx(0.2, abs=GAP)
    assert closest[6:9].tolist() == pytest.approx([0, 0, math.sqrt(0.5)], abs=1e-6)


@pytest.mark.parametrize(
    ("shift", "motion"),
    [
        ([1.0, 0, 0], [0.5, 0, 0]),  # away
        ([1.0, 0, 0], [-0.79, 0, 0]),  # stops short of the wall
        ([1.0, 1.2, 0], [-3.0, 0, 0]),  # past it
        ([1.0, 0, 0], [0, 4.0, 0]),  # along it
        ([1.0, 0, 0], [0, 0, 0]),  # not at all
    ],
)
def test_no_impact(shift: list[float], motion: list[float]) -> None:
    time, _ = impact(box(0.1), box(0.1, 1, 1), shift, motion)
    assert time == np.inf


def test_later_hits_are_not_asked_for() -> None:
    shift, motion = [1.0, 0, 0], [-1.6, 0, 0]
    assert impact(box(0.1), box(0.1), shift, motion)[0] == pytest.approx(0.5, abs=GAP)
    assert impact(box(0.1), box(0.1), shift, motion, latest=0.51)[0] < 0.51
    assert impact(box(0.1), box(0.1), shift, motion, latest=0.49)[0] == np.inf


def test_overlap_at_the_start() -> None:
    time, closest = impact(box(0.1), box(0.1), [0.17, 0.01, 0], [-1, 0, 0])
    assert time == 0.0
    assert closest[:3].tolist() == pytest.approx([1, 0, 0], abs=1e-9)
    assert closest[9] == pytest.approx(0.03)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_nothing_is_touched_before_the_impact(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, rot = random_hull(rng, 0.05), random_hull(rng, 0.05), random_rotation(rng)
    shift = rng.normal(size=3) * 1.5
    motion = -shift * rng.uniform(0.5, 2.0) + rng.normal(size=3) * 0.3
    time, _ = impact(a, b, shift, motion, rot)
    if search(a, b, rot, shift).distance <= GAP:
        assert time == 0.0
        return
    before = np.linspace(0, min(time, 1.0), 40, endpoint=False)
    apart = [search(a, b, rot, shift + t * motion) for t in before]
    assert all(found.result == CLOSE and found.distance > GAP for found in apart)
    if time < np.inf:
        assert abs(search(a, b, rot, shift + time * motion).distance) <= GAP
    else:
        assert search(a, b, rot, shift + motion).distance > 0


def test_radius_of_the_ball_inside() -> None:
    piece = collision_hulls("cube", (1.0, 1.0, 1.0))[0]
    assert piece.inradius == pytest.approx(0.5)
    assert inscribed_radius(piece.corners * [1.0, 0.4, 2.0], piece.faces) == pytest.approx(0.2)
    # As PhysX: that of the unscaled hull, times the least scale.
    pyramid = collision_hulls("pyramid", (1.0, 1.0, 1.0))[0].inradius
    assert collision_hulls("pyramid", (0.3, 0.2, 4.0))[0].inradius == pytest.approx(0.2 * pyramid)
