"""Error where something moves, and divergence of Gaussians: closed forms."""

from __future__ import annotations

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from physion.models.vision import (
    CHANGE,
    copy_error,
    empty_scene_error,
    future_error,
    gaussian_divergence,
    gaussian_values,
    moving_pixels,
)


def column_clip() -> torch.Tensor:
    """Return a clip (1, 4, 3, 4, 4) of a white column on black, which moves by one a frame."""
    pictures = torch.zeros(1, 4, 3, 4, 4)
    for frame in range(4):
        pictures[0, frame, :, :, frame] = 1
    return pictures


def test_pixels_move_where_a_column_comes_or_goes() -> None:
    moves = moving_pixels(column_clip())
    assert moves.shape == (1, 3, 4, 4)
    for frame in range(3):
        columns = moves[0, frame].all(0).tolist()
        assert columns == [column in (frame, frame + 1) for column in range(4)]


def test_noise_of_compression_does_not_move() -> None:
    pictures = torch.rand(1, 1, 3, 4, 4).repeat(1, 2, 1, 1, 1)
    pictures[:, 1] += 0.9 * CHANGE
    assert not moving_pixels(pictures).any()
    pictures[0, 1, 2, 3, 1] += CHANGE
    assert moving_pixels(pictures).nonzero().tolist() == [[0, 0, 3, 1]]


def test_a_copy_is_wrong_where_the_column_is_and_where_it_was_seen_last() -> None:
    """Frame 2 is copied from frame 1: both columns that move are wrong. Frame 3 as well: of the
    columns 2 and 3, which move, only the third is wrong."""
    pictures, valid = column_clip(), torch.ones(1, 4, dtype=torch.bool)
    error = copy_error(pictures, 2, valid)
    assert error.moving == pytest.approx(3 / 4)
    assert error.pixels == pytest.approx(4 * 4 / 32)


def test_an_empty_scene_is_wrong_where_the_column_is() -> None:
    """The median of two frames has no column; half of the pixels that move show one."""
    pictures, valid = column_clip(), torch.ones(1, 4, dtype=torch.bool)
    error = empty_scene_error(pictures, 2, valid)
    assert error.moving == pytest.approx(1 / 2)
    assert error.pixels == pytest.approx(2 * 4 / 32)


def test_errors_are_means_of_squares_over_what_counts() -> None:
    pictures, valid = column_clip(), torch.ones(1, 4, dtype=torch.bool)
    exact = future_error(pictures[:, 2:], pictures, valid)
    assert exact.moving == exact.pixels == 0
    off = future_error(pictures[:, 2:] + 0.5, pictures, valid)
    assert off.moving == pytest.approx(0.25) and off.pixels == pytest.approx(0.25)
    valid[0, 3] = False
    wrong_at_the_end = pictures[:, 2:].clone()
    wrong_at_the_end[:, 1] += 1
    assert future_error(wrong_at_the_end, pictures, valid).moving == 0
    still = torch.zeros_like(pictures)
    assert future_error(still[:, 2:] + 1, still, valid).moving == 0, "nothing moves"


def test_divergence_of_gaussians_is_that_of_torch() -> None:
    torch.manual_seed(0)
    mean, scale, of_mean, of_scale = torch.randn(4, 5, 7).unbind(0)
    one = Independent(Normal(mean, (scale / 2).exp()), 1)
    other = Independent(Normal(of_mean, (of_scale / 2).exp()), 1)
    divergence = gaussian_divergence(mean, scale, of_mean, of_scale)
    assert torch.allclose(divergence, kl_divergence(one, other), rtol=1e-5)
    assert gaussian_divergence(mean, scale, mean, scale).abs().max() == 0


def test_values_have_the_mean_and_the_variance() -> None:
    noise = torch.randn(100_000, generator=torch.Generator().manual_seed(0))
    values = gaussian_values(torch.tensor(3.0), torch.tensor(4.0).log(), noise)
    assert float(values.mean()) == pytest.approx(3, abs=0.03)
    assert float(values.var()) == pytest.approx(4, rel=0.02)
