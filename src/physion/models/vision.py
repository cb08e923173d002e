"""What the vision models that are trained from pictures have in common: SVG, OP3, C-SWM, RPIN.

Settings and base classes, Gaussians of random variables, the error of predicted pictures where
something moves, and the pictures of a batch as input.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from physion.clips.batch import Batch, Provenance, Spec
from physion.core.errors import BadInputError
from physion.core.seeds import generator
from physion.models.interface import SizedSettings, TrainingSettings
from physion.models.torch_model import TorchModel, weights_digest


@dataclass(frozen=True, kw_only=True)
class VisionSettings(SizedSettings):
    """Settings of a vision model that is trained from pictures.

    - ``image_size``: pixels per side.
    - ``stride``, ``context``, ``future``, ``context_at``: see `physion.clips.batch.Spec`.
    """

    image_size: int = 64
    stride: int = 6
    context: int = 0
    future: int | None = None
    context_at: Literal["start", "end"] = "end"

    any_weights: ClassVar[frozenset[str]] = SizedSettings.any_weights | {
        "context", "future", "context_at"
    }  # fmt: skip


RELEASED_CLIPS: Mapping[str, Any] = {"context_at": "start", "context": 7, "future": 18}
"""Frames of clips in the released code: 0, 6, ..., 36 of the 45 observed ones, and 42 to 144."""


class VisionModel(TorchModel):
    """Model that learns from clips, and whose features a logistic regression reads.

    Parameters
    ----------
    version
        To be raised with every change of what equal weights compute, or of the training.
    settings
        What the user chose.
    training
        Optimiser and schedule, which are not part of the digest.
    spec
        What the model asks for.
    """

    settings: VisionSettings
    decision = "logistic"

    def __init__(
        self, version: int, settings: VisionSettings, training: TrainingSettings, spec: Spec
    ) -> None:
        super().__init__()
        settings.check_shipped()
        self.name = f"{settings.model}-{settings.size}"
        self.version, self.settings, self.spec = version, settings, spec
        self.training_settings = training
        self.seed = settings.seed

    def built_as(self) -> dict[str, Any]:
        """Return what the weights were made for: name, with the size, and version."""
        return {"model": self.name, "version": self.version}

    def digest(self) -> str:
        """Return the SHA-256 of code version, settings and weights."""
        return weights_digest([*self._digested(), torch.__version__], self.state_dict().items())

    def readout_digest(self) -> str:
        """Return the SHA-256 of code version, settings and weights."""
        return weights_digest(self._digested(), self.state_dict().items())

    def _digested(self) -> list[Any]:
        settings = {k: v for k, v in asdict(self.settings).items() if k not in ("weights", "seed")}
        return [self.name, self.version, settings, repr(self.spec)]

    def origin(self, encoder: str, dynamics: str, task: str) -> Provenance:
        """Return the provenance of a model with these parts, trained together on one task."""
        return Provenance(
            model=self.name,
            init=self.init,
            encoder_type=encoder,
            dynamics_type=dynamics,
            encoder_training_task=task,
            dynamics_training_task=task,
            versions=f"torch {torch.__version__}",
        )


# Independent Gaussians of random variables: values, and divergence.


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


# Error of predicted pictures where something moves, and errors of trivial predictions.
#
# Most pixels of a movie never change, so that a copy of the last seen picture has a small error
# over all of them. It predicts no motion, which shows where pixels change:
#
#     m_tp = 1 if max_c |x_tcp - x_(t-1)cp| > CHANGE, else 0
#     e = sum_tp m_tp mean_c (y_tcp - x_tcp)^2 / sum_tp m_tp
#
# with the true pictures x, the predicted ones y, frames t, channels c and pixels p.

CHANGE = 0.08
"""Smallest change of a channel, of 0..1, that counts as motion. Compression of movies changes
pixels by less."""


@dataclass(frozen=True, eq=False)
class FutureError:
    """Errors of predicted pictures: over ``moving`` pixels, and over all ``pixels``."""

    moving: Tensor
    pixels: Tensor


def moving_pixels(pictures: Tensor) -> Tensor:
    """Return which pixels of frames 1 to T - 1 differ from the frame before, (B, T - 1, H, W) bool.

    ``pictures`` (B, T, 3, H, W) are in 0..1.
    """
    change: Tensor = (pictures[:, 1:] - pictures[:, :-1]).abs().amax(2)
    return change > CHANGE


def future_error(predicted: Tensor, pictures: Tensor, valid: Tensor) -> FutureError:
    """Return the mean squared errors of the last frames of clips, by channel.

    Parameters
    ----------
    predicted : Tensor
        Pictures (B, F, 3, H, W) in 0..1 of the last F frames.
    pictures : Tensor
        True pictures (B, T, 3, H, W) of whole clips, T > F.
    valid : Tensor
        Whether the movies have the frames, (B, T) bool; others do not count.

    Returns
    -------
    FutureError
        Scalars; 0 where no pixel counts.
    """
    future = predicted.shape[1]
    squares = (predicted - pictures[:, -future:]).pow(2).mean(2)
    counted = valid[:, -future:, None, None].expand_as(squares)
    moves = moving_pixels(pictures[:, -future - 1 :]) & counted
    return FutureError(mean_of_counted(squares, moves), mean_of_counted(squares, counted))


def copy_error(pictures: Tensor, future: int, valid: Tensor) -> FutureError:
    """Return the errors of repeating the picture before the last ``future`` ones."""
    last = pictures[:, -future - 1 : -future]
    return future_error(last.expand(-1, future, -1, -1, -1), pictures, valid)


def empty_scene_error(pictures: Tensor, future: int, valid: Tensor) -> FutureError:
    """Return the errors of showing the median of the pictures before the last ``future`` ones.

    Objects that move are absent there: a model that only lets them vanish is as good.
    """
    median = pictures[:, :-future].median(1, keepdim=True).values
    return future_error(median.expand(-1, future, -1, -1, -1), pictures, valid)


def mean_of_counted(values: Tensor, counted: Tensor) -> Tensor:
    """Return the mean of the values that count; 0 if none does."""
    weights = counted.to(values.dtype)
    return (values * weights).sum() / weights.sum().clamp_min(1)


# Pictures of a batch as the input of a network.


def normalized_pictures(batch: Batch, spec: Spec, model: str) -> Tensor:
    """Return the pictures (B, T, 3, H, W) of a batch, minus ``spec.mean``, divided by ``spec.std``.

    Parameters
    ----------
    batch
        Clips with ``rgb`` (B, T, H, W, 3), uint8, on the device of the network.
    spec
        What the model asks for; its statistics are about channels in 0..1.
    model
        Name of the model, for the message.

    Raises
    ------
    BadInputError
        If the batch has no pictures, or pictures of another size.
    """
    frames, size = batch.rgb, spec.image_size
    if frames is None or tuple(frames.shape[2:]) != (size, size, 3):
        found = "none" if frames is None else tuple(frames.shape)
        raise BadInputError(
            f"{model}: pictures must be uint8 (batch, time, {size}, {size}, 3), not {found}"
        )
    scaled: Tensor = frames.permute(0, 1, 4, 2, 3).float() / 255
    mean, std = (scaled.new_tensor(value).view(3, 1, 1) for value in (spec.mean, spec.std))
    return (scaled - mean) / std


# Pictures of clips that must have a certain length.


def window_pictures(batch: Batch, spec: Spec, model: str, frames: int) -> Tensor:
    """Return the pictures (B, T, 3, H, W) of training clips, T = ``frames``.

    Raises `BadInputError` for pictures of another size, or clips of another length.
    """
    pictures = normalized_pictures(batch, spec, model)
    if pictures.shape[1] != frames:
        raise BadInputError(
            f"{model} is trained on clips of {frames} frames, not {pictures.shape[1]}"
        )
    return pictures


def context_pictures(batch: Batch, spec: Spec, model: str) -> Tensor:
    """Return the pictures (B, T, 3, H, W) of the context of clips.

    Raises
    ------
    BadInputError
        If there are no pictures, pictures of another size, or more or fewer frames than the
        context has; or if a movie ends within the context.
    """
    pictures = normalized_pictures(batch, spec, model)
    if pictures.shape[1] != spec.context:
        raise BadInputError(
            f"{model} imagines from a context of {spec.context} frames, not {pictures.shape[1]}"
        )
    for trial, valid in zip(batch.trials, batch.valid, strict=True):
        if not bool(valid.all()):
            raise BadInputError(
                f"{model}, trial {trial!r}: the movie has not all frames of the context, up to "
                f"frame {spec.context_frames()[-1]}; leave the trial out, or make its movie again"
            )
    return pictures


# Base class of the vision models that predict pictures.


@dataclass(frozen=True, kw_only=True)
class PictureSettings(VisionSettings):
    """Settings of a model that predicts pictures.

    - ``past``, ``imagined``: frames of a training clip that are seen, and that follow.
    - ``beta``: weight of the divergence in the loss.
    - ``motion``: additional weight of moving pixels in the loss; published 0. Few pixels move, and
      a short training would learn the scenery only.
    - ``samples``: futures of a trial, whose features the readout joins.
    """

    past: int = 7
    imagined: int = 9
    beta: float = 1e-4
    motion: float = 20.0
    samples: int = 1

    def __post_init__(self) -> None:
        self.at_least(1, "image_size", "past", "imagined", "samples")


PICTURE_TRAINING = TrainingSettings(
    learning_rate=1e-3, schedule="cosine", warmup=100, validate_every=500, log_every=50,
    checkpoint_every=500,
)  # fmt: skip
"""Training of the small sizes; number of steps, batch and clipping are each model's own."""


class PictureModel(VisionModel):
    """Model that is trained to predict pictures in 0..1, and imagines several futures.

    Parameters
    ----------
    version, settings, training
        As for `VisionModel`.
    framewise
        Whether the features of a frame depend on that frame only.
    """

    settings: PictureSettings

    def __init__(
        self,
        version: int,
        settings: PictureSettings,
        training: TrainingSettings,
        *,
        framewise: bool,
    ) -> None:
        spec = Spec(
            image_size=settings.image_size,
            mean=(0.0, 0.0, 0.0),
            std=(1.0, 1.0, 1.0),
            stride=settings.stride,
            context=settings.context,
            future=settings.future,
            context_at=settings.context_at,
            framewise=framewise,
        )
        super().__init__(version, settings, training, spec)
        self.window = settings.past + settings.imagined
        self.samples = settings.samples

    def imagined_noise(self, trials: Sequence[str], seed: int, shape: tuple[int, ...]) -> Tensor:
        """Return standard normal numbers (B S, ...) of S futures of each trial, float64.

        ``shape`` is (S, ...); the numbers follow from ``seed`` and the name of the trial.
        """
        name = self.settings.model
        draws = [generator(name, seed, trial).standard_normal(shape) for trial in trials]
        return torch.from_numpy(np.concatenate(draws))

    def baseline(self, batch: Batch) -> Tensor:
        """Return the squared error of moving pixels if the last observed picture is repeated."""
        pictures = window_pictures(batch, self.spec, self.name, self.window)
        return copy_error(pictures, self.settings.imagined, batch.valid).moving
