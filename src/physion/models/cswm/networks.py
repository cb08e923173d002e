"""Networks of C-SWM: extraction and encoding of slots, and their transition.

- `SlotExtractor`: pictures (N, C, H, W) to K maps (N, K, h, w) in 0..1.
- `SlotEncoder`: each map on its own to a slot z_k (N, K, D), with common weights.
- `SlotTransition`: slots to their changes, a graph network in which every slot receives from every
  other. With what is known of a slot, x_k = z_k, or z_k and its last change,

    m_k = sum_{l != k} f(x_k, x_l),    dz_k = g(x_k, m_k)

References
----------
T. Kipf, E. van der Pol and M. Welling, Contrastive learning of structured world models, ICLR 2020,
section 3 and appendix B.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


class SlotExtractor(nn.Module):
    """Two convolutions, the second with one output channel a slot.

    Parameters
    ----------
    inputs
        Channels of the pictures.
    channels
        Of the first convolution.
    slots
        Number of slots K.
    kernels, strides
        Of the two convolutions.
    """

    def __init__(
        self,
        inputs: int,
        channels: int,
        slots: int,
        kernels: tuple[int, int],
        strides: tuple[int, int],
    ) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, channels, kernels[0], strides[0], padding=kernels[0] // 2)
        self.norm = nn.BatchNorm2d(channels)
        self.second = nn.Conv2d(channels, slots, kernels[1], strides[1])

    def forward(self, pictures: Tensor) -> Tensor:
        """Return the maps (N, K, h, w) of pictures (N, C, H, W)."""
        hidden = functional.leaky_relu(self.norm(self.first(pictures)))
        return torch.sigmoid(self.second(hidden))

    def map_size(self, image_size: int) -> int:
        """Return the pixels per side of the maps of pictures with ``image_size`` pixels."""
        size = image_size
        for layer in (self.first, self.second):
            padding = 2 * int(layer.padding[0])
            size = (size + padding - layer.kernel_size[0]) // layer.stride[0] + 1
        return size


def hidden_layers(inputs: int, hidden: int) -> nn.Sequential:
    """Return two hidden layers of an MLP, the second with layer normalisation."""
    return nn.Sequential(
        nn.Linear(inputs, hidden),
        nn.ReLU(),
        nn.Linear(hidden, hidden),
        nn.LayerNorm(hidden),
        nn.ReLU(),
    )


class SlotEncoder(nn.Module):
    """MLP from the pixels of a map to a slot."""

    def __init__(self, pixels: int, hidden: int, slot_size: int) -> None:
        super().__init__()
        self.hidden = hidden_layers(pixels, hidden)
        self.slot = nn.Linear(hidden, slot_size)

    def forward(self, maps: Tensor) -> Tensor:
        """Return slots (N, K, D) of maps (N, K, h, w)."""
        out: Tensor = self.slot(self.hidden(maps.flatten(2)))
        return out


class SlotTransition(nn.Module):
    """Graph network on the complete graph of the slots; it does not depend on their order.

    Parameters
    ----------
    inputs, outputs
        Number of values that are known of a slot, and of its change.
    hidden
        Units of the hidden layers.
    """

    def __init__(self, inputs: int, outputs: int, hidden: int) -> None:
        super().__init__()
        self.edge = hidden_layers(2 * inputs, hidden)
        self.message = nn.Linear(hidden, hidden)
        self.node = hidden_layers(inputs + hidden, hidden)
        self.change = nn.Linear(hidden, outputs)

    def forward(self, slots: Tensor) -> Tensor:
        """Return the changes (N, K, outputs) of slots (N, K, inputs)."""
        count = slots.shape[1]
        receivers, senders = (~torch.eye(count, dtype=torch.bool)).nonzero().T.to(slots.device)
        pairs = torch.cat([slots[:, receivers], slots[:, senders]], -1)
        # Receivers are in order, K - 1 pairs each.
        messages = self.message(self.edge(pairs)).view(len(slots), count, count - 1, -1).sum(2)
        out: Tensor = self.change(self.node(torch.cat([slots, messages], -1)))
        return out
