"""Origin of an encoder's weights, and what identifies them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from physion.models.weights.packages import WeightsPackage, weights_package
from physion.models.weights.state_dicts import file_sha256

IMAGENET, RANDOM, PACKAGE = "imagenet", "random", "package:"


@dataclass(frozen=True, slots=True)
class EncoderWeights:
    """Weights of an encoder, by their source.

    - ``imagenet``: timm's pretrained weights, downloaded. ``random``: drawn from ``seed``.
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
    def path(self) -> Path | None:
        """The file that the user gave, or None."""
        if self.source in (IMAGENET, RANDOM) or self.package is not None:
            return None
        return Path(self.source)

    def init(self) -> str:
        """Return the value of the column *Init*.

        It is imagenet, random, package:<name>, or local:<start of the file's SHA-256>.
        """
        path = self.path
        return self.source if path is None else f"local:{file_sha256(path)[:12]}"

    def identity(self) -> str:
        """Return one string that identifies the weights."""
        if self.source == RANDOM:
            return f"random:{self.seed}:torch{torch.__version__}"
        if package := self.package:
            return f"{self.source}:{package.sha256}"
        path = self.path
        return IMAGENET if path is None else f"local:{file_sha256(path)}"

    def pretraining(self) -> tuple[str, str]:
        """Return task and data set that trained the weights; both are empty if unknown."""
        if package := self.package:
            return package.task, package.dataset
        return ("ImageNet classification", "ImageNet") if self.source == IMAGENET else ("", "")
