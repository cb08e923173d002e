"""Feature extractors written for the evaluator of Physion 1.5, as models.

Such a class is a torch ``Module`` with two methods:

- ``transform()`` returns the transform of a list of PIL pictures to a tensor, the gap between two
  frames in milliseconds of physics, and the least number of frames.
- ``extract_features(videos)`` returns features (B, T, ...) of transformed pictures (B, T, C, H, W).

As in the evaluator, frames run backward from the end in steps of the gap and, if there are fewer
than it asks for, the first one is repeated. The evaluator's last frame is 45, the first after the
observed part; here it is 44. Its frames for the detection of contacts, which depend on when the
contact is, do not exist here.

References
----------
``feature_extract_interface.py`` and ``dataloader_mp4s.py`` of neuroailab/physion_evaluator.
"""

from __future__ import annotations

from typing import Any

import torch
from PIL import Image
from torch import Tensor, nn

from physion.clips.batch import LAST_OBSERVED, Batch, Provenance, Spec
from physion.core.errors import BadInputError
from physion.models.torch_model import TorchModel, source_of, weights_digest

_VERSION = 1
"""To be raised with every change that alters features."""
_MOVIE_SIZE = 256
"""Pixels per side of the movies that transforms expect."""
_SHOWN_MS, _FRAME_MS = 450, 10
"""Length of the observed part, and of a frame, in milliseconds of physics."""


class ExtractorModel(TorchModel):
    """Model that encodes the observed part with an extractor; its features have one time step."""

    def __init__(self, extractor: Any) -> None:
        super().__init__()
        self._name = type(extractor).__name__
        if not isinstance(extractor, nn.Module):
            raise BadInputError(
                f"model {self._name!r} has transform and extract_features, but is not a torch "
                "Module, so that its weights cannot be identified; derive it from torch.nn.Module"
            )
        self.extractor: Any = extractor
        transform, gap, self._least = _settings(extractor, self._name)
        # A tuple hides it from torch, which would otherwise move it away from the pictures.
        self._transform = (transform,)
        stride = -(-gap // _FRAME_MS)
        self._least = max(self._least, _SHOWN_MS // gap + 1)
        self.spec = Spec(
            image_size=_MOVIE_SIZE,
            stride=stride,
            context=LAST_OBSERVED // stride + 1,
            future=0,
            context_at="end",
            framewise=False,
        )
        weights = extractor.state_dict()
        self.init = f"local:{weights_digest([], weights.items())}" if weights else "none"

    def encode(self, batch: Batch) -> Tensor:
        """Return features (B, 1, D) of all frames of the clips."""
        device = batch.rgb.device
        videos = torch.stack([self._transformed(clip) for clip in batch.rgb.cpu()])
        padding = self._least - videos.shape[1]
        if padding > 0:
            videos = torch.cat([videos[:, :1].repeat(1, padding, 1, 1, 1), videos], dim=1)
        features: Any = self.extractor.extract_features(videos.to(device))
        if not isinstance(features, Tensor) or features.ndim < 2 or len(features) != len(batch):
            shape = tuple(getattr(features, "shape", ()))
            raise BadInputError(
                f"model {self._name!r}: extract_features gave {type(features).__name__} {shape}, "
                f"expected a tensor ({len(batch)}, time, features)"
            )
        return features.float().flatten(1)[:, None]

    def _transformed(self, clip: Tensor) -> Tensor:
        """Return transformed pictures (T, 3, H', W') of a clip (T, H, W, 3)."""
        pictures = [Image.fromarray(picture.numpy()) for picture in clip]
        changed: Any = self._transform[0](pictures)
        channels = 3 * len(pictures)
        if not isinstance(changed, Tensor) or changed.shape[:-2].numel() != channels:
            shape = tuple(getattr(changed, "shape", ()))
            raise BadInputError(
                f"model {self._name!r}: its transform gave {type(changed).__name__} {shape} for "
                f"{len(pictures)} pictures, expected a tensor ({len(pictures)}, 3, height, width)"
            )
        return changed.reshape(len(pictures), 3, *changed.shape[-2:])

    def provenance(self) -> Provenance:
        """Return the name of the extractor's class, the hash of its weights and torch's version."""
        return Provenance(self._name, self.init, versions=f"torch {torch.__version__}")

    def digest(self) -> str:
        """Return the SHA-256 of the extractor's source, what it asks for, and its weights."""
        source = source_of(type(self.extractor))
        settings = [_VERSION, source, repr(self.spec), self._least, torch.__version__]
        return weights_digest(settings, self.extractor.state_dict().items())


def _settings(extractor: Any, name: str) -> tuple[Any, int, int]:
    """Return transform, gap in milliseconds and least number of frames, checked."""
    settings = extractor.transform()
    if isinstance(settings, tuple) and len(settings) == 3:
        transform, gap, least = settings
        numbers = isinstance(gap, int) and isinstance(least, int)
        if callable(transform) and numbers and gap > 0 and least > 0:
            return transform, gap, least
    raise BadInputError(
        f"model {name!r}: transform() gave {settings!r}, expected a transform, the gap between "
        "frames in milliseconds and the least number of frames"
    )
