"""Hourglass network: feature maps with a quarter of the resolution of the pictures.

References
----------
A. Newell, K. Yang and J. Deng, Stacked hourglass networks for human pose estimation, ECCV 2016; one
stack, with group normalisation as in RPIN (Qi et al. 2021, appendix A).
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional


class Bottleneck(nn.Module):
    """Residual block x + f(x): normalisation, ReLU and convolution, thrice, half as wide inside."""

    def __init__(self, inputs: int, outputs: int, groups: int) -> None:
        super().__init__()
        inner = outputs // 2
        self.layers = nn.Sequential(
            *(nn.GroupNorm(groups, inputs), nn.ReLU(), nn.Conv2d(inputs, inner, 1)),
            *(nn.GroupNorm(groups, inner), nn.ReLU(), nn.Conv2d(inner, inner, 3, padding=1)),
            *(nn.GroupNorm(groups, inner), nn.ReLU(), nn.Conv2d(inner, outputs, 1)),
        )
        same = inputs == outputs
        self.skip = nn.Identity() if same else nn.Conv2d(inputs, outputs, 1)

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps (N, outputs, H, W)."""
        out: Tensor = self.skip(maps) + self.layers(maps)
        return out


class Hourglass(nn.Module):
    """Maps at ``depth`` lower resolutions, each half of the one before, added up again."""

    def __init__(self, depth: int, width: int, groups: int) -> None:
        super().__init__()
        self.level = Bottleneck(width, width, groups)
        self.before = Bottleneck(width, width, groups)
        self.inner = (
            Hourglass(depth - 1, width, groups) if depth > 1 else Bottleneck(width, width, groups)
        )
        self.after = Bottleneck(width, width, groups)

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps of the same shape (N, width, H, W); H and W are multiples of 2^depth."""
        low = self.after(self.inner(self.before(functional.max_pool2d(maps, 2))))
        out: Tensor = self.level(maps) + functional.interpolate(low, scale_factor=2)
        return out


class Backbone(nn.Module):
    """Pictures (N, 3, H, W) to maps (N, width, H / 4, W / 4)."""

    def __init__(self, width: int, depth: int, groups: int) -> None:
        super().__init__()
        narrow, half = width // 4, width // 2
        self.stem = nn.Sequential(
            nn.Conv2d(3, narrow, 7, stride=2, padding=3),
            nn.GroupNorm(groups, narrow),
            nn.ReLU(),
            Bottleneck(narrow, half, groups),
            nn.MaxPool2d(2),
            Bottleneck(half, half, groups),
            Bottleneck(half, width, groups),
        )
        self.hourglass = Hourglass(depth, width, groups)
        self.head = nn.Sequential(
            Bottleneck(width, width, groups),
            nn.Conv2d(width, width, 1),
            nn.GroupNorm(groups, width),
            nn.ReLU(),
            nn.Conv2d(width, width, 1),
        )

    def forward(self, pictures: Tensor) -> Tensor:
        """Return the feature maps."""
        out: Tensor = self.head(self.hourglass(self.stem(pictures)))
        return out
