"""Networks of SVG: encoder and decoder of pictures, and LSTMs that predict codes.

With the image size s, the encoder has n = log2(s / 4) stages, each half the size of the one before,
and makes one code of the 4 x 4 positions of the last. The decoder mirrors it; the input of each of
its stages is joined with the encoder's activations of the same size, the *skip connections*.

Source: Denton and Fergus 2018, section 4, and the code that the authors published.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from physion.models.svg.config import SvgConfig

State = tuple[Tensor, Tensor]
"""Output and cell of an LSTM, (layers, B, units)."""
_SLOPE = 0.2
_GROUPS = 8
_VGG_LAYERS = 3
"""Convolutions of a stage of VGG; the first two stages have two."""
_INITIAL = 0.02
"""Standard deviation of initial weights."""


def stage_widths(config: SvgConfig) -> list[int]:
    """Return the channels of the encoder's stages."""
    stages = int(math.log2(config.image_size // 4))
    return [config.width * min(2**stage, 8) for stage in range(stages)]


class Encoder(nn.Module):
    """Pictures (B, 3, H, W) to codes (B, g) in -1..1, and the activations of all stages."""

    def __init__(self, config: SvgConfig) -> None:
        super().__init__()
        widths = stage_widths(config)
        self.stages = nn.ModuleList()
        for stage, (before, width) in enumerate(pairwise([3, *widths])):
            if config.backbone == "dcgan":
                layers = [*_conv(config, before, width, kernel=4, stride=2)]
            else:
                # The last convolution's output is the skip connection; pooling comes before.
                layers = [nn.MaxPool2d(2)] if stage else []
                inner = [before, *[width] * (2 if stage < 2 else _VGG_LAYERS)]
                for a, b in pairwise(inner):
                    layers += _conv(config, a, b)
            self.stages.append(nn.Sequential(*layers))
        pool = [nn.MaxPool2d(2)] if config.backbone == "vgg" else []
        self.head = nn.Sequential(
            *pool,
            nn.Conv2d(widths[-1], config.code, 4),
            # One position has no statistics of a group.
            *([nn.BatchNorm2d(config.code)] if config.norm == "batch" else []),
            nn.Tanh(),
        )
        initialize(self)

    def forward(self, pictures: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Return codes, and activations from the largest to the smallest."""
        skips, values = [], pictures
        for stage in self.stages:
            values = stage(values)
            skips.append(values)
        return self.head(values).flatten(1), skips


class Decoder(nn.Module):
    """Codes (B, g) and the encoder's activations to pictures (B, 3, H, W) in 0..1."""

    def __init__(self, config: SvgConfig) -> None:
        super().__init__()
        widths = stage_widths(config)[::-1]
        first = nn.ConvTranspose2d(config.code, widths[0], 4)
        self.first = nn.Sequential(first, *_after(config, widths[0]))
        self.enlarge = nn.Upsample(scale_factor=2) if config.backbone == "vgg" else nn.Identity()
        self.stages = nn.ModuleList()
        for stage, (width, after) in enumerate(pairwise([*widths, 0])):
            last = stage + 1 == len(widths)
            if config.backbone == "dcgan":
                out = nn.ConvTranspose2d(2 * width, 3 if last else after, 4, 2, 1)
                layers = [out, *([nn.Sigmoid()] if last else _after(config, after))]
            else:
                # As many convolutions as the encoder's stage of the same size.
                count = 2 if len(widths) - stage <= 2 else _VGG_LAYERS
                inner = [2 * width, *[width] * (count - 1)]
                layers = [layer for a, b in pairwise(inner) for layer in _conv(config, a, b)]
                if last:
                    layers += [nn.Conv2d(width, 3, 3, padding=1), nn.Sigmoid()]
                else:
                    layers += _conv(config, width, after)
            self.stages.append(nn.Sequential(*layers))
        initialize(self)

    def forward(self, codes: Tensor, skips: Sequence[Tensor]) -> Tensor:
        """Return pictures; ``skips`` are ordered as those of `Encoder`."""
        values = self.first(codes[:, :, None, None])
        for stage, skip in zip(self.stages, reversed(skips), strict=True):
            values = stage(torch.cat([self.enlarge(values), skip], 1))
        out: Tensor = values
        return out


class CodePredictor(nn.Module):
    """LSTM over sequences (B, T, inputs) to codes (B, T, g) in -1..1."""

    def __init__(self, inputs: int, config: SvgConfig) -> None:
        super().__init__()
        self.embed = nn.Linear(inputs, config.hidden)
        self.lstm = nn.LSTM(config.hidden, config.hidden, config.layers, batch_first=True)
        self.out = nn.Linear(config.hidden, config.code)
        initialize(self)

    def forward(self, inputs: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """Return codes, and the state after the last step."""
        values, state = self.lstm(self.embed(inputs), state)
        return torch.tanh(self.out(values)), state


class GaussianPredictor(nn.Module):
    """LSTM over codes (B, T, g) to mean and log variance (B, T, z) of Gaussians."""

    def __init__(self, config: SvgConfig) -> None:
        super().__init__()
        self.embed = nn.Linear(config.code, config.hidden)
        self.lstm = nn.LSTM(config.hidden, config.hidden, batch_first=True)
        self.mean = nn.Linear(config.hidden, config.latent)
        self.log_variance = nn.Linear(config.hidden, config.latent)
        initialize(self)

    def forward(self, codes: Tensor, state: State | None = None) -> tuple[Tensor, Tensor, State]:
        """Return means, log variances, and the state after the last step."""
        values, state = self.lstm(self.embed(codes), state)
        return self.mean(values), self.log_variance(values), state


def initialize(network: nn.Module) -> None:
    """Draw the weights of convolutions and linear layers from N(0, 0.02^2); biases are 0.

    Scales of normalisations are drawn from N(1, 0.02^2), as in the published code.
    """
    for part in network.modules():
        if isinstance(part, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            nn.init.normal_(part.weight, 0.0, _INITIAL)
            if part.bias is not None:
                nn.init.zeros_(part.bias)
        elif isinstance(part, nn.BatchNorm2d | nn.GroupNorm):
            nn.init.normal_(part.weight, 1.0, _INITIAL)
            nn.init.zeros_(part.bias)


def _conv(
    config: SvgConfig, inputs: int, outputs: int, *, kernel: int = 3, stride: int = 1
) -> list[nn.Module]:
    return [nn.Conv2d(inputs, outputs, kernel, stride, padding=1), *_after(config, outputs)]


def _after(config: SvgConfig, channels: int) -> list[nn.Module]:
    """Return the normalisation and nonlinearity that follow a convolution."""
    if config.norm == "batch":
        return [nn.BatchNorm2d(channels), nn.LeakyReLU(_SLOPE)]
    groups = math.gcd(_GROUPS, channels)
    return [nn.GroupNorm(groups, channels), nn.LeakyReLU(_SLOPE)]
