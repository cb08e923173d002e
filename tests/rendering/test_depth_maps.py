"""Lookups into shadow and occlusion maps with known answers: none, all, half."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from physion.rendering.rasterizer import (
    BLOCK,
    OCCLUSION_REACH,
    DepthMap,
    lit_fraction,
    occluded_fraction,
)

SIZE = 4 * BLOCK
WINDOW = 5
"""Texels along the side of the window of a shadow lookup."""


def depth_map(depth: NDArray[np.float64] | float, occupied: bool = True) -> DepthMap:
    """Return a map whose texel coordinates and depth are the world's x, y and z."""
    matrix = np.eye(3, 4)
    texels = np.array(np.broadcast_to(depth, (SIZE, SIZE)), np.float32)
    return DepthMap(matrix, texels, np.full((4, 4), occupied))


def half_blocked(column: int, depth: float = 0.0) -> DepthMap:
    """Return a map with something at this depth in all texels left of ``column``."""
    return depth_map(np.where(np.arange(SIZE) < column, depth, np.inf))


def test_a_point_in_the_open_is_lit() -> None:
    assert lit_fraction(depth_map(np.inf), 15.3, 16.8, 1.0) == 1.0


def test_a_point_behind_something_is_dark_and_one_before_it_is_lit() -> None:
    assert lit_fraction(depth_map(0.5), 15.3, 16.8, 1.0) == 0.0
    assert lit_fraction(depth_map(0.5), 15.3, 16.8, 0.4) == 1.0


@pytest.mark.parametrize("y", [14.0, 16.8])
@pytest.mark.parametrize("shift", [0.0, 0.3, -0.4, 1.0, -2.0, 2.5, -2.5, 7.0])
def test_across_an_edge_the_lit_fraction_is_linear(shift: float, y: float) -> None:
    expected = np.clip(0.5 + shift / WINDOW, 0.0, 1.0)
    assert lit_fraction(half_blocked(16), 16 + shift, y, 1.0) == pytest.approx(expected)


def test_outside_the_map_and_in_empty_blocks_everything_is_lit() -> None:
    for x, y in ((-1.0, 16.0), (1.0, 16.0), (16.0, SIZE - 1.0), (16.0, 1e9)):
        assert lit_fraction(depth_map(0.0), x, y, 1.0) == 1.0
    assert lit_fraction(depth_map(0.0, occupied=False), 16.0, 16.0, 1.0) == 1.0


@pytest.mark.parametrize(
    ("gap", "expected"),
    [
        (0.0, 1.0),
        (0.25 * OCCLUSION_REACH, 0.75),
        (0.5 * OCCLUSION_REACH, 0.5),
        (1.1 * OCCLUSION_REACH, 0.0),
        (-0.1, 0.0),
        (np.inf, 0.0),
    ],
)
def test_occlusion_falls_linearly_with_the_gap(gap: float, expected: float) -> None:
    z = np.float32(0.5)
    result = occluded_fraction(depth_map(0.5 + gap), 15.3, 16.8, z)
    assert result == pytest.approx(expected, abs=1e-5)


def test_next_to_a_wall_half_of_the_surroundings_are_occluded() -> None:
    assert occluded_fraction(half_blocked(16), 16.0, 16.8, 0.0) == pytest.approx(0.5)


def test_outside_the_map_and_in_empty_blocks_nothing_is_occluded() -> None:
    for x, y in ((-1.0, 16.0), (2.0, 16.0), (16.0, SIZE - 1.0), (16.0, 1e9)):
        assert occluded_fraction(depth_map(0.0), x, y, 0.0) == 0.0
    assert occluded_fraction(depth_map(0.0, occupied=False), 16.0, 16.0, 0.0) == 0.0
