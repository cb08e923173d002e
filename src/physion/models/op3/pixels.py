"""Pixels as a mixture of what the slots show.

Slot k shows the colours y_k with the mask m_k, sum_k m_k = 1. A pixel x, three channels, has

    log p(x) = log sum_k m_k N(x; y_k, sigma^2)
    N = exp(-d / (2 sigma^2)) / (2 pi sigma^2)^(3/2),  d = sum_c (x_c - y_kc)^2

The published code (``OP3Model._gaussian_prob`` and ``get_loss``) has another density: the exponent
is divided by the number of channels, the factor is 1 / (sigma^3 (2 pi)^3), and 1e-12 is added to p.

Source: Veerapaneni et al. 2020, section 3 and appendix; Greff et al. 2019 (IODINE), section 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Density = Literal["gaussian", "released"]
_CHANNELS = 3
_FLOOR = math.log(1e-12)
_LARGEST = 5.0
"""Largest logarithm of the gradient of a mask. Where no slot explains a pixel it has no bound, and
the others would vanish next to it after the normalisation."""


@dataclass(frozen=True, eq=False)
class Decoded:
    """What slots show: ``colors`` (B, K, 3, H, W), ``logits`` of the masks (B, K, 1, H, W)."""

    colors: Tensor
    logits: Tensor

    @property
    def log_masks(self) -> Tensor:
        """Logarithms of the masks (B, K, 1, H, W)."""
        return self.logits.log_softmax(1)

    @property
    def masks(self) -> Tensor:
        """Masks (B, K, 1, H, W), whose sum over the slots is 1."""
        return self.logits.softmax(1)

    def picture(self) -> Tensor:
        """Return the mean of the mixture, (B, 3, H, W)."""
        return (self.masks * self.colors).sum(1)


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Logarithms of densities: of pixels given a slot (B, K, H, W), and of pixels (B, H, W)."""

    by_slot: Tensor
    pixels: Tensor


def log_likelihood(
    decoded: Decoded, pictures: Tensor, sigma: float, density: Density
) -> Likelihood:
    """Return the log likelihood of pictures (B, 3, H, W)."""
    squares = (pictures[:, None] - decoded.colors).pow(2).sum(2)
    if density == "gaussian":
        by_slot = -squares / (2 * sigma**2) - _CHANNELS / 2 * math.log(2 * math.pi * sigma**2)
    else:
        by_slot = -squares / (_CHANNELS * 2 * sigma**2)
        by_slot = by_slot - _CHANNELS * math.log(2 * math.pi * sigma)
    pixels = (decoded.log_masks[:, :, 0] + by_slot).logsumexp(1)
    if density == "released":
        pixels = torch.logaddexp(pixels, pixels.new_tensor(_FLOOR))
    return Likelihood(by_slot, pixels)


def plain_maps(decoded: Decoded, likelihood: Likelihood, pictures: Tensor) -> Tensor:
    """Return the images that the refinement sees as they are, (B, K, 9, H, W).

    They are pictures (B, 3, H, W), colours, mask, its logit, and which slot explains the pixel,
    p(x | k) / sum_j p(x | j).
    """
    parts = [
        pictures[:, None].expand_as(decoded.colors),
        decoded.colors,
        decoded.masks,
        decoded.logits,
        likelihood.by_slot.softmax(1)[:, :, None],
    ]
    return torch.cat(parts, 2)


@torch.no_grad()
def slope_maps(decoded: Decoded, likelihood: Likelihood, color_slope: Tensor) -> Tensor:
    """Return the images that the refinement sees normalised, (B, K, 6, H, W), without gradients.

    They are the gradient of -log p(x) by the mask, which is -p(x | k) / p(x); p(x); p(x) without
    the slot; and ``color_slope`` (B, K, 3, H, W), the gradient by the colours.
    """
    pixels, by_slot = likelihood.pixels[:, None], likelihood.by_slot
    mask_slope = -(by_slot - pixels).clamp(max=_LARGEST).exp()
    without = pixels.exp() - decoded.masks[:, :, 0] * by_slot.exp()
    parts = (mask_slope, pixels.exp().expand_as(by_slot), without)
    return torch.cat([torch.stack(parts, 2), color_slope], 2)
