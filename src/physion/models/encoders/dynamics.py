"""Networks that predict the next feature from those of the context: (B, c, D) to (B, D).

B clips, c = ``context`` frames, D features of one frame; all float32. Source:
docs/official-system.md, section 5.3.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from physion.models.torch_model import initial_weights

Kind = Literal["mlp", "lstm"]


class MlpDynamics(nn.Module):
    """One hidden layer on all context features."""

    def __init__(self, size: int, context: int, hidden: int) -> None:
        super().__init__()
        self.inner = nn.Linear(context * size, hidden)
        self.outer = nn.Linear(hidden, size)

    def forward(self, context: Tensor) -> Tensor:
        """Return the next feature."""
        out: Tensor = self.outer(torch.relu(self.inner(context.flatten(1))))
        return out


class LstmDynamics(nn.Module):
    """One LSTM layer over the context features."""

    def __init__(self, size: int, context: int, hidden: int) -> None:
        super().__init__()
        self.inner = nn.LSTM(size, hidden, batch_first=True)
        self.outer = nn.Linear(hidden, size)

    def forward(self, context: Tensor) -> Tensor:
        """Return the next feature."""
        states, _ = self.inner(context)
        out: Tensor = self.outer(states[:, -1])
        return out


def make_dynamics(
    kind: Kind, size: int, *, context: int, hidden: int, residual: bool, seed: int
) -> MlpDynamics | LstmDynamics:
    """Return dynamics with weights drawn from ``seed``; residual ones add nothing at first."""
    with initial_weights("dynamics", kind, seed):
        network = (MlpDynamics if kind == "mlp" else LstmDynamics)(size, context, hidden)
    if residual:
        nn.init.zeros_(network.outer.weight)
        nn.init.zeros_(network.outer.bias)
    return network
