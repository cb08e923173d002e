"""Base class of the vision models that predict pictures."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from physion.models.batch import Batch, Spec
from physion.models.settings import TrainingSettings
from physion.models.vision.clips import window_pictures
from physion.models.vision.model import VisionModel, VisionOptions
from physion.models.vision.moving import copy_error


class PictureConfig(Protocol):
    """Settings that a model of pictures has.

    - ``image_size``: pixels per side.
    - ``past``, ``imagined``: frames of a training clip that are seen, and that follow.
    - ``stride``, ``context``, ``future``: see `physion.models.batch.Spec`.
    - ``training``: optimiser and schedule.
    """

    @property
    def image_size(self) -> int: ...
    @property
    def past(self) -> int: ...
    @property
    def imagined(self) -> int: ...
    @property
    def stride(self) -> int: ...
    @property
    def context(self) -> int: ...
    @property
    def future(self) -> int: ...
    @property
    def training(self) -> TrainingSettings: ...


class PictureModel(VisionModel):
    """Model that is trained to predict pictures in 0..1, and imagines several futures.

    Parameters
    ----------
    name, version, config, options
        As for `VisionModel`.
    samples
        Futures of a trial.
    framewise
        Whether the features of a frame depend on that frame alone.
    """

    def __init__(
        self,
        name: str,
        version: int,
        config: PictureConfig,
        options: VisionOptions,
        *,
        samples: int,
        framewise: bool,
    ) -> None:
        spec = Spec(
            image_size=config.image_size,
            mean=(0.0, 0.0, 0.0),
            std=(1.0, 1.0, 1.0),
            stride=config.stride,
            context=config.context,
            future=config.future,
            framewise=framewise,
        )
        super().__init__(name, version, config, config.training, options, spec)
        self.window = config.past + config.imagined
        self._imagined = config.imagined
        self.samples, self.seed = samples, options.seed

    def baseline(self, batch: Batch) -> Tensor:
        """Return the squared error of moving pixels if the last observed picture is repeated."""
        pictures = window_pictures(batch, self.spec, self.name, self.window)
        return copy_error(pictures, self._imagined, batch.valid).moving
