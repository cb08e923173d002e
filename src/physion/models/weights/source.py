"""Origin of an encoder's weights, and what identifies them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from physion.models.weights.packages import WeightsPackage, weights_package
from physion.models.weights.state_dicts import weights_sha256

IMAGENET, RANDOM, PACKAGE, TIMM = "imagenet", "random", "package:", "timm:"
TIMM_PRETRAINING = {
    "dino": ("DINO", "ImageNet"),
    "mae": ("masked autoencoder", "ImageNet"),
    "lvd142m": ("DINOv2", "LVD-142M"),
    "lvd1689m": ("DINOv3", "LVD-1689M"),
}
"""Task and data set of some of timm's weights, by tag."""


@dataclass(frozen=True, slots=True)
class EncoderWeights:
    """Weights of an encoder, by their source.

    - ``imagenet``: timm's weights of ImageNet classification, downloaded.
    - ``timm:TAG``: other weights of timm, downloaded, such as ``timm:dino``.
    - ``random``: drawn from ``seed``.
    - ``package:NAME``: weights in the Python distribution NAME, one of `weights_packages`.
    - otherwise the path of a state dict, as ``.safetensors`` or as a torch file of plain tensors.

    Files are identified by their SHA-256. Raises `UnknownNameError` for an unknown package.
    """

    source: str
    seed: int = 0

    def __post_init__(self) -> None:
        _ = self.package

    @property
    def package(self) -> WeightsPackage | None:
        """The package that holds the weights, or None if they are no package."""
        if not self.source.startswith(PACKAGE):
            return None
        return weights_package(self.source.removeprefix(PACKAGE))

    @property
    def tag(self) -> str:
        """The tag of timm's weights; empty for those of another source, and for ``imagenet``."""
        return self.source.removeprefix(TIMM) if self.source.startswith(TIMM) else ""

    @property
    def downloaded(self) -> bool:
        """Whether timm fetches the weights."""
        return self.source == IMAGENET or self.source.startswith(TIMM)

    @property
    def path(self) -> Path | None:
        """The file that the user gave, or None."""
        if self.source == RANDOM or self.downloaded or self.package is not None:
            return None
        return Path(self.source)

    def init(self) -> str:
        """Return the value of the column *Init*.

        It is imagenet, timm:<tag>, random, package:<name>, or local:<start of the file's SHA-256>.
        """
        path = self.path
        return self.source if path is None else f"local:{weights_sha256(path)[:12]}"

    def identity(self) -> str:
        """Return one string that identifies the weights."""
        if self.source == RANDOM:
            return f"random:{self.seed}:torch{torch.__version__}"
        if package := self.package:
            return f"{self.source}:{package.sha256}"
        path = self.path
        return self.source if path is None else f"local:{weights_sha256(path)}"

    def pretraining(self) -> tuple[str, str]:
        """Return task and data set that trained the weights; both are empty if unknown."""
        if package := self.package:
            return package.task, package.dataset
        if self.tag:
            return TIMM_PRETRAINING.get(self.tag, ("", self.tag))
        return ("ImageNet classification", "ImageNet") if self.source == IMAGENET else ("", "")
