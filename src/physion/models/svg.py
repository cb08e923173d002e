"""SVG-LP: predicts the next picture from a code, and from a random variable with a learned prior.

With codes h_t and inner activations of an encoder of picture x_t:

    p_t = N(mean, var)(h_1, ..., h_(t-1))          prior, LSTM
    q_t = N(mean, var)(h_1, ..., h_t)              posterior, LSTM
    g_t = LSTM(h_(t-1), z_t; its state)            predicted code, z_t from q_t in training
    y_t = decoder(g_t, inner activations of the last observed frame)
    loss = mean_t [ mean_p (1 + w m_tp) (y_tp - x_tp)^2 + beta KL(q_t || p_t) ]

with the moving pixels m (`physion.models.vision`), whose weight w is 0 as published. In
training h_(t-1) is the code of the true picture. To imagine, z_t is drawn from p_t, and h_t is
the code of y_t after the last observed frame.

Features are the codes h_t of observed frames and the predicted codes g_t of imagined ones.

Source: Denton and Fergus 2018, "Stochastic Video Generation with a Learned Prior", sections 3, 4
and appendix; docs/reference/vision-models.md says how the sizes differ from the published code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from physion.clips.batch import Batch, Provenance, Rollout
from physion.core.errors import BadInputError
from physion.models.checkpoint import load_named
from physion.models.interface import Sizes
from physion.models.torch_model import initial_weights
from physion.models.vision import (
    PICTURE_TRAINING,
    RELEASED_CLIPS,
    PictureModel,
    PictureSettings,
    context_pictures,
    future_error,
    gaussian_divergence,
    gaussian_values,
    moving_pixels,
    normalized_pictures,
    window_pictures,
)

NAME = "svg"
VERSION = 1
"""To be raised with every change of what equal weights compute, or of the training."""
Backbone = Literal["dcgan", "vgg"]
LARGEST_IMAGE = 256

_PAPER: Mapping[str, Any] = {
    "backbone": "vgg", "width": 64, "norm": "batch", "code": 128, "latent": 64, "hidden": 256,
    "past": 4, "imagined": 6, "motion": 0.0,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SvgSettings(PictureSettings):
    """Settings of SVG; also see `PictureSettings` and `SizedSettings`.

    - ``backbone``: ``dcgan`` or ``vgg``.
    - ``image_size``: pixels per side, a power of 2 from 16 on.
    - ``width``: channels of the first stage of the encoder; they double to at most 8 times as many.
    - ``norm``: ``batch`` as published, or ``group``, which does not depend on the other clips.
    - ``code``: g, size of the features. ``latent``: size of z. ``hidden``: units of the LSTMs;
      ``layers``: of the LSTM that predicts, the others have one.
    - ``skip``: whose frame's inner activations the decoder sees: ``last`` observed one, or the one
      ``before`` it, as in the published code.
    """

    model: str = NAME
    backbone: Backbone = "dcgan"
    width: int = 16
    norm: Literal["batch", "group"] = "group"
    code: int = 64
    latent: int = 10
    hidden: int = 128
    layers: int = 2
    skip: Literal["last", "before"] = "last"

    sizes: ClassVar[Sizes] = {
        "small": {},
        "paper": _PAPER,
        "released": {**_PAPER, **RELEASED_CLIPS, "skip": "before"},
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        size = self.image_size
        if size < 16 or size > LARGEST_IMAGE or size & (size - 1):
            raise BadInputError(
                f"SVG: image_size must be 16, 32, 64, 128 or {LARGEST_IMAGE}, not {size}"
            )
        self.at_least(2, "past")
        if self.context == 1:
            raise BadInputError("SVG: context must be at least 2, not 1")


SMALL_TRAINING = replace(PICTURE_TRAINING, steps=3000, batch=16, clip=1.0)
# Published for Physion, before the paper: 300 epochs of 600 steps.
PAPER_TRAINING = replace(
    SMALL_TRAINING, steps=180_000, batch=40, learning_rate=2e-3, schedule="constant", warmup=0,
    clip=0.0, validate_every=600,
)  # fmt: skip


# Networks of SVG: encoder and decoder of pictures, and LSTMs that predict codes.
#
# With the image size s, the encoder has n = log2(s / 4) stages, each half the size of the one
# before, and makes one code of the 4 x 4 positions of the last. The decoder mirrors it; the input
# of each of its stages is joined with the encoder's activations of the same size, the *skip
# connections*.
#
# Source: Denton and Fergus 2018, section 4, and the code that the authors published.

State = tuple[Tensor, Tensor]
"""Output and cell of an LSTM, (layers, B, units)."""
_SLOPE = 0.2
_GROUPS = 8
_VGG_LAYERS = 3
"""Convolutions of a stage of VGG; the first two stages have two."""
_INITIAL = 0.02
"""Standard deviation of initial weights."""


def stage_widths(settings: SvgSettings) -> list[int]:
    """Return the channels of the encoder's stages."""
    stages = int(math.log2(settings.image_size // 4))
    return [settings.width * min(2**stage, 8) for stage in range(stages)]


class Encoder(nn.Module):
    """Pictures (B, 3, H, W) to codes (B, g) in -1..1, and the activations of all stages."""

    def __init__(self, settings: SvgSettings) -> None:
        super().__init__()
        widths = stage_widths(settings)
        self.stages = nn.ModuleList()
        for stage, (before, width) in enumerate(pairwise([3, *widths])):
            if settings.backbone == "dcgan":
                layers = [*_conv(settings, before, width, kernel=4, stride=2)]
            else:
                # The last convolution's output is the skip connection; pooling comes before.
                layers = [nn.MaxPool2d(2)] if stage else []
                inner = [before, *[width] * (2 if stage < 2 else _VGG_LAYERS)]
                for a, b in pairwise(inner):
                    layers += _conv(settings, a, b)
            self.stages.append(nn.Sequential(*layers))
        pool = [nn.MaxPool2d(2)] if settings.backbone == "vgg" else []
        self.head = nn.Sequential(
            *pool,
            nn.Conv2d(widths[-1], settings.code, 4),
            # One position has no statistics of a group.
            *([nn.BatchNorm2d(settings.code)] if settings.norm == "batch" else []),
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

    def __init__(self, settings: SvgSettings) -> None:
        super().__init__()
        widths = stage_widths(settings)[::-1]
        first = nn.ConvTranspose2d(settings.code, widths[0], 4)
        self.first = nn.Sequential(first, *_after(settings, widths[0]))
        self.enlarge = nn.Upsample(scale_factor=2) if settings.backbone == "vgg" else nn.Identity()
        self.stages = nn.ModuleList()
        for stage, (width, after) in enumerate(pairwise([*widths, 0])):
            last = stage + 1 == len(widths)
            if settings.backbone == "dcgan":
                out = nn.ConvTranspose2d(2 * width, 3 if last else after, 4, 2, 1)
                layers = [out, *([nn.Sigmoid()] if last else _after(settings, after))]
            else:
                # As many convolutions as the encoder's stage of the same size.
                count = 2 if len(widths) - stage <= 2 else _VGG_LAYERS
                inner = [2 * width, *[width] * (count - 1)]
                layers = [layer for a, b in pairwise(inner) for layer in _conv(settings, a, b)]
                if last:
                    layers += [nn.Conv2d(width, 3, 3, padding=1), nn.Sigmoid()]
                else:
                    layers += _conv(settings, width, after)
            self.stages.append(nn.Sequential(*layers))
        initialize(self)

    def forward(self, codes: Tensor, skips: Sequence[Tensor]) -> Tensor:
        """Return pictures; ``skips`` are in the order of `Encoder`."""
        values = self.first(codes[:, :, None, None])
        for stage, skip in zip(self.stages, reversed(skips), strict=True):
            values = stage(torch.cat([self.enlarge(values), skip], 1))
        out: Tensor = values
        return out


class CodePredictor(nn.Module):
    """LSTM over sequences (B, T, inputs) to codes (B, T, g) in -1..1."""

    def __init__(self, inputs: int, settings: SvgSettings) -> None:
        super().__init__()
        self.embed = nn.Linear(inputs, settings.hidden)
        self.lstm = nn.LSTM(settings.hidden, settings.hidden, settings.layers, batch_first=True)
        self.out = nn.Linear(settings.hidden, settings.code)
        initialize(self)

    def forward(self, inputs: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """Return codes, and the state after the last step."""
        values, state = self.lstm(self.embed(inputs), state)
        return torch.tanh(self.out(values)), state


class GaussianPredictor(nn.Module):
    """LSTM over codes (B, T, g) to mean and log variance (B, T, z) of Gaussians."""

    def __init__(self, settings: SvgSettings) -> None:
        super().__init__()
        self.embed = nn.Linear(settings.code, settings.hidden)
        self.lstm = nn.LSTM(settings.hidden, settings.hidden, batch_first=True)
        self.mean = nn.Linear(settings.hidden, settings.latent)
        self.log_variance = nn.Linear(settings.hidden, settings.latent)
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
    settings: SvgSettings, inputs: int, outputs: int, *, kernel: int = 3, stride: int = 1
) -> list[nn.Module]:
    return [nn.Conv2d(inputs, outputs, kernel, stride, padding=1), *_after(settings, outputs)]


def _after(settings: SvgSettings, channels: int) -> list[nn.Module]:
    """Return the normalisation and nonlinearity that follow a convolution."""
    if settings.norm == "batch":
        return [nn.BatchNorm2d(channels), nn.LeakyReLU(_SLOPE)]
    groups = math.gcd(_GROUPS, channels)
    return [nn.GroupNorm(groups, channels), nn.LeakyReLU(_SLOPE)]


# The model: loss, and imagination.


@dataclass(frozen=True, eq=False)
class ImaginedClips:
    """Predicted codes (N, F, g) and pictures (N, F, 3, H, W) in 0..1."""

    codes: Tensor
    pictures: Tensor


class Svg(PictureModel):
    """SVG, which predicts pictures from a code and a random variable."""

    settings: SvgSettings

    def __init__(self, settings: SvgSettings) -> None:
        training = SMALL_TRAINING if settings.size == "small" else PAPER_TRAINING
        super().__init__(VERSION, settings, training, framewise=True)
        usual = {"backbone": "dcgan", "image_size": 64, **settings.sizes[settings.size]}
        for name in ("backbone", "image_size"):
            if (chosen := getattr(settings, name)) != usual[name]:
                self.name += f"-{chosen}"
        with initial_weights("svg", settings.seed):
            self.encoder = Encoder(settings)
            self.decoder = Decoder(settings)
            self.predictor = CodePredictor(settings.code + settings.latent, settings)
            self.prior = GaussianPredictor(settings)
            self.posterior = GaussianPredictor(settings)
        load_named(self, settings.weights)

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        encoder = f"{self.settings.backbone.upper()} {self.settings.image_size} px"
        return self.origin(encoder, "LSTM with learned prior", "next picture")

    @torch.no_grad()
    def encode(self, batch: Batch) -> Tensor:
        """Return the codes (B, T, g) of the pictures of a batch, each of its frame only."""
        pictures = normalized_pictures(batch, self.spec, self.name)
        codes: Tensor = self.encoder(pictures.flatten(0, 1))[0]
        return codes.float().view(*pictures.shape[:2], -1)

    @torch.no_grad()
    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Return the predicted codes (B, S, future, g) of ``samples`` futures.

        They follow from ``seed`` and the trial's name only. With the argument ``show`` above 0,
        ``shown`` holds the pictures under ``rgb`` (B, S, future, H, W, 3), uint8.
        """
        pictures = context_pictures(context, self.spec, self.name)
        steps = self.spec.context - 1 + context.future
        shape = (samples, steps, self.settings.latent)
        noise = self.imagined_noise(context.trials, seed, shape).to(pictures)
        imagined = self._roll_out(pictures, noise)
        codes, shown = (
            value.view(len(context), samples, *value.shape[1:])
            for value in (imagined.codes.float(), imagined.pictures)
        )
        if arguments.get("show", 0) <= 0:
            return Rollout(features=codes)
        rgb = (shown.movedim(3, -1) * 255).round().to(torch.uint8)
        return Rollout(features=codes, shown={"rgb": rgb})

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss of training clips, and what it consists of.

        Training: ``loss``, ``error`` (the first term), ``kl``. A validation is of what the model
        imagines without seeing it: ``loss`` is the squared error of moving pixels of the frames
        after the observed ones (`physion.models.vision`), ``error`` the error of all pixels, and
        ``objective`` the loss of the training.
        """
        pictures = window_pictures(batch, self.spec, self.name, self.window)
        objective = self._objective(pictures, batch.valid)
        if self.training:
            return objective
        settings = self.settings
        steps = settings.past - 1 + settings.imagined
        noise = torch.randn(len(pictures), steps, settings.latent).to(pictures)
        imagined = self._roll_out(pictures[:, : settings.past], noise)
        error = future_error(imagined.pictures, pictures, batch.valid)
        parts = {"error": error.pixels, "objective": objective["loss"]}
        return {"loss": error.moving, **parts}

    def _objective(self, pictures: Tensor, valid: Tensor) -> dict[str, Tensor]:
        """Return loss, error and divergence of clips (B, T, 3, H, W), means over the frames."""
        settings = self.settings
        clips, frames = pictures.shape[:2]
        flat, skips = self.encoder(pictures.flatten(0, 1))
        codes = flat.unflatten(0, (clips, frames))
        mean, log_variance, _ = self.posterior(codes[:, 1:])
        of_mean, of_log_variance, _ = self.prior(codes[:, :-1])
        latents = gaussian_values(mean, log_variance, torch.randn_like(mean))
        predicted, _ = self.predictor(torch.cat([codes[:, :-1], latents], -1))
        # Frame t is decoded with the activations of frame t - 1, or of the last observed one.
        limit = settings.past - (1 if settings.skip == "before" else 0)
        rows = [min(frame, limit) - 1 for frame in range(1, frames)]
        chosen = [skip.unflatten(0, (clips, frames))[:, rows].flatten(0, 1) for skip in skips]
        shown = self.decoder(predicted.flatten(0, 1), chosen).unflatten(0, (clips, frames - 1))
        squares = (shown - pictures[:, 1:]).pow(2).mean(2)
        errors = (squares * (1 + settings.motion * moving_pixels(pictures))).mean((2, 3))
        divergences = gaussian_divergence(mean, log_variance, of_mean, of_log_variance)
        weights = valid[:, 1:].to(errors.dtype)
        error, divergence = (
            (values * weights).sum() / weights.sum().clamp_min(1)
            for values in (errors, divergences)
        )
        return {"loss": error + settings.beta * divergence, "error": error, "kl": divergence}

    def _roll_out(self, pictures: Tensor, noise: Tensor) -> ImaginedClips:
        """Return what follows pictures (B, c, 3, H, W).

        ``noise`` (B S, c - 1 + F, z) are standard normal numbers for z of the frames 1, 2, ...; the
        S futures of a clip follow one another.
        """
        clips, observed = pictures.shape[:2]
        samples = len(noise) // clips
        flat, skips = self.encoder(pictures.flatten(0, 1))
        codes = flat.unflatten(0, (clips, observed)).repeat_interleave(samples, 0)
        row = observed - (2 if self.settings.skip == "before" else 1)
        skips = [
            skip.unflatten(0, (clips, observed))[:, row].repeat_interleave(samples, 0)
            for skip in skips
        ]
        mean, log_variance, _ = self.posterior(codes[:, 1:])
        latents = gaussian_values(mean, log_variance, noise[:, : observed - 1])
        _, state = self.predictor(torch.cat([codes[:, :-1], latents], -1))
        _, _, prior_state = self.prior(codes[:, :-1])
        last, predicted, shown = codes[:, -1:], [], []
        for step in range(observed - 1, noise.shape[1]):
            mean, log_variance, prior_state = self.prior(last, prior_state)
            latent = gaussian_values(mean, log_variance, noise[:, step : step + 1])
            code, state = self.predictor(torch.cat([last, latent], -1), state)
            picture = self.decoder(code[:, 0], skips)
            predicted.append(code[:, 0])
            shown.append(picture)
            last = self.encoder(picture)[0][:, None]
        return ImaginedClips(torch.stack(predicted, 1), torch.stack(shown, 1))
