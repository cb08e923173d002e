"""Graph of the published particle code: neighbours, each particle itself, and the floor.

Published code: https://github.com/htung0101/Physion-particles. Its defects, all kept:

- The floor is one node at the origin. Relations that contain a position relative to it therefore
  contain the absolute position of the particle: the networks are not translation invariant.
- Each particle is its own neighbour.

Heights are z here, y there.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from physion.core.errors import BadInputError
from physion.models.particles.released.propagation import EdgeBlock

NEAR_FLOOR = 0.1
"""Metres above z = 0 below which a particle is related to the floor."""


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


def object_means(values: Tensor, graph: ReleasedGraph) -> Tensor:
    """Return the mean (O, F) of values (P, F) over the particles of each object."""
    sums = values.new_zeros(len(graph.rigid), values.shape[1]).index_add_(0, graph.owners, values)
    counts = torch.bincount(graph.owners, minlength=len(graph.rigid))
    return sums / counts[:, None].to(values.dtype)
