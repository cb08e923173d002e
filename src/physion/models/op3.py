"""OP3: K slots that explain a picture together, and predict how they change.

The steps of `SlotInference` follow a schedule: the slots of the first frame are refined
``seed_steps`` times; the slots of each later frame that is seen are predicted, then refined once;
after these frames they are only predicted. With the objective O_i after step i = 1, 2,
..., for the picture of its frame,

    loss = sum_i i O_i / sum_i i / pixels

where moving pixels (`physion.models.vision`) have the weight 1 + w, w = 0 as published.

Features are the states of all slots, with the means of their random part: after the refinement
for frames that are seen, after the prediction for imagined ones. When features are computed, the
slots of all trials start from the same random numbers, so that a slot tends to hold the same
thing.

Source: Veerapaneni et al. 2020, "Entity Abstraction in Visual Model-Based Reinforcement
Learning"; docs/reference/vision-models.md says in what the sizes differ from the published code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from physion.clips.batch import Batch, Provenance, Rollout
from physion.core.errors import BadInputError
from physion.core.seeds import generator
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

Density = Literal["gaussian", "released"]
NAME = "op3"
VERSION = 1
"""To be raised with every change of what equal weights compute, or of the training."""

_PAPER: Mapping[str, Any] = {
    "image_size": 64, "slots": 8, "deterministic": 64, "stochastic": 64, "width": 32, "kernel": 5,
    "layers": 5, "step": 1, "hidden": 128, "motion": 0.0, "update": "replace", "seed_steps": 4,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Op3Settings(PictureSettings):
    """Settings of OP3; also see `PictureSettings` and `SizedSettings`.

    - ``slots``: K.
    - ``deterministic``, ``stochastic``: sizes of the two parts of the state of a slot.
    - ``width``: channels of the convolutions, with ``kernel`` x ``kernel`` weights; ``layers`` of
      the decoder; ``step``, the stride of the ones of the refinement.
    - ``hidden``: units of the refinement's LSTM. ``effect``: size of the effect of one slot on
      another.
    - ``update``: whether refinement and dynamics ``add`` to the state or ``replace`` it, as in the
      published code.
    - ``density``: of a pixel given a slot: ``gaussian``, or ``released``, as in the published
      code (`log_likelihood`), with the standard deviation ``sigma``.
    - ``seed_steps``: refinements with the first frame; each later one that is seen has one.
    """

    model: str = NAME
    image_size: int = 32
    slots: int = 5
    deterministic: int = 16
    stochastic: int = 16
    width: int = 16
    kernel: int = 3
    layers: int = 4
    step: int = 2
    hidden: int = 64
    effect: int = 32
    update: Literal["add", "replace"] = "add"
    density: Density = "gaussian"
    sigma: float = 0.1
    beta: float = 1e-2
    seed_steps: int = 3
    past: int = 4
    imagined: int = 3

    sizes: ClassVar[Sizes] = {
        "small": {},
        "paper": _PAPER,
        "released": {**_PAPER, **RELEASED_CLIPS, "density": "released"},
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least(
            1, "slots", "deterministic", "stochastic", "width", "step", "hidden", "effect",
            "seed_steps",
        )  # fmt: skip
        if self.layers < 2 or self.kernel % 2 == 0:
            raise BadInputError(
                f"OP3: layers must be at least 2 and kernel odd, not {self.layers} and "
                f"{self.kernel}"
            )


SMALL_TRAINING = replace(PICTURE_TRAINING, steps=1500, batch=8, clip=5.0)
# Published for Physion, before the paper: 300 epochs, whose length is not known.
PAPER_TRAINING = replace(
    SMALL_TRAINING, steps=180_000, batch=16, learning_rate=3e-4, schedule="constant", warmup=0,
    validate_every=600,
)  # fmt: skip


# Pixels as a mixture of what the slots show.
#
# Slot k shows the colours y_k with the mask m_k, sum_k m_k = 1. A pixel x, three channels, has
#
#     log p(x) = log sum_k m_k N(x; y_k, sigma^2)
#     N = exp(-d / (2 sigma^2)) / (2 pi sigma^2)^(3/2),  d = sum_c (x_c - y_kc)^2
#
# The published code (``OP3Model._gaussian_prob`` and ``get_loss``) has another density: the
# exponent is divided by the number of channels, the factor is 1 / (sigma^3 (2 pi)^3), and 1e-12 is
# added to p.
#
# Source: Veerapaneni et al. 2020, section 3 and appendix; Greff et al. 2019 (IODINE), section 3.

_CHANNELS = 3
_FLOOR = math.log(1e-12)
_LARGEST = 5.0
"""Largest logarithm of the gradient of a mask. Where no slot explains a pixel it has no bound, and
the others would vanish next to it after the normalisation."""


@dataclass(frozen=True, eq=False)
class Decoded:
    """What slots show: ``colors`` (B, K, 3, H, W), ``logits`` of the masks (B, K, 1, H, W)."""

    colors: Tensor
    logits: Tensor

    @property
    def log_masks(self) -> Tensor:
        """Logarithms of the masks (B, K, 1, H, W)."""
        return self.logits.log_softmax(1)

    @property
    def masks(self) -> Tensor:
        """Masks (B, K, 1, H, W), whose sum over the slots is 1."""
        return self.logits.softmax(1)

    def picture(self) -> Tensor:
        """Return the mean of the mixture, (B, 3, H, W)."""
        return (self.masks * self.colors).sum(1)


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Logarithms of densities: of pixels given a slot (B, K, H, W), and of pixels (B, H, W)."""

    by_slot: Tensor
    pixels: Tensor


def log_likelihood(
    decoded: Decoded, pictures: Tensor, sigma: float, density: Density
) -> Likelihood:
    """Return the log likelihood of pictures (B, 3, H, W)."""
    squares = (pictures[:, None] - decoded.colors).pow(2).sum(2)
    if density == "gaussian":
        by_slot = -squares / (2 * sigma**2) - _CHANNELS / 2 * math.log(2 * math.pi * sigma**2)
    else:
        by_slot = -squares / (_CHANNELS * 2 * sigma**2)
        by_slot = by_slot - _CHANNELS * math.log(2 * math.pi * sigma)
    pixels = (decoded.log_masks[:, :, 0] + by_slot).logsumexp(1)
    if density == "released":
        pixels = torch.logaddexp(pixels, pixels.new_tensor(_FLOOR))
    return Likelihood(by_slot, pixels)


def plain_maps(decoded: Decoded, likelihood: Likelihood, pictures: Tensor) -> Tensor:
    """Return the images that the refinement sees as they are, (B, K, 9, H, W).

    They are pictures (B, 3, H, W), colours, mask, its logit, and which slot explains the pixel,
    p(x | k) / sum_j p(x | j).
    """
    parts = [
        pictures[:, None].expand_as(decoded.colors),
        decoded.colors,
        decoded.masks,
        decoded.logits,
        likelihood.by_slot.softmax(1)[:, :, None],
    ]
    return torch.cat(parts, 2)


@torch.no_grad()
def slope_maps(decoded: Decoded, likelihood: Likelihood, color_slope: Tensor) -> Tensor:
    """Return the images that the refinement sees normalised, (B, K, 6, H, W), without gradients.

    They are the gradient of -log p(x) by the mask, which is -p(x | k) / p(x); p(x); p(x) without
    the slot; and ``color_slope`` (B, K, 3, H, W), the gradient by the colours.
    """
    pixels, by_slot = likelihood.pixels[:, None], likelihood.by_slot
    mask_slope = -(by_slot - pixels).clamp(max=_LARGEST).exp()
    without = pixels.exp() - decoded.masks[:, :, 0] * by_slot.exp()
    parts = (mask_slope, pixels.exp().expand_as(by_slot), without)
    return torch.cat([torch.stack(parts, 2), color_slope], 2)


# Networks of OP3: what a slot shows, how it is refined, and how slots move one another.
#
# All slots share the weights, so that a permutation of the slots permutes the results.
#
# Source: Veerapaneni et al. 2020, section 3 and appendix, and the code that the authors published.

PLAIN, NORMALIZED = 9, 6
"""Channels of the images of `plain_maps` and `slope_maps`."""
_NORMALIZED_PARTS = [1, 1, 1, 3]
"""Channels that are normalised together: gradient by the mask, likelihood, the one without the
slot, gradient by the colours."""


def coordinates(size: int, like: Tensor) -> Tensor:
    """Return the columns and rows of pixels in -1..1, (1, 2, size, size)."""
    line = torch.linspace(-1, 1, size, dtype=like.dtype, device=like.device)
    rows, columns = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([columns, rows])[None]


class BroadcastConv(nn.Module):
    """Convolution of values that are equal at all positions, joined with the coordinates.

    With zeros around the image, the values z (N, R) and the weights w of the taps t = 1..k^2:

        y_cp = sum_t s_tp (w_ct . z) + conv(coordinates)_cp,  s_tp = 1 if tap t of p is inside

    which needs R times fewer operations than a convolution of the images.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs + 2, outputs, kernel, padding=kernel // 2)
        self.inputs, self.kernel = inputs, kernel

    def forward(self, values: Tensor, size: int) -> Tensor:
        """Return (N, C, size, size)."""
        weight, pad = self.conv.weight, self.kernel // 2
        ones = values.new_ones(1, 1, size, size)
        inside = functional.unfold(ones, self.kernel, padding=pad)[0]
        taps = torch.einsum("nr,crt->nct", values, weight[:, : self.inputs].flatten(2))
        field = (taps @ inside).view(len(values), -1, size, size)
        place = coordinates(size, values)
        own = functional.conv2d(place, weight[:, self.inputs :], self.conv.bias, padding=pad)
        out: Tensor = field + own
        return out


class SlotDecoder(nn.Module):
    """States (B, K, R) to colours and masks, by spatial broadcast (Watters et al. 2019)."""

    def __init__(self, settings: Op3Settings) -> None:
        super().__init__()
        self.size = settings.image_size
        inputs = settings.deterministic + settings.stochastic
        self.first = BroadcastConv(inputs, settings.width, settings.kernel)
        layers: list[nn.Module] = []
        for layer in range(1, settings.layers):
            outputs = 4 if layer + 1 == settings.layers else settings.width
            layers += [nn.ELU(), _conv(settings.width, outputs, settings.kernel)]
        self.rest = nn.Sequential(*layers)
        _initialize(self.first.conv)

    def forward(self, states: Tensor) -> Decoded:
        """Return what every slot shows."""
        out = self.rest(self.first(states.flatten(0, 1), self.size)).unflatten(0, states.shape[:2])
        return Decoded(out[:, :, :3], out[:, :, 3:])


class Refinement(nn.Module):
    """Changes of the beliefs about slots, from what they show and from gradients."""

    def __init__(self, settings: Op3Settings) -> None:
        super().__init__()
        size, width = settings.stochastic, settings.width
        self.map_norms = nn.ModuleList([nn.GroupNorm(1, part) for part in _NORMALIZED_PARTS])
        self.gradient_norms = nn.ModuleList([nn.LayerNorm(size), nn.LayerNorm(size)])
        layers: list[nn.Module] = []
        channels = [PLAIN + NORMALIZED + 2, width, width, max(size, width)]
        for before, after in pairwise(channels):
            layers += [_conv(before, after, settings.kernel, settings.step), nn.ELU()]
        self.look = nn.Sequential(*layers)
        self.inner = nn.Linear(channels[-1], settings.hidden)
        self.memory = nn.LSTMCell(settings.hidden + 5 * size, settings.hidden)
        self.mean = nn.Linear(settings.hidden, size)
        self.raw = nn.Linear(settings.hidden, size)

    def forward(
        self,
        plain: Tensor,
        normalized: Tensor,
        gradients: tuple[Tensor, Tensor],
        beliefs: Tensor,
        memory: tuple[Tensor, Tensor],
    ) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
        """Return new mean and raw scale (N, Rs) of N slots, and the LSTM's state.

        Parameters
        ----------
        plain, normalized : Tensor
            Images (N, 9, H, W) and (N, 6, H, W).
        gradients
            Of the objective by mean and raw scale, (N, Rs) each.
        beliefs : Tensor
            Mean, raw scale and sample, (N, 3 Rs).
        memory
            State of the LSTM.
        """
        maps = torch.split(normalized, _NORMALIZED_PARTS, 1)
        normed = [norm(part) for norm, part in zip(self.map_norms, maps, strict=True)]
        place = coordinates(plain.shape[-1], plain).expand(len(plain), -1, -1, -1)
        seen = self.look(torch.cat([plain, *normed, place], 1)).mean((2, 3))
        slopes = [norm(part) for norm, part in zip(self.gradient_norms, gradients, strict=True)]
        inputs = torch.cat([functional.elu(self.inner(seen)), *slopes, beliefs], 1)
        memory = self.memory(inputs, memory)
        return self.mean(memory[0]), self.raw(memory[0]), memory


class SlotDynamics(nn.Module):
    """Next state of every slot, from its own state and the effects of all others.

    e_k = inertia(s_k);  p_kj = pair(e_k, e_j);
    s'_k = heads(merge(e_k, sum_(j != k) effect(p_kj) attention(p_kj)))
    """

    def __init__(self, settings: Op3Settings) -> None:
        super().__init__()
        size, hidden = settings.deterministic + settings.stochastic, settings.effect
        self.inertia = _mlp(size, size, size)
        self.pair = _mlp(2 * size, 2 * size, size)
        self.effect = _mlp(size, size, hidden)
        self.attention = nn.Sequential(
            nn.Linear(size, size), nn.ELU(), nn.Linear(size, 1), nn.Sigmoid()
        )
        self.merge = _mlp(size + hidden, size, size)
        self.deterministic = _head(size, settings.deterministic)
        self.mean = _head(size, settings.stochastic)
        self.raw = _head(size, settings.stochastic)

    def forward(self, states: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return deterministic part, mean and raw scale (B, K, ...) from states (B, K, R)."""
        encoded = self.inertia(states)
        slots = states.shape[1]
        own = encoded[:, :, None].expand(-1, -1, slots, -1)
        pairs = self.pair(torch.cat([own, own.transpose(1, 2)], -1))
        others = 1 - torch.eye(slots, dtype=states.dtype, device=states.device)
        effects = self.effect(pairs) * self.attention(pairs) * others[:, :, None]
        merged = self.merge(torch.cat([encoded, effects.sum(2)], -1))
        return self.deterministic(merged), self.mean(merged), self.raw(merged)


def _conv(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Conv2d:
    return _initialize(nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2))


def _initialize(conv: nn.Conv2d) -> nn.Conv2d:
    nn.init.xavier_uniform_(conv.weight)
    assert conv.bias is not None
    nn.init.zeros_(conv.bias)
    return conv


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ELU(), nn.Linear(hidden, outputs), nn.ELU())


def _head(inputs: int, outputs: int) -> nn.Sequential:
    """Return a network whose outputs are initially close to 0."""
    last = nn.Linear(inputs, outputs)
    nn.init.uniform_(last.weight, -3e-3, 3e-3)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(inputs, inputs), nn.ELU(), last)


# Beliefs about slots: how they start, are refined by a picture, and are predicted.
#
# The state of slot k is s_k = [a_k, z_k], a deterministic part a_k and a random variable z_k with
# a prior p and a posterior q, both Gaussian with independent components:
#
#     variance = softplus(raw) + 1e-5
#
#     objective = - sum_pixels log p(x | s_1, ..., s_K) + beta sum_k KL(q_k || p_k)
#
# - *Start*: all slots have the same learned a and q, and p = N(0, 1). That their samples of z
#   differ
#   tells them apart.
# - *Refinement* (iterative amortised inference): a network sees picture, colours, masks,
#   likelihoods,
#   and the gradients of the objective by mask, colours and q; it gives the next q.
# - *Prediction*: the dynamics give a, and p = q, from the states of all slots. The memory of the
#   refinement starts anew.
#
# Source: Veerapaneni et al. 2020, section 3; Greff et al. 2019, algorithm 1.

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

    ``kl`` (B): divergence. ``objective`` (B): weighted sum of the divergence and of the negative
    log likelihood, which is summed over pixels.
    """

    slots: Slots
    decoded: Decoded
    likelihood: Likelihood
    kl: Tensor
    objective: Tensor


class SlotInference(nn.Module):
    """Decoder, refinement and dynamics, with the learned start of the slots."""

    def __init__(self, settings: Op3Settings) -> None:
        super().__init__()
        self.settings = settings
        self.decoder = SlotDecoder(settings)
        self.refinement = Refinement(settings)
        self.dynamics = SlotDynamics(settings)
        sizes = (settings.deterministic, settings.stochastic, settings.stochastic)
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
        settings = self.settings
        decoded = self.decoder(slots.states)
        likelihood = log_likelihood(decoded, pictures, settings.sigma, settings.density)
        nll, kl = -likelihood.pixels.sum((1, 2)), slots.divergence()
        return Explained(slots, decoded, likelihood, kl, nll + settings.beta * kl)

    def refine(self, explained: Explained, pictures: Tensor, noise: Tensor) -> Slots:
        """Return the beliefs after one refinement; ``noise`` (B, K, Rs) makes their samples.

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
        if self.settings.update == "add":
            mean, raw = slots.mean + mean, slots.raw + raw
        return replace(slots, mean=mean, raw=raw, noise=noise, memory=memory)

    def predict(self, slots: Slots, noise: Tensor) -> Slots:
        """Return the beliefs about the next frame; ``noise`` (B, K, Rs) makes the samples."""
        deterministic, mean, raw = self.dynamics(slots.states)
        if self.settings.update == "add":
            deterministic = slots.deterministic + deterministic
            mean, raw = slots.sample + mean, slots.raw + raw
        return Slots(deterministic, mean, raw, mean, raw, noise, self._memory(noise))

    def _memory(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        zero = noise.new_zeros(noise.shape[0] * noise.shape[1], self.settings.hidden)
        return zero, zero


def _log_variance(raw: Tensor) -> Tensor:
    return (functional.softplus(raw) + _LEAST_VARIANCE).log()


# The model: loss, and imagination.


@dataclass(frozen=True, eq=False)
class TrainingClips:
    """Objective of training clips, a scalar, with its parts; and the imagined pictures."""

    objective: Tensor
    nll: Tensor
    kl: Tensor
    imagined: Tensor


class Op3(PictureModel):
    """OP3, slots that explain pictures together and move one another."""

    settings: Op3Settings

    def __init__(self, settings: Op3Settings) -> None:
        training = SMALL_TRAINING if settings.size == "small" else PAPER_TRAINING
        super().__init__(VERSION, settings, training, framewise=False)
        if settings.slots != settings.sizes[settings.size].get("slots", 5):
            self.name += f"-{settings.slots}-slots"
        with initial_weights("op3", settings.seed):
            self.slots = SlotInference(settings)
        load_named(self, settings.weights)

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        encoder = f"{self.settings.slots} slots {self.settings.image_size} px"
        return self.origin(encoder, "interaction network", "pictures of slots")

    def encode(self, batch: Batch) -> Tensor:
        """Return the states of the slots (B, T, K R) after each frame was seen."""
        return self._watch(normalized_pictures(batch, self.spec, self.name))[0]

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Return the states (B, S, future, K R) of ``samples`` futures; no frame of them is seen.

        They follow from ``seed`` and the trial's name only. With the argument ``show`` above 0,
        ``shown`` holds pictures, ``rgb`` (B, S, future, H, W, 3) uint8, and ``masks``
        (B, S, future, K, H, W) float32, and the masks of the frames that were seen under
        ``context_masks`` (B, T, K, H, W).
        """
        _, seen = self._watch(context_pictures(context, self.spec, self.name))
        slots = seen[-1]
        settings, clips, future = self.settings, len(context), context.future
        shape = (samples, future + 1, settings.slots, settings.stochastic)
        noise = self.imagined_noise(context.trials, seed, shape).to(slots.mean)
        shows = arguments.get("show", 0) > 0
        features, shown, found = [], [], []
        with torch.no_grad():
            if shows:
                found = [self.slots.decoder(beliefs.states) for beliefs in seen]
            state = _repeated(slots, samples, noise[:, 0])
            for step in range(future):
                state = self.slots.predict(state, noise[:, step + 1])
                features.append(state.features())
                if shows:
                    shown.append(self.slots.decoder(state.states))
        values = torch.stack(features, 1).float().view(clips, samples, future, -1)
        return Rollout(features=values, shown=_shown(shown, found, clips, samples))

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss of training clips, and what it consists of.

        Training: ``loss`` in nats a pixel, ``nll``, ``kl`` by clip, and ``error``, the squared
        error of the imagined frames. In a validation ``loss`` is the squared error of moving pixels
        of the imagined frames (`physion.models.vision`), ``error`` the error of all pixels, and
        ``objective`` the loss of the training.
        """
        pictures = window_pictures(batch, self.spec, self.name, self.window)
        # A validation is without gradients, which the refinement needs.
        with torch.enable_grad():
            clips = self._run(pictures, batch.valid)
        error = future_error(clips.imagined, pictures, batch.valid)
        if self.training:
            parts = {"nll": clips.nll, "kl": clips.kl, "error": error.pixels}
            return {"loss": clips.objective, **parts}
        parts = {"error": error.pixels, "objective": clips.objective}
        return {name: part.detach() for name, part in {"loss": error.moving, **parts}.items()}

    def _run(self, pictures: Tensor, valid: Tensor) -> TrainingClips:
        """Return the objective of training clips (B, T, 3, H, W)."""
        settings, inference = self.settings, self.slots
        clips, frames, _, height, width = pictures.shape

        def noise() -> Tensor:
            return torch.randn(clips, settings.slots, settings.stochastic).to(pictures)

        slots, steps, imagined = inference.start(noise()), [], []
        explained = inference.explain(slots, pictures[:, 0])
        for frame in range(frames):
            picture = pictures[:, frame]
            if frame:
                explained = inference.explain(inference.predict(explained.slots, noise()), picture)
                steps.append((frame, explained))
            if frame >= settings.past:
                imagined.append(explained.decoded.picture())
                continue
            for _ in range(1 if frame else settings.seed_steps):
                refined = inference.refine(explained, picture, noise())
                explained = inference.explain(refined, picture)
                steps.append((frame, explained))
        moves = nn.functional.pad(moving_pixels(pictures), (0, 0, 0, 0, 1, 0))
        nll, kl = weighted_means(steps, valid, 1 + settings.motion * moves)
        objective = nll + settings.beta * kl / (height * width)
        return TrainingClips(objective, nll, kl, torch.stack(imagined, 1))

    def _watch(self, pictures: Tensor) -> tuple[Tensor, list[Slots]]:
        """Return features (B, T, K R) of clips (B, T, 3, H, W), and beliefs after each frame."""
        settings, inference = self.settings, self.slots
        rng = generator(NAME, "slots")
        features, beliefs = [], []
        # The refinement needs gradients, which tensors of the inference mode cannot have.
        with torch.inference_mode(False), torch.enable_grad():
            seen = pictures.clone()
            shape = (settings.slots, settings.stochastic)

            def noise() -> Tensor:
                values = torch.from_numpy(rng.standard_normal(shape)).to(seen)
                return values.expand(len(seen), -1, -1)

            slots = inference.start(noise())
            for frame in range(seen.shape[1]):
                if frame:
                    slots = inference.predict(slots, noise())
                for _ in range(1 if frame else settings.seed_steps):
                    explained = inference.explain(slots.detached(), seen[:, frame])
                    slots = inference.refine(explained, seen[:, frame], noise())
                features.append(slots.features().detach())
                beliefs.append(slots.detached())
            return torch.stack(features, 1).float(), beliefs


def weighted_means(
    steps: list[tuple[int, Explained]], valid: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Return negative log likelihood by pixel, and divergence, of the steps of training clips.

    Parameters
    ----------
    steps
        Frame of each step, and how well it is explained.
    valid : Tensor
        Whether the movies have the frames (B, T); others do not count.
    weights : Tensor
        Of the pixels of all frames (B, T, H, W).

    Notes
    -----
    They are means over clips and steps; step i has the weight i.
    """
    counted = torch.stack([valid[:, frame] for frame, _ in steps], 1)
    numbers = torch.arange(1, len(steps) + 1, device=valid.device)
    importance = (counted * numbers).float()
    nll = [-(step.likelihood.pixels * weights[:, f]).mean((1, 2)) for f, step in steps]
    kl = [step.kl for _, step in steps]
    total = importance.sum().clamp_min(1)
    means = [(torch.stack(values, 1) * importance).sum() / total for values in (nll, kl)]
    return means[0], means[1]


def _repeated(slots: Slots, samples: int, noise: Tensor) -> Slots:
    """Return the beliefs for ``samples`` futures of every clip, which follow one another."""
    deterministic, mean, raw, prior_mean, prior_raw = (
        part.repeat_interleave(samples, 0)
        for part in (
            slots.deterministic, slots.mean, slots.raw, slots.prior_mean, slots.prior_raw,
        )
    )  # fmt: skip
    memory = (noise.new_zeros(0), noise.new_zeros(0))
    return Slots(deterministic, mean, raw, prior_mean, prior_raw, noise, memory)


def _shown(
    steps: list[Decoded], seen: list[Decoded], clips: int, samples: int
) -> dict[str, Tensor]:
    """Return what slots show at imagined steps, and the masks of frames that were seen."""
    if not steps:
        return {}
    pictures = torch.stack([step.picture() for step in steps], 1).clamp(0, 1)
    rgb = (pictures.movedim(2, -1) * 255).round().to(torch.uint8)
    futures = {
        name: value.view(clips, samples, *value.shape[1:])
        for name, value in {"rgb": rgb, "masks": _masks(steps)}.items()
    }
    return {**futures, "context_masks": _masks(seen)}


def _masks(steps: list[Decoded]) -> Tensor:
    """Return the masks (B, T, K, H, W) of T steps, float32."""
    return torch.stack([step.masks[:, :, 0] for step in steps], 1).float()
