"""Error of predicted pictures where something moves, and those of trivial predictions.

Most pixels of a movie never change, so that a copy of the last seen picture has a small error over
all of them. It predicts no motion, which shows where pixels change:

    m_tp = 1 if max_c |x_tcp - x_(t-1)cp| > CHANGE, else 0
    e = sum_tp m_tp mean_c (y_tcp - x_tcp)^2 / sum_tp m_tp

with the true pictures x, the predicted ones y, frames t, channels c and pixels p.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

CHANGE = 0.08
"""Smallest change of a channel, of 0..1, that counts as motion. Compression of movies changes
pixels by less."""


@dataclass(frozen=True, eq=False)
class FutureError:
    """Errors of predicted pictures: over ``moving`` pixels, and over all ``pixels``."""

    moving: Tensor
    pixels: Tensor


def moving_pixels(pictures: Tensor) -> Tensor:
    """Return which pixels of frames 1 to T - 1 differ from the frame before, (B, T - 1, H, W) bool.

    ``pictures`` (B, T, 3, H, W) are in 0..1.
    """
    change: Tensor = (pictures[:, 1:] - pictures[:, :-1]).abs().amax(2)
    return change > CHANGE


def future_error(predicted: Tensor, pictures: Tensor, valid: Tensor) -> FutureError:
    """Return the mean squared errors of the last frames of clips, by channel.

    Parameters
    ----------
    predicted : Tensor
        Pictures (B, F, 3, H, W) in 0..1 of the last F frames.
    pictures : Tensor
        True pictures (B, T, 3, H, W) of whole clips, T > F.
    valid : Tensor
        Whether the movies have the frames, (B, T) bool; others do not count.

    Returns
    -------
    FutureError
        Scalars; 0 where no pixel counts.
    """
    future = predicted.shape[1]
    squares = (predicted - pictures[:, -future:]).pow(2).mean(2)
    counted = valid[:, -future:, None, None].expand_as(squares)
    moves = moving_pixels(pictures[:, -future - 1 :]) & counted
    return FutureError(_mean(squares, moves), _mean(squares, counted))


def copy_error(pictures: Tensor, future: int, valid: Tensor) -> FutureError:
    """Return the errors of repeating the picture before the last ``future`` ones."""
    last = pictures[:, -future - 1 : -future]
    return future_error(last.expand(-1, future, -1, -1, -1), pictures, valid)


def empty_scene_error(pictures: Tensor, future: int, valid: Tensor) -> FutureError:
    """Return the errors of showing the median of the pictures before the last ``future`` ones.

    Objects that move are absent there: a model that only lets them vanish is as good.
    """
    median = pictures[:, :-future].median(1, keepdim=True).values
    return future_error(median.expand(-1, future, -1, -1, -1), pictures, valid)


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    weights = counted.to(values.dtype)
    return (values * weights).sum() / weights.sum().clamp_min(1)
