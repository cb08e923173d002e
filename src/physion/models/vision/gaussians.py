"""Independent Gaussians of random variables: values, and divergence."""

from __future__ import annotations

from torch import Tensor


def gaussian_values(mean: Tensor, log_variance: Tensor, noise: Tensor) -> Tensor:
    """Return the values of Gaussians that belong to standard normal numbers ``noise``."""
    return mean + (0.5 * log_variance).exp() * noise


def gaussian_divergence(
    mean: Tensor, log_variance: Tensor, of_mean: Tensor, of_log_variance: Tensor
) -> Tensor:
    """Return KL(N(mean, v) || N(of_mean, w)) of independent Gaussians, summed over the last axis.

    (log(w / v) + (v + (mean - of_mean)^2) / w - 1) / 2 by component, v and w being variances.
    """
    log_ratio = log_variance - of_log_variance
    squares = (mean - of_mean).pow(2) * (-of_log_variance).exp()
    return 0.5 * (log_ratio.exp() + squares - 1 - log_ratio).sum(-1)
