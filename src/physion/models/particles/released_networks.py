"""Parts of the networks of the published particle code for Physion: graph, inputs and layers.

They follow https://github.com/htung0101/Physion-particles, named *published* below, with its
defects. `released_gns` and `released_dpi` put them together.

Known defects of the published graph and inputs, all kept:

- Material attributes of all particles are 0 (``prepare_input`` in data.py sets them for the network
  DPINet2 alone); only the floor and the objects' nodes have the attribute (0, 0, 1).
- The floor is one node at the origin. Relations that contain a position relative to it therefore
  contain the absolute position of the particle: the networks are not translation invariant.
- Each particle is its own neighbour.
- The node of an object is related to itself and to its particles, but not to the nodes of other
  objects: ``make_hierarchy`` in data.py pairs the nodes within an object, and there is one.
- The relation attribute is 0 between particles and 1 elsewhere, a second bias.

Heights are z here, y there. Node features before any layer, for the normalised state
s = [position, velocity] of a particle and the mean S of those of its object:

    attribute (3), s - S for rigid objects and 0 otherwise (6), 0 and velocity (6)
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from physion.errors import BadInputError
from physion.models.particles.propagation import EdgeBlock, StepWeights, propagate

ATTRIBUTES, STATE = 3, 6
"""Number of attributes of a node, and of components of its state: position and velocity."""
FEATURES = ATTRIBUTES + 2 * STATE
"""Of a node: attributes, offset of the state to the mean of the object, state."""
NODE_ATTRIBUTE = (0.0, 0.0, 1.0)
"""Attributes of the floor and of the nodes of objects; those of particles are 0."""
NEAR_FLOOR = 0.1
"""Metres above z = 0 below which a particle is related to the floor."""
EDGES_AT_ONCE = 2048
"""Edges that a CPU takes through the layers together: their numbers then stay in its cache."""


@dataclass(frozen=True)
class Widths:
    """Widths of the layers of particles, relations and effects; as published by default."""

    particle: int = 200
    relation: int = 300
    effect: int = 200


@dataclass(frozen=True, eq=False)
class ReleasedGraph:
    """Particles of one or many scenes and their relations; made by `released_graph`.

    - ``positions``, ``velocities`` (P, 3): metres above the floor z = 0, m/s.
    - ``owners`` (P,): object of each particle, int64, 0 to O - 1.
    - ``rigid`` (O,): whether an object is rigid, not cloth.
    - ``receivers``, ``senders`` (E,): relations, int64. The sender P is the floor.
    """

    positions: Tensor
    velocities: Tensor
    owners: Tensor
    rigid: Tensor
    receivers: Tensor
    senders: Tensor

    @property
    def particles(self) -> EdgeBlock:
        """Relations from particles and the floor to particles."""
        count = len(self.positions)
        return EdgeBlock(slice(0, count), slice(0, count + 1), self.receivers, self.senders)


def released_graph(
    positions: Tensor, velocities: Tensor, owners: Tensor, rigid: Tensor, receivers: Tensor,
    senders: Tensor,
) -> ReleasedGraph:  # fmt: skip
    """Return the published graph: neighbours, each particle itself, and the floor.

    Follows ``prepare_input`` with ``floor_cheat`` in data.py. Many scenes make one graph if their
    neighbours are searched apart: one floor node serves all, since nothing reaches it.

    Parameters
    ----------
    positions, velocities : (P, 3)
        Metres, with the floor at z = 0, and m/s.
    owners : (P,)
        Object of each particle, int64; each object from 0 to O - 1 has a particle.
    rigid : (O,)
        Whether an object is rigid, not cloth.
    receivers, senders : (E,)
        Different particles at most 0.08 m apart, in both directions, without order.

    Raises
    ------
    BadInputError
        If there is no particle, an object has none, or arrays do not fit each other.
    """
    count, objects = len(positions), len(rigid)
    if count == 0 or positions.shape != (count, 3) or velocities.shape != (count, 3):
        raise BadInputError(
            "a graph needs positions and velocities (P, 3) of at least one particle, not "
            f"{tuple(positions.shape)} and {tuple(velocities.shape)}"
        )
    if owners.shape != (count,) or not bool(((owners >= 0) & (owners < objects)).all()):
        raise BadInputError(
            f"each of the {count} particles needs the number of one of the {objects} objects, not "
            f"{owners.tolist()[:5]} ..."
        )
    empty = torch.bincount(owners, minlength=objects) == 0
    if bool(empty.any()):
        raise BadInputError(
            f"object {int(empty.nonzero()[0])} of the graph has no particles: leave it out"
        )
    itself = torch.arange(count, device=positions.device)
    near = (positions[:, 2] < NEAR_FLOOR).nonzero()[:, 0]
    to = torch.cat([receivers, itself, near])
    origin = torch.cat([senders, itself, torch.full_like(near, count)])
    order = torch.argsort(to * (count + 1) + origin)
    return ReleasedGraph(positions, velocities, owners, rigid, to[order], origin[order])


class Normalisation(nn.Module):
    """Mean and standard deviation of positions and velocities, as ``normalize`` in data.py.

    A standard deviation of 0 counts as 1. The published training used zeros for all, so that
    metres and m/s stay as they are.
    """

    position_mean: Tensor
    position_std: Tensor
    velocity_mean: Tensor
    velocity_std: Tensor

    def __init__(self, position: Tensor | None = None, velocity: Tensor | None = None) -> None:
        super().__init__()
        for name, given in (("position", position), ("velocity", velocity)):
            mean, std = torch.zeros(2, 3) if given is None else given.clone()
            self.register_buffer(f"{name}_mean", mean)
            self.register_buffer(f"{name}_std", torch.where(std == 0, torch.ones_like(std), std))

    def forward(self, positions: Tensor, velocities: Tensor) -> Tensor:
        """Return the normalised state (N, 6) of positions and velocities (N, 3)."""
        place = (positions - self.position_mean) / self.position_std
        speed = (velocities - self.velocity_mean) / self.velocity_std
        return torch.cat([place, speed], 1)

    def velocity(self, normalised: Tensor) -> Tensor:
        """Return velocities (N, 3) in m/s."""
        return normalised * self.velocity_std + self.velocity_mean


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


def object_means(values: Tensor, graph: ReleasedGraph) -> Tensor:
    """Return the mean (O, F) of values (P, F) over the particles of each object."""
    sums = values.new_zeros(len(graph.rigid), values.shape[1]).index_add_(0, graph.owners, values)
    counts = torch.bincount(graph.owners, minlength=len(graph.rigid))
    return sums / counts[:, None].to(values.dtype)


def leaf_features(graph: ReleasedGraph, normalisation: Normalisation) -> tuple[Tensor, Tensor]:
    """Return the normalised states (P + 1, 6) and features (P + 1, 15) of particles and floor."""
    floor = graph.positions.new_zeros(1, 3)
    states = normalisation(
        torch.cat([graph.positions, floor]), torch.cat([graph.velocities, floor])
    )
    means = object_means(states[:-1], graph)
    offsets = (states[:-1] - means[graph.owners]) * graph.rigid[graph.owners, None]
    attributes = states.new_zeros(len(states), ATTRIBUTES)
    attributes[-1] = attributes.new_tensor(NODE_ATTRIBUTE)
    none = states.new_zeros(1, STATE)
    return states, torch.cat([attributes, torch.cat([offsets, none]), without_position(states)], 1)


def without_position(states: Tensor) -> Tensor:
    """Return states (N, 6) whose positions are 0."""
    return torch.cat([torch.zeros_like(states[:, :3]), states[:, 3:]], 1)
