"""Beliefs about slots: how they start, are refined by a picture, and are predicted.

The state of slot k is s_k = [a_k, z_k], a deterministic part a_k and a random variable z_k with a
prior p and a posterior q, both Gaussian with independent components:

    variance = softplus(raw) + 1e-5

    objective = - sum_pixels log p(x | s_1, ..., s_K) + beta sum_k KL(q_k || p_k)

- *Start*: all slots have the same learned a and q, and p = N(0, 1). That their samples of z differ
  tells them apart.
- *Refinement* (iterative amortised inference): a network sees picture, colours, masks, likelihoods,
  and the gradients of the objective by mask, colours and q; it gives the next q.
- *Prediction*: the dynamics give a, and p = q, from the states of all slots. The memory of the
  refinement starts anew.

Source: Veerapaneni et al. 2020, section 3; Greff et al. 2019, algorithm 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from physion.models.op3.config import Op3Config
from physion.models.op3.networks import Refinement, SlotDecoder, SlotDynamics
from physion.models.op3.pixels import Decoded, Likelihood, log_likelihood, plain_maps, slope_maps
from physion.models.vision.gaussians import gaussian_divergence, gaussian_values

_LEAST_VARIANCE = 1e-5
_UNIT = math.log(math.e - 1)
"""Raw scale of variance 1."""


@dataclass(frozen=True, eq=False)
class Slots:
    """Beliefs about K slots of B clips.

    - ``deterministic`` (B, K, Rd); ``mean``, ``raw`` (B, K, Rs) of the posterior, ``prior_mean``,
      ``prior_raw`` of the prior.
    - ``noise`` (B, K, Rs): standard normal numbers that determine the sample of z.
    - ``memory``: state of the LSTM of the refinement, (B K, hidden) each.
    """

    deterministic: Tensor
    mean: Tensor
    raw: Tensor
    prior_mean: Tensor
    prior_raw: Tensor
    noise: Tensor
    memory: tuple[Tensor, Tensor]

    @property
    def sample(self) -> Tensor:
        """Values of z (B, K, Rs)."""
        return gaussian_values(self.mean, _log_variance(self.raw), self.noise)

    @property
    def states(self) -> Tensor:
        """States (B, K, Rd + Rs) with the samples of z."""
        return torch.cat([self.deterministic, self.sample], -1)

    def features(self) -> Tensor:
        """Return the states with the means of z, all slots of a clip together, (B, K R)."""
        return torch.cat([self.deterministic, self.mean], -1).flatten(1)

    def divergence(self) -> Tensor:
        """Return KL(posterior || prior) of every clip (B), summed over the slots."""
        scales = _log_variance(self.raw), _log_variance(self.prior_raw)
        return gaussian_divergence(self.mean, scales[0], self.prior_mean, scales[1]).sum(1)

    def detached(self) -> Slots:
        """Return beliefs without gradients to what came before, except to ``mean`` and ``raw``."""
        return Slots(
            self.deterministic.detach(),
            self.mean.detach().requires_grad_(),
            self.raw.detach().requires_grad_(),
            self.prior_mean.detach(),
            self.prior_raw.detach(),
            self.noise,
            (self.memory[0].detach(), self.memory[1].detach()),
        )


@dataclass(frozen=True, eq=False)
class Explained:
    """What slots show, and how well it explains a picture.

    ``nll``, ``kl`` (B): negative log likelihood, summed over pixels, and divergence. ``objective``
    (B): their weighted sum.
    """

    slots: Slots
    decoded: Decoded
    likelihood: Likelihood
    nll: Tensor
    kl: Tensor
    objective: Tensor


class SlotInference(nn.Module):
    """Decoder, refinement and dynamics, with the learned start of the slots."""

    def __init__(self, config: Op3Config) -> None:
        super().__init__()
        self.config = config
        self.decoder = SlotDecoder(config)
        self.refinement = Refinement(config)
        self.dynamics = SlotDynamics(config)
        sizes = (config.deterministic, config.stochastic, config.stochastic)
        first = [torch.randn(size) / math.sqrt(size) for size in sizes]
        self.deterministic, self.mean, self.raw = (nn.Parameter(value) for value in first)

    def start(self, noise: Tensor) -> Slots:
        """Return the beliefs before the first picture; ``noise`` is (B, K, Rs)."""
        clips, slots = noise.shape[:2]
        deterministic, mean, raw = (
            value.expand(clips, slots, -1) for value in (self.deterministic, self.mean, self.raw)
        )
        prior = torch.zeros_like(noise), torch.full_like(noise, _UNIT)
        return Slots(deterministic, mean, raw, *prior, noise, self._memory(noise))

    def explain(self, slots: Slots, pictures: Tensor) -> Explained:
        """Compare what slots show with pictures (B, 3, H, W)."""
        config = self.config
        decoded = self.decoder(slots.states)
        likelihood = log_likelihood(decoded, pictures, config.sigma, config.density)
        nll, kl = -likelihood.pixels.sum((1, 2)), slots.divergence()
        return Explained(slots, decoded, likelihood, nll, kl, nll + config.beta * kl)

    def refine(self, explained: Explained, pictures: Tensor, noise: Tensor) -> Slots:
        """Return the beliefs after one refinement; ``noise`` (B, K, Rs) is that of their samples.

        The gradients that the refinement sees are inputs: training does not differentiate them.
        """
        slots, decoded = explained.slots, explained.decoded
        color_slope, mean_slope, raw_slope = torch.autograd.grad(
            explained.objective.sum(), [decoded.colors, slots.mean, slots.raw], retain_graph=True
        )
        plain = plain_maps(decoded, explained.likelihood, pictures)
        normalized = slope_maps(decoded, explained.likelihood, color_slope)
        beliefs = torch.cat([slots.mean, slots.raw, slots.sample], -1)
        mean, raw, memory = self.refinement(
            plain.flatten(0, 1),
            normalized.flatten(0, 1),
            (mean_slope.flatten(0, 1), raw_slope.flatten(0, 1)),
            beliefs.flatten(0, 1),
            slots.memory,
        )
        mean, raw = (value.view_as(slots.mean) for value in (mean, raw))
        if self.config.update == "add":
            mean, raw = slots.mean + mean, slots.raw + raw
        return replace(slots, mean=mean, raw=raw, noise=noise, memory=memory)

    def predict(self, slots: Slots, noise: Tensor) -> Slots:
        """Return the beliefs about the next frame; ``noise`` (B, K, Rs) is that of the samples."""
        deterministic, mean, raw = self.dynamics(slots.states)
        if self.config.update == "add":
            deterministic = slots.deterministic + deterministic
            mean, raw = slots.sample + mean, slots.raw + raw
        return Slots(deterministic, mean, raw, mean, raw, noise, self._memory(noise))

    def _memory(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        zero = noise.new_zeros(noise.shape[0] * noise.shape[1], self.config.hidden)
        return zero, zero


def _log_variance(raw: Tensor) -> Tensor:
    return (functional.softplus(raw) + _LEAST_VARIANCE).log()
