"""The GNS of the published particle code for Physion, with its defects."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from physion.models.particles.released.graph import ReleasedGraph
from physion.models.particles.released.inputs import (
    ATTRIBUTES,
    FEATURES,
    STATE,
    Normalisation,
    leaf_features,
)
from physion.models.particles.released.layers import (
    Propagator,
    ReluLayers,
    StageLayers,
    ThreeLayers,
    Widths,
    run_stage,
)

STEPS = 10
"""Steps of message passing, all with the same weights."""
RELATION = 5
"""Inputs of a relation of its own: relative position (3), distance, relation attribute."""


class ReleasedGNS(nn.Module):
    """Next velocity of each particle; follows the class GNS of models/GNS.py, with its defects.

    One stage of 10 steps among particles, `layers.run_stage`, from effects of 0, then
    three layers from the effect of a particle to its next velocity. With the published widths it
    has 532,603 weights; they have the published names. Inputs of a relation are, for both ends,
    the attributes and the offset of the state to the mean of the object; and

        x_receiver - x_sender (3),  |x_receiver - x_sender|,  relation attribute 0

    Defects kept, besides those of `graph` and `inputs`:

    - The output is the next velocity and not the acceleration, so that a particle at rest has to be
      learned too.
    - There is no layer norm, and no encoder or decoder per step as in the GNS of Sanchez-Gonzalez
      et al. (2020), from which the name comes.
    - Relations contain no velocities, only the offset of each particle's velocity to the mean of
      its own object: how fast two objects approach each other is no input of a relation.
    - The relation attribute is always 0: its weights are never trained.

    Parameters
    ----------
    normalisation
        Of positions and velocities; by default none, as published.
    widths
        Of the layers.
    steps
        Steps of message passing.
    """

    def __init__(
        self, normalisation: Normalisation | None = None, widths: Widths | None = None,
        steps: int = STEPS,
    ) -> None:  # fmt: skip
        super().__init__()
        widths = widths or Widths()
        effect, relation = widths.effect, widths.relation
        self.widths, self.steps = widths, steps
        self.normalisation = normalisation or Normalisation()
        self.particle_encoder = ReluLayers([FEATURES, widths.particle, effect])
        inputs = 2 * (ATTRIBUTES + STATE) + RELATION
        self.relation_encoder = ReluLayers([inputs, relation, relation, relation])
        self.relation_propagator = Propagator(relation + 2 * effect, effect)
        self.particle_propagator = Propagator(2 * effect, effect)
        self.particle_predictor = ThreeLayers(effect, effect, 3)

    def forward(self, graph: ReleasedGraph) -> Tensor:
        """Return the velocities (P, 3) after the step, m/s."""
        states, features = leaf_features(graph, self.normalisation)
        edges = graph.particles
        apart = states[graph.receivers, :3] - states[graph.senders, :3]
        distance = torch.linalg.vector_norm(apart, dim=1, keepdim=True)
        relation = torch.cat([apart, distance, torch.zeros_like(distance)], 1)
        layers = StageLayers(
            self.particle_encoder, self.relation_encoder, self.relation_propagator,
            self.particle_propagator,
        )  # fmt: skip
        effects = run_stage(
            layers,
            states.new_zeros(len(states), self.widths.effect),
            edges,
            features[:, : ATTRIBUTES + STATE],
            relation,
            features,
            self.steps,
        )
        predicted: Tensor = self.particle_predictor(effects[edges.receiving])
        return self.normalisation.velocity(predicted)
