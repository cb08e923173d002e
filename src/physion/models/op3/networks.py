"""Networks of OP3: what a slot shows, how it is refined, and how slots move one another.

All slots share the weights, so that a permutation of the slots permutes the results.

Source: Veerapaneni et al. 2020, section 3 and appendix, and the code that the authors published.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from physion.models.op3.config import Op3Config
from physion.models.op3.pixels import Decoded

PLAIN, NORMALIZED = 9, 6
"""Channels of the images of `op3.pixels.plain_maps` and `op3.pixels.slope_maps`."""
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

    def __init__(self, config: Op3Config) -> None:
        super().__init__()
        self.size = config.image_size
        inputs = config.deterministic + config.stochastic
        self.first = BroadcastConv(inputs, config.width, config.kernel)
        layers: list[nn.Module] = []
        for layer in range(1, config.layers):
            outputs = 4 if layer + 1 == config.layers else config.width
            layers += [nn.ELU(), _conv(config.width, outputs, config.kernel)]
        self.rest = nn.Sequential(*layers)
        _initialize(self.first.conv)

    def forward(self, states: Tensor) -> Decoded:
        """Return what every slot shows."""
        out = self.rest(self.first(states.flatten(0, 1), self.size)).unflatten(0, states.shape[:2])
        return Decoded(out[:, :, :3], out[:, :, 3:])


class Refinement(nn.Module):
    """Changes of the beliefs about slots, from what they show and from gradients."""

    def __init__(self, config: Op3Config) -> None:
        super().__init__()
        size, width = config.stochastic, config.width
        self.map_norms = nn.ModuleList([nn.GroupNorm(1, part) for part in _NORMALIZED_PARTS])
        self.gradient_norms = nn.ModuleList([nn.LayerNorm(size), nn.LayerNorm(size)])
        layers: list[nn.Module] = []
        channels = [PLAIN + NORMALIZED + 2, width, width, max(size, width)]
        for before, after in pairwise(channels):
            layers += [_conv(before, after, config.kernel, config.step), nn.ELU()]
        self.look = nn.Sequential(*layers)
        self.inner = nn.Linear(channels[-1], config.hidden)
        self.memory = nn.LSTMCell(config.hidden + 5 * size, config.hidden)
        self.mean = nn.Linear(config.hidden, size)
        self.raw = nn.Linear(config.hidden, size)

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
            Images (N, 9, H, W) and (N, 6, H, W) of `op3.pixels`.
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

    def __init__(self, config: Op3Config) -> None:
        super().__init__()
        size, hidden = config.deterministic + config.stochastic, config.effect
        self.inertia = _mlp(size, size, size)
        self.pair = _mlp(2 * size, 2 * size, size)
        self.effect = _mlp(size, size, hidden)
        self.attention = nn.Sequential(
            nn.Linear(size, size), nn.ELU(), nn.Linear(size, 1), nn.Sigmoid()
        )
        self.merge = _mlp(size + hidden, size, size)
        self.deterministic = _head(size, config.deterministic)
        self.mean = _head(size, config.stochastic)
        self.raw = _head(size, config.stochastic)

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
