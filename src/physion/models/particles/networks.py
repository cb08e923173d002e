"""Graph networks of the particle models, in this package's own form.

`MessageNetwork` (GNS): nodes pass messages along edges, in rounds with weights of their own and
residual updates with layer normalisation (Sanchez-Gonzalez et al. 2020).

    m_ij  = f(h_i, h_j, e_ij),     h_i <- h_i + g(h_i, sum_j m_ij)

`ObjectNetwork` (DPI-Net): in addition every object has a node, which receives from those of its
particles that are in the graph (0 if none is) and gives to them in every round (Li et al. 2019).
How the particles of an object are spread is one of its inputs.

    H_o <- H_o + G(H_o, mean_i q_i, max_i q_i),  q_i = q(h_i, sum_j m_ij)
    h_i <- h_i + g(h_i, sum_j m_ij, H_o)

The first layer of f is the sum of three products, W_r h_i + W_s h_j + W_e e_ij, of which the first
two are computed once for every node, not for every edge.

References
----------
A. Sanchez-Gonzalez et al., Learning to simulate complex physics with graph networks, ICML 2020.
Y. Li et al., Learning particle dynamics for manipulating rigid bodies, deformable objects, and
fluids, ICLR 2019.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from physion.models.particles.graph import EDGE, MOMENTS, NODE, OBJECT, Graph
from physion.models.particles.rigid_motion import mean_by


def mlp(inputs: int, width: int, outputs: int, *, normalized: bool = True) -> nn.Sequential:
    """Return two linear layers with a ReLU between them, and layer normalisation at the end."""
    layers = [nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, outputs)]
    return nn.Sequential(*layers, *([nn.LayerNorm(outputs)] if normalized else []))


class JoinedInputs(nn.Sequential):
    """`mlp` of several inputs side by side.

    The first layer is the sum of a product for each input. So nothing is copied into one matrix,
    and what many rows share is multiplied once.
    """

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__(*mlp(inputs, width, width))

    def forward(  # type: ignore[override]
        self, *inputs: Tensor, shared: Tensor | None = None, rows: Tensor | None = None
    ) -> Tensor:
        """Return outputs (n, width) for inputs (n, ...), the last of which is ``shared[rows]``."""
        first = cast(nn.Linear, self[0])
        parts = inputs if shared is None else (*inputs, shared)
        weights = torch.split(first.weight, [part.shape[1] for part in parts], dim=1)
        hidden = nn.functional.linear(inputs[0], weights[0], first.bias)
        for part, weight in zip(inputs[1:], weights[1:], strict=False):
            hidden = hidden + nn.functional.linear(part, weight)
        if shared is not None:
            hidden = hidden + nn.functional.linear(shared, weights[-1])[rows]
        for layer in list(self)[1:]:
            hidden = layer(hidden)
        return hidden


class EdgeMessages(nn.Module):
    """Sum over the senders of messages f(h_i, h_j, e_ij)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.receiver = nn.Linear(width, width)
        self.sender = nn.Linear(width, width, bias=False)
        self.edge = nn.Linear(width, width, bias=False)
        self.out = nn.Linear(width, width)

    def forward(self, nodes: Tensor, edges: Tensor, graph: Graph) -> Tensor:
        """Return the sums (P, width) of the messages that each node receives."""
        hidden = self.edge(edges)
        hidden = hidden + self.receiver(nodes)[graph.receivers]
        hidden = (hidden + self.sender(nodes)[graph.senders]).relu_()
        # The second layer is linear, so it is applied to the sums; its bias counts per message.
        sums = nodes.new_zeros(nodes.shape).index_add(0, graph.receivers, hidden)
        number = torch.bincount(graph.receivers, minlength=len(nodes)).to(nodes.dtype)
        return nn.functional.linear(sums, self.out.weight) + number[:, None] * self.out.bias


class MessageNetwork(nn.Module):
    """Network of GNS: from a graph to a change of displacement of every particle.

    Output (N, 3), in units of the standard deviation of such changes.
    """

    def __init__(self, width: int, rounds: int) -> None:
        super().__init__()
        self.node = JoinedInputs(NODE + OBJECT, width)
        self.edge = mlp(EDGE, width, width)
        self.messages = nn.ModuleList(EdgeMessages(width) for _ in range(rounds))
        self.updates = nn.ModuleList(JoinedInputs(2 * width, width) for _ in range(rounds))
        self.head = mlp(width, width, 3, normalized=False)

    def forward(self, graph: Graph) -> Tensor:
        """Return changes of displacements (N, 3) of the nodes."""
        nodes = self.node(graph.nodes, shared=graph.things, rows=graph.owners)
        edges = self.edge(graph.edges)
        for message, update in zip(self.messages, self.updates, strict=True):
            received = message(nodes, edges, graph)
            nodes = nodes + update(nodes, received)
        out: Tensor = self.head(nodes)
        return out


class ObjectNetwork(nn.Module):
    """Network of DPI-Net: from a graph to changes of objects, and of particles of cloths.

    Outputs: change of velocity (K, 3), of the motion of the rim by the spin (K, 3), and of the
    displacement of every node (N, 3), which counts for cloths; in units of the standard
    deviation of changes of displacements.
    """

    def __init__(self, width: int, rounds: int) -> None:
        super().__init__()
        self.node = mlp(NODE, width, width)
        self.edge = mlp(EDGE, width, width)
        self.object = mlp(OBJECT + MOMENTS, width, width)
        self.messages = nn.ModuleList(EdgeMessages(width) for _ in range(rounds))
        self.gather = nn.ModuleList(JoinedInputs(2 * width, width) for _ in range(rounds))
        self.objects = nn.ModuleList(JoinedInputs(3 * width, width) for _ in range(rounds))
        self.updates = nn.ModuleList(JoinedInputs(3 * width, width) for _ in range(rounds))
        self.rigid_head = mlp(width, width, 6, normalized=False)
        self.loose_head = mlp(width, width, 3, normalized=False)

    def forward(self, graph: Graph) -> tuple[Tensor, Tensor, Tensor]:
        """Return the changes of objects and particles."""
        nodes, edges, things = (
            self.node(graph.nodes),
            self.edge(graph.edges),
            self.object(torch.cat([graph.things, graph.moments], -1)),
        )
        owners, count = graph.owners, len(things)
        layers = zip(self.messages, self.gather, self.objects, self.updates, strict=True)
        for message, gather, join, update in layers:
            received = message(nodes, edges, graph)
            own = gather(nodes, received)
            rows = owners[:, None].expand_as(own)
            largest = own.new_zeros(count, own.shape[1]).scatter_reduce(
                0, rows, own, "amax", include_self=False
            )
            things = things + join(things, mean_by(own, owners, count), largest)
            nodes = nodes + update(nodes, received, shared=things, rows=owners)
        velocity, rim = self.rigid_head(things).split(3, dim=-1)
        return velocity, rim, self.loose_head(nodes)
