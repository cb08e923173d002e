"""Graph networks of the particle models, in this package's own form.

`MessageNetwork` (GNS): nodes pass messages along edges, in rounds with weights of their own and
residual updates with layer normalisation (Sanchez-Gonzalez et al. 2020).

    m_ij  = f(h_i, h_j, e_ij),     h_i <- h_i + g(h_i, sum_j m_ij)

`ObjectNetwork` (DPI-Net): in addition every object has a node, which receives from its particles
and gives to them in every round (Li et al. 2019).

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

import torch
from torch import Tensor, nn

from physion.models.particles.graph import EDGE, NODE, OBJECT, Graph
from physion.models.particles.rigid_motion import mean_by


def mlp(inputs: int, width: int, outputs: int, *, normalized: bool = True) -> nn.Sequential:
    """Return two linear layers with a ReLU between them, and layer normalisation at the end."""
    layers = [nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, outputs)]
    return nn.Sequential(*layers, *([nn.LayerNorm(outputs)] if normalized else []))


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
        self.node = mlp(NODE + OBJECT, width, width)
        self.edge = mlp(EDGE, width, width)
        self.messages = nn.ModuleList(EdgeMessages(width) for _ in range(rounds))
        self.updates = nn.ModuleList(mlp(2 * width, width, width) for _ in range(rounds))
        self.head = mlp(width, width, 3, normalized=False)

    def forward(self, graph: Graph) -> Tensor:
        """Return changes of displacements (N, 3) of the nodes."""
        nodes = self.node(torch.cat([graph.nodes, graph.things[graph.owners]], -1))
        edges = self.edge(graph.edges)
        for message, update in zip(self.messages, self.updates, strict=True):
            received = message(nodes, edges, graph)
            nodes = nodes + update(torch.cat([nodes, received], -1))
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
        self.object = mlp(OBJECT, width, width)
        self.messages = nn.ModuleList(EdgeMessages(width) for _ in range(rounds))
        self.gather = nn.ModuleList(mlp(2 * width, width, width) for _ in range(rounds))
        self.objects = nn.ModuleList(mlp(3 * width, width, width) for _ in range(rounds))
        self.updates = nn.ModuleList(mlp(3 * width, width, width) for _ in range(rounds))
        self.rigid_head = mlp(width, width, 6, normalized=False)
        self.loose_head = mlp(width, width, 3, normalized=False)

    def forward(self, graph: Graph) -> tuple[Tensor, Tensor, Tensor]:
        """Return the changes of objects and particles."""
        nodes, edges, things = (
            self.node(graph.nodes),
            self.edge(graph.edges),
            self.object(graph.things),
        )
        owners, count = graph.owners, len(things)
        layers = zip(self.messages, self.gather, self.objects, self.updates, strict=True)
        for message, gather, join, update in layers:
            received = message(nodes, edges, graph)
            own = gather(torch.cat([nodes, received], -1))
            rows = owners[:, None].expand_as(own)
            largest = own.new_zeros(count, own.shape[1]).scatter_reduce(
                0, rows, own, "amax", include_self=False
            )
            things = things + join(torch.cat([things, mean_by(own, owners, count), largest], -1))
            nodes = nodes + update(torch.cat([nodes, received, things[owners]], -1))
        velocity, rim = self.rigid_head(things).split(3, dim=-1)
        return velocity, rim, self.loose_head(nodes)
