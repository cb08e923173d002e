"""Mip levels of known footprints, and filtering of hand-made textures."""

from __future__ import annotations

import math

import numpy as np
import pytest

from physion.rendering.textures.atlas import (
    SLOPE_SCALE,
    SLOPE_ZERO,
    Atlas,
    mip_level,
    sample_texture,
)

SIDE = 512


@pytest.mark.parametrize(
    ("texels", "level"), [(0.01, 0.0), (1.0, 0.0), (2.0, 0.5), (4.0, 1.0), (16.0, 2.0), (1e3, None)]
)
def test_level_of_a_pixel_that_covers_so_many_texels(texels: float, level: float | None) -> None:
    expected = 0.5 * math.log2(texels) if level is None else level
    assert mip_level(texels / SIDE**2, SIDE) == pytest.approx(expected, abs=2e-5)


def test_a_pixel_that_covers_the_whole_texture_takes_the_last_level() -> None:
    assert mip_level(1.0, SIDE) == math.log2(SIDE)


def two_by_two() -> Atlas:
    """Return two levels: texels of stored red 0, 100, 200, 40, then 60; other colours are 255."""
    red = [0, 100, 200, 40, 60]
    slope = int(SLOPE_ZERO + 0.5 * SLOPE_SCALE)
    texels = np.array([[r, 255, 255, slope, int(SLOPE_ZERO)] for r in red], np.uint8)
    return Atlas(texels, np.array([[0, 4]]))


@pytest.mark.parametrize(
    ("u", "v", "level", "stored"),
    [
        (0.25, 0.25, 0.0, 0.0),
        (0.75, 0.25, 0.0, 100.0),
        (0.25, 0.75, 0.0, 200.0),
        (0.5, 0.25, 0.0, 50.0),  # between two texels
        (0.5, 0.5, 0.0, 85.0),  # between all four
        (1.0, 0.25, 0.0, 50.0),  # over the edge, where the texture repeats
        (-3.25, 7.25, 0.0, 100.0),
        (0.3, 0.9, 1.0, 60.0),
        (0.75, 0.25, 0.5, 80.0),  # between two levels
        (0.3, 0.9, 7.0, 60.0),
    ],
)
def test_stored_values_are_mixed_linearly(u: float, v: float, level: float, stored: float) -> None:
    red, green, _, slope_u, slope_v = sample_texture(two_by_two(), 0, u, v, level)
    assert red == pytest.approx((stored / 255) ** 2, abs=1e-12)
    assert green == pytest.approx(1.0)
    assert (slope_u, slope_v) == pytest.approx((0.5, 0.0))
