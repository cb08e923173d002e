"""Video encoders without dynamics: VideoMAE and V-JEPA 2.

A clip of n = ``frames`` frames becomes tubelets, patches of two frames; the network gives a token
(D,) of each, which depends on the whole clip. The context is one such clip, and it ends with the
last observed frame. What follows, which *full* reads, is encoded in further clips of n frames, so
that no feature of the context depends on a later frame.

Features are (B, T / 2, D), the means of the tokens at one time; with ``grid`` (B, T / 2, R C D),
the means in R x C cells (`models.weights.grid`).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
import transformers
from torch import Tensor

from physion.errors import BadInputError
from physion.models.batch import Batch, Provenance, Spec
from physion.models.build import make_config
from physion.models.encoders.settings import SMALL
from physion.models.encoders.video_networks import (
    TUBELET,
    VIDEOMAE,
    VJEPA2,
    VideoConfig,
    VideoFamily,
    create_video_encoder,
)
from physion.models.torch_model import TorchModel, digest_of
from physion.models.vision.pictures import normalized_pictures
from physion.models.weights import GRID, RANDOM
from physion.models.weights.grid import average_cells

_VERSION = 1
"""To be raised with every change that alters features."""


class VideoEncoder(TorchModel):
    """Frozen video encoder; its protocols are *observed* and *full*."""

    reader = "logistic"

    def __init__(self, family: VideoFamily, size: str, config: VideoConfig) -> None:
        super().__init__()
        self.family, self.size, self.config = family, size, config
        self.spec = Spec(
            image_size=config.image_size,
            stride=config.stride,
            context=config.frames,
            future=config.later * config.frames,
            anchor="end",
            framewise=False,
        )
        self.network, self.init = create_video_encoder(family, config)

    @torch.no_grad()
    def encode(self, batch: Batch) -> Tensor:
        """Return features (B, T / 2, D) of pictures (B, T, H, W, 3), T a multiple of ``frames``."""
        pictures = normalized_pictures(batch, self.spec, self.name())
        clips, steps = pictures.shape[:2]
        frames, size = self.config.frames, self.config.image_size
        if steps % frames:
            raise BadInputError(f"{self.name()} encodes clips of {frames} frames, not {steps}")
        tokens: Tensor = self.network(pictures.reshape(-1, frames, 3, size, size)).last_hidden_state
        side, width = size // self.config.patch, tokens.shape[-1]
        maps = tokens.reshape(-1, side, side, width).permute(0, 3, 1, 2)
        features = average_cells(maps) if self.config.pooling == GRID else maps.mean((2, 3))
        return features.float().reshape(clips, steps // TUBELET, -1)

    def digest(self) -> str:
        """Return the SHA-256 of settings, versions and weights."""
        settings = dataclasses.asdict(self.config)
        settings.pop("weights")  # which count as they are
        parts = [_VERSION, self.family.name, settings, torch.__version__, transformers.__version__]
        return digest_of(parts, self.state_dict().items())

    def name(self) -> str:
        """Return the name for tables, such as ``VideoMAE-paper`` or ``random-VideoMAE-paper``."""
        grid = "grid" * (self.config.pooling == GRID)
        parts = ["random" * (self.init == RANDOM), self.family.name, grid, self.size]
        return "-".join(part for part in parts if part)

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        named = self.init != RANDOM and self.init == self.family.sizes[self.size].weights
        return Provenance(
            model=self.name(),
            init=self.init,
            encoder_type=self.family.name,
            encoder_pretraining_task=self.family.task if named else "",
            encoder_pretraining_dataset=self.family.dataset if named else "",
            encoder_pretraining_seed=str(self.config.seed) if self.init == RANDOM else "",
            versions=f"torch {torch.__version__}, transformers {transformers.__version__}",
        )


def videomae(**options: Any) -> VideoEncoder:
    """Build VideoMAE, a transformer on 16 frames (options: `VideoConfig`, and the size)."""
    return _build(VIDEOMAE, options)


def vjepa2(**options: Any) -> VideoEncoder:
    """Build V-JEPA 2, a transformer on 16 frames (options: `VideoConfig`, and the size)."""
    return _build(VJEPA2, options)


def _build(family: VideoFamily, options: dict[str, Any]) -> VideoEncoder:
    chosen = dict(options)
    size = chosen.pop("size", SMALL)
    if size not in family.sizes:
        sizes = ", ".join(family.sizes)
        raise BadInputError(f"model {family.name} has the sizes {sizes}, not {size!r}")
    settings = {**dataclasses.asdict(family.sizes[size]), **chosen}
    return VideoEncoder(family, size, make_config(VideoConfig, family.name, settings))
