"""Camera matrices against numbers computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from physion.core.errors import BadInputError
from physion.rendering.camera import View, axes, intrinsics, projection_matrix, view_matrix
from physion.scenes.scene import Camera

# At (0, -2, 0.5), looking along +y; 90 degrees, so that the focal length is half the height.
CAMERA = Camera((0.0, -2.0, 0.5), (0.0, 3.0, 0.5), fov=math.pi / 2, near=0.1, far=100.0)
VIEW = View(CAMERA, 320, 200)


def test_axes_are_right_down_forward() -> None:
    np.testing.assert_allclose(axes(CAMERA), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)


def test_view_matrix() -> None:
    expected = [[1, 0, 0, 0], [0, 0, -1, 0.5], [0, 1, 0, 2], [0, 0, 0, 1]]
    np.testing.assert_allclose(view_matrix(CAMERA), expected, atol=1e-15)


def test_intrinsics() -> None:
    expected = [[100, 0, 160], [0, 100, 100], [0, 0, 1]]
    np.testing.assert_allclose(intrinsics(CAMERA, 320, 200), expected, rtol=1e-15)


@pytest.mark.parametrize(
    ("point", "pixel", "depth"),
    [
        ((0.0, 0.0, 0.5), (160.0, 100.0), 2.0),
        ((1.0, 0.0, 0.5), (210.0, 100.0), 2.0),
        ((0.0, 0.0, 1.5), (160.0, 50.0), 2.0),
        ((-3.2, 0.0, -1.5), (0.0, 200.0), 2.0),
        ((0.0, 8.0, 2.5), (160.0, 80.0), 10.0),
    ],
)
def test_project(point: tuple[float, ...], pixel: tuple[float, ...], depth: float) -> None:
    result, result_depth = VIEW.project(point)
    np.testing.assert_allclose(result, pixel, atol=1e-9)
    assert result_depth == pytest.approx(depth)
    np.testing.assert_allclose(VIEW.unproject(pixel, depth), point, atol=1e-12)


def test_behind_the_camera_is_a_negative_depth() -> None:
    assert VIEW.project((0.0, -3.0, 0.5))[1] == pytest.approx(-1.0)


def test_projection_matrix_agrees_with_pixels() -> None:
    camera = Camera((1.3, -2.0, 1.7), (0.1, 0.2, 0.3), fov=0.9, near=0.2, far=30.0)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    seen = np.concatenate([points, np.ones((20, 1))], axis=1) @ view_matrix(camera).T
    clip = seen @ projection_matrix(camera, 320, 200).T
    ndc = clip[:, :3] / clip[:, 3:]
    pixels = np.stack([(ndc[:, 0] + 1) * 160, (1 - ndc[:, 1]) * 100], axis=1)
    result, depth = View(camera, 320, 200).project(points)
    np.testing.assert_allclose(pixels, result, atol=1e-9)
    near_far = np.array([[0, 0, 0.2, 1], [0, 0, 30.0, 1]]) @ projection_matrix(camera, 320, 200).T
    np.testing.assert_allclose(near_far[:, 2] / near_far[:, 3], [-1, 1], atol=1e-9)
    np.testing.assert_allclose(clip[:, 3], depth)


def test_straight_down_has_y_upright() -> None:
    pixel, _ = View(Camera((0, 0, 3), (0, 0, 0)), 100, 100).project((0.0, 0.5, 0.0))
    assert pixel[0] == pytest.approx(50.0)
    assert pixel[1] < 50.0


def test_a_camera_at_its_own_target_is_an_error() -> None:
    with pytest.raises(BadInputError, match="same point"):
        axes(Camera((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)))
