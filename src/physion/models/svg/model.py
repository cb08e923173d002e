"""SVG-LP: predicts the next picture from a code, and from a random variable with a learned prior.

With codes h_t and inner activations of an encoder of picture x_t:

    p_t = N(mean, var)(h_1, ..., h_(t-1))          prior, LSTM
    q_t = N(mean, var)(h_1, ..., h_t)              posterior, LSTM
    g_t = LSTM(h_(t-1), z_t; its state)            predicted code, z_t from q_t in training
    y_t = decoder(g_t, inner activations of the last observed frame)
    loss = mean_t [ mean_p (1 + w m_tp) (y_tp - x_tp)^2 + beta KL(q_t || p_t) ]

with the moving pixels m (`physion.models.vision.moving`), whose weight w is 0 as published.
In training h_(t-1) is the code of the true picture. To imagine, z_t is drawn from p_t, and h_t is
the code of y_t after the last observed frame.

Features are the codes h_t of observed frames and the predicted codes g_t of imagined ones.

Source: Denton and Fergus 2018, "Stochastic Video Generation with a Learned Prior", sections 3, 4
and appendix; docs/vision-models.md says in what the sizes differ from the published code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from physion.models.batch import Batch, Provenance, Rollout
from physion.models.svg.config import SvgConfig, SvgOptions
from physion.models.svg.networks import (
    CodePredictor,
    Decoder,
    Encoder,
    GaussianPredictor,
)
from physion.models.torch_model import initial_weights
from physion.models.vision.clips import context_pictures, window_pictures
from physion.models.vision.gaussians import gaussian_divergence, gaussian_values
from physion.models.vision.moving import future_error, moving_pixels
from physion.models.vision.picture_model import PictureModel
from physion.models.vision.pictures import normalized_pictures
from physion.seeds import generator

NAME = "svg"
VERSION = 1
"""To be raised with every change of what equal weights compute, or of the training."""


@dataclass(frozen=True, eq=False)
class ImaginedClips:
    """Predicted codes (N, F, g) and pictures (N, F, 3, H, W) in 0..1."""

    codes: Tensor
    pictures: Tensor


class Svg(PictureModel):
    """Model of the future of pictures, trained to predict the next one."""

    def __init__(self, config: SvgConfig, options: SvgOptions) -> None:
        super().__init__(NAME, VERSION, config, options, samples=options.samples, framewise=True)
        self.config = config
        if options.backbone:
            self.name += f"-{options.backbone}"
        if options.image_size:
            self.name += f"-{options.image_size}"
        with initial_weights("svg", options.seed):
            self.encoder = Encoder(config)
            self.decoder = Decoder(config)
            self.predictor = CodePredictor(config.code + config.latent, config)
            self.prior = GaussianPredictor(config)
            self.posterior = GaussianPredictor(config)

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        encoder = f"{self.config.backbone.upper()} {self.config.image_size} px"
        return self.origin(encoder, "LSTM with learned prior", "next picture")

    @torch.no_grad()
    def encode(self, batch: Batch) -> Tensor:
        """Return the codes (B, T, g) of the pictures of a batch, each of its frame alone."""
        pictures = normalized_pictures(batch, self.spec, self.name)
        codes: Tensor = self.encoder(pictures.flatten(0, 1))[0]
        return codes.float().view(*pictures.shape[:2], -1)

    @torch.no_grad()
    def imagine(self, context: Batch, samples: int, seed: int, **knobs: float) -> Rollout:
        """Return the predicted codes (B, S, future, g) of ``samples`` futures.

        They follow from ``seed`` and the name of the trial alone. With the knob ``show`` above 0,
        ``shown`` holds the pictures under ``rgb`` (B, S, future, H, W, 3), uint8.
        """
        pictures = context_pictures(context, self.spec, self.name)
        steps = self.spec.context - 1 + self.spec.future
        shape = (samples, steps, self.config.latent)
        draws = [generator(NAME, seed, trial).standard_normal(shape) for trial in context.trials]
        noise = torch.from_numpy(np.concatenate(draws)).to(pictures)
        imagined = self._roll_out(pictures, noise)
        codes, shown = (
            value.view(len(context), samples, *value.shape[1:])
            for value in (imagined.codes.float(), imagined.pictures)
        )
        if knobs.get("show", 0) <= 0:
            return Rollout(features=codes)
        rgb = (shown.movedim(3, -1) * 255).round().to(torch.uint8)
        return Rollout(features=codes, shown={"rgb": rgb})

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss of training clips, and what it consists of.

        Training: ``loss``, ``error`` (the first term), ``kl``. A validation is of what the model
        imagines without seeing it: ``loss`` is the squared error of moving pixels of the frames
        after the observed ones (`physion.models.vision.moving`), ``error`` that of all pixels, and
        ``objective`` the loss of the training.
        """
        pictures = window_pictures(batch, self.spec, self.name, self.window)
        objective = self._objective(pictures, batch.valid)
        if self.training:
            return objective
        config = self.config
        steps = config.past - 1 + config.imagined
        noise = torch.randn(len(pictures), steps, config.latent).to(pictures)
        imagined = self._roll_out(pictures[:, : config.past], noise)
        error = future_error(imagined.pictures, pictures, batch.valid)
        parts = {"error": error.pixels, "objective": objective["loss"]}
        return {"loss": error.moving, **parts}

    def _objective(self, pictures: Tensor, valid: Tensor) -> dict[str, Tensor]:
        """Return loss, error and divergence of clips (B, T, 3, H, W), means over the frames."""
        config = self.config
        clips, frames = pictures.shape[:2]
        flat, skips = self.encoder(pictures.flatten(0, 1))
        codes = flat.unflatten(0, (clips, frames))
        mean, log_variance, _ = self.posterior(codes[:, 1:])
        of_mean, of_log_variance, _ = self.prior(codes[:, :-1])
        latents = gaussian_values(mean, log_variance, torch.randn_like(mean))
        predicted, _ = self.predictor(torch.cat([codes[:, :-1], latents], -1))
        # Frame t is decoded with the activations of frame t - 1, or of the last observed one.
        limit = config.past - (1 if config.skip == "before" else 0)
        rows = [min(frame, limit) - 1 for frame in range(1, frames)]
        chosen = [skip.unflatten(0, (clips, frames))[:, rows].flatten(0, 1) for skip in skips]
        shown = self.decoder(predicted.flatten(0, 1), chosen).unflatten(0, (clips, frames - 1))
        squares = (shown - pictures[:, 1:]).pow(2).mean(2)
        errors = (squares * (1 + config.motion * moving_pixels(pictures))).mean((2, 3))
        divergences = gaussian_divergence(mean, log_variance, of_mean, of_log_variance)
        weights = valid[:, 1:].to(errors.dtype)
        error, divergence = (
            (values * weights).sum() / weights.sum().clamp_min(1)
            for values in (errors, divergences)
        )
        return {"loss": error + config.beta * divergence, "error": error, "kl": divergence}

    def _roll_out(self, pictures: Tensor, noise: Tensor) -> ImaginedClips:
        """Return what follows pictures (B, c, 3, H, W).

        ``noise`` (B S, c - 1 + F, z) are standard normal numbers for z of the frames 1, 2, ...; the
        S futures of a clip follow one another.
        """
        clips, observed = pictures.shape[:2]
        samples = len(noise) // clips
        flat, skips = self.encoder(pictures.flatten(0, 1))
        codes = flat.unflatten(0, (clips, observed)).repeat_interleave(samples, 0)
        row = observed - (2 if self.config.skip == "before" else 1)
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
