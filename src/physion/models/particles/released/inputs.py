"""Inputs of the networks of the published particle code: normalised states and features of nodes.

For the normalised state s = [position, velocity] of a particle and the mean S of those of its
object, the features of a particle are

    attributes (3), s - S for rigid objects and 0 otherwise (6), 0 (3), velocity (3)

Defect kept: the attributes of all particles are 0 (``prepare_input`` in data.py of the published
code sets them for the network DPINet2 alone); only the floor and the objects' nodes have (0, 0, 1).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from physion.models.particles.released.graph import ReleasedGraph, object_means

ATTRIBUTES, STATE = 3, 6
"""Number of attributes of a node, and of components of its state: position and velocity."""
FEATURES = ATTRIBUTES + 2 * STATE
"""Of a node: attributes, offset of the state to the mean of the object, state."""
NODE_ATTRIBUTE = (0.0, 0.0, 1.0)
"""Attributes of the floor and of the nodes of objects; those of particles are 0."""


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
