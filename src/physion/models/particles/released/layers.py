"""Layers of the networks of the published particle code, and one stage of message passing.

They follow models/GNS.py and models/GNSRigidH.py, which share them. `gns` and `dpi` put them
together; the attributes of the layers have the published names.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from physion.models.particles.released.propagation import EdgeBlock, StepWeights, propagate

EDGES_AT_ONCE = 2048
"""Edges that a CPU takes through the layers together: their numbers then stay in its cache."""


@dataclass(frozen=True)
class Widths:
    """Widths of the layers of particles, relations and effects; as published by default."""

    particle: int = 200
    relation: int = 300
    effect: int = 200


class ReluLayers(nn.Module):
    """Linear layers, a ReLU after each: ParticleEncoder and RelationEncoder of models/GNS.py."""

    def __init__(self, sizes: Sequence[int]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in itertools.pairwise(sizes):
            layers += [nn.Linear(inputs, outputs), nn.ReLU()]
        self.model = nn.Sequential(*layers)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the last layer's outputs (N, last size) for inputs (N, first size)."""
        outputs: Tensor = self.model(inputs)
        return outputs

    @property
    def linear(self) -> list[nn.Linear]:
        """Linear layers, first to last."""
        return [layer for layer in self.model if isinstance(layer, nn.Linear)]


class Propagator(nn.Module):
    """One matrix and bias; what is done with them is in `run_stage`."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)


class ThreeLayers(nn.Module):
    """Three linear layers, with a ReLU after the first two: ParticlePredictor of models/GNS.py."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.linear_0 = nn.Linear(inputs, hidden)
        self.linear_1 = nn.Linear(hidden, hidden)
        self.linear_2 = nn.Linear(hidden, outputs)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the outputs (N, outputs) for inputs (N, inputs)."""
        outputs: Tensor = self.linear_2(self.linear_1(self.linear_0(inputs).relu()).relu())
        return outputs


@dataclass(frozen=True, eq=False)
class StageLayers:
    """Layers of one stage; the same weights serve all of its steps."""

    particle_encoder: ReluLayers
    relation_encoder: ReluLayers
    relation_propagator: Propagator
    particle_propagator: Propagator


def run_stage(
    layers: StageLayers, states: Tensor, edges: EdgeBlock, features: Tensor, relation: Tensor,
    own: Tensor, steps: int,
) -> Tensor:  # fmt: skip
    """Return the effects (N, F) after the steps of one stage.

    With p the encoded features of a node and c those of a relation, encoded once a stage, a step is

        e = max(A [c, h_receiver, h_sender] + a, 0),   h = max(B [p, sum of e] + b + h, 0)

    as ``forward`` of GNS and GNSRigidH. The matrices are applied in parts, see `propagation`.

    Parameters
    ----------
    layers
        The encoders, A and a, B and b.
    states : (N, F)
        Effects h before.
    edges
        E relations from S sending to R receiving nodes.
    features : (N, A)
        Inputs of a relation that belong to one of its nodes.
    own : (N, FEATURES)
        Inputs of the encoder of nodes.
    relation : (E, B) or (1, B)
        Inputs that belong to the relation itself; one row if the same for all.
    steps
        Number of steps.
    """
    matrix, message = layers.relation_propagator.linear, layers.particle_propagator.linear
    width = states.shape[1]
    to_edge, receiver, sender = matrix.weight.split_with_sizes(
        [matrix.in_features - 2 * width, width, width], 1
    )
    to_node, to_sum = message.weight.split_with_sizes([width, width], 1)
    parts = _encode_relations(
        layers.relation_encoder, edges, features, relation, to_edge, matrix.bias
    )
    encoded = layers.particle_encoder(own[edges.receiving])
    node_part = torch.addmm(message.bias, encoded, to_node.T)
    return propagate(states, edges, parts, node_part, StepWeights(receiver, sender, to_sum), steps)


def _encode_relations(
    encoder: ReluLayers, edges: EdgeBlock, features: Tensor, relation: Tensor, matrix: Tensor,
    bias: Tensor,
) -> Tensor:  # fmt: skip
    """Return M f(x) + m (E, F) for the encoder f of relations x and the matrix M with bias m.

    x joins the features of receiver and sender with those of the relation. The first layer
    W = [W_1, W_2, W_3] is applied to nodes: W x = W_1 x_receiver + W_2 x_sender + W_3 x_relation.
    """
    first, *others = encoder.linear
    count = features.shape[1]
    to_receiver, to_sender, to_relation = first.weight.split_with_sizes(
        [count, count, relation.shape[1]], 1
    )
    from_receiver = features[edges.receiving] @ to_receiver.T
    from_sender = features[edges.sending] @ to_sender.T
    total = len(edges.receivers)
    at_once = EDGES_AT_ONCE if features.device.type == "cpu" else max(total, 1)
    parts = []
    for start in range(0, max(total, 1), at_once):
        some = slice(start, start + at_once)
        own = relation if len(relation) == 1 else relation[some]
        x = from_receiver.index_select(0, edges.receivers[some])
        x = x + from_sender.index_select(0, edges.senders[some])
        x = (x + torch.addmm(first.bias, own, to_relation.T)).relu_()
        for layer in others:
            x = layer(x).relu_()
        parts.append(torch.addmm(bias, x, matrix.T))
    return torch.cat(parts)
