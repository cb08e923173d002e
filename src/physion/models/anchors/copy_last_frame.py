"""Anchor `copy-last-frame`: pixels, and a future that looks like the last observed frame."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.models.anchors.settings_digest import settings_digest
from physion.models.batch import Batch, Provenance, Rollout, Spec
from physion.models.build import make_config
from physion.version import __version__

NAME, VERSION = "copy-last-frame", 1


@dataclass(frozen=True, slots=True)
class CopyLastFrameConfig:
    """Settings of `CopyLastFrame`.

    - ``image_size``: pixels per side of the pictures. ``stride``, ``context``, ``future``: frames
      of a clip, as in `Spec`.
    """

    image_size: int = 32
    stride: int = 6
    context: int = 7
    future: int = 18


class CopyLastFrame:
    """Model whose features are pixels and that imagines that nothing changes.

    Features: red, green and blue in 0..1 of all pixels, row by row. The imagined features repeat
    those of the last context frame. A model that predicts pixels must predict better than this.
    """

    def __init__(self, config: CopyLastFrameConfig) -> None:
        self.config = config
        self.spec = Spec(
            image_size=config.image_size,
            stride=config.stride,
            context=config.context,
            future=config.future,
        )

    def encode(self, batch: Batch) -> NDArray[np.float32]:
        """Return the pixels (B, T, 3 * size * size) in 0..1."""
        rgb = pictures(batch, self.spec.image_size, NAME)
        return np.divide(rgb.reshape(*rgb.shape[:2], -1), 255, dtype=np.float32)

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: float) -> Rollout:
        """Return the last frame's features, repeated; all ``samples`` are equal.

        With pictures in ``context``, ``shown`` holds them under ``rgb``.
        """
        features = self.encode(context) if context.features is None else context.features
        return Rollout(
            features=_repeat(features, samples, self.spec.future),
            shown={}
            if context.rgb is None
            else {"rgb": _repeat(context.rgb, samples, self.spec.future)},
        )

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return Provenance(
            NAME,
            "none",
            encoder_type="pixels",
            dynamics_type="none",
            versions=f"physion {__version__}",
        )

    def digest(self) -> str:
        """Return the SHA-256 of code version and settings."""
        return settings_digest(NAME, VERSION, dataclasses.asdict(self.config))


def pictures(batch: Batch, size: int, model: str) -> NDArray[np.uint8]:
    """Return ``batch.rgb`` (B, T, H, W, 3), pictures of ``size`` pixels a side.

    Raises `BadInputError` for a batch without pictures or with others.
    """
    if batch.rgb is None or batch.rgb.shape[2:] != (size, size, 3):
        held = "none" if batch.rgb is None else f"those of shape {batch.rgb.shape[2:]}"
        raise BadInputError(f"{model} needs pictures (input rgb) of {size} x {size}, not {held}")
    return np.asarray(batch.rgb)


def copy_last_frame(**options: Any) -> CopyLastFrame:
    """Build small pictures as features, with a future that looks like the last one.

    ``options`` are the fields of `CopyLastFrameConfig`.
    """
    return CopyLastFrame(make_config(CopyLastFrameConfig, NAME, options))


def _repeat(frames: NDArray[Any], samples: int, future: int) -> NDArray[Any]:
    """Return the last of frames (B, T, ...) as (B, samples, future, ...)."""
    last = np.asarray(frames)[:, -1]
    shape = (len(last), samples, future, *last.shape[1:])
    return np.array(np.broadcast_to(last[:, None, None], shape))
