"""The DPI-Net of the published particle code for Physion, with its defects."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from physion.models.particles.released.graph import ReleasedGraph, object_means
from physion.models.particles.released.inputs import (
    FEATURES,
    NODE_ATTRIBUTE,
    STATE,
    Normalisation,
    leaf_features,
    without_position,
)
from physion.models.particles.released.layers import (
    Propagator,
    ReluLayers,
    StageLayers,
    ThreeLayers,
    Widths,
    run_stage,
)
from physion.models.particles.released.propagation import EdgeBlock

STAGES = 4
"""Particles to particles, particles to their object, object to itself, object to its particles."""
STEPS = 2
"""Steps of message passing of the first and third stage; the others have one."""
HEAD_SECONDS = 0.01
"""Seconds by which the published head divides, while a step of the training is 0.03 s."""
RIGID_OUTPUTS = 7
"""Quaternion minus the identity (w, x, y, z), translation."""


class ReleasedDPI(nn.Module):
    """Next velocity of each particle; follows the class GNSRigidH of models/GNSRigidH.py.

    Four stages, each with weights of its own, `layers.run_stage`, from effects of 0:
    particles and floor to particles, particles to the node of their object, that node to itself,
    and it to the particles. With the published widths it has 1,978,810 weights; they have the
    published names. Inputs of a relation are the features of both ends and the relation attribute.

    The mean effect of the particles of a rigid object gives a quaternion q and a translation b.
    With the mean x_m of the object's positions x, and sigma the standard deviation of positions:

        R = rotation of ((1, 0, 0, 0) + q) / |(1, 0, 0, 0) + q|
        v = (R (x - x_m) + x_m + sigma b - x) / 0.01 s

    A particle of cloth gets its velocity from its own effect.

    Defects kept, besides those of `graph` and `inputs`:

    - Relations have no relative position: positions are masked, and there is only the offset to the
      centre of the own object. A particle of cloth has no position at all.
    - The head divides by 0.01 s although a step is 0.03 s, so that an object moves by three times
      the predicted displacement, and does not stay rigid when it rotates. The copy in
      neuroailab/physics-models, ``physion/models/particle.py``, divides by 0.03 s: pass it as
      ``head_seconds``.
    - The third stage joins no two objects: ``make_hierarchy`` in data.py pairs the nodes within an
      object, and there is one.
    - The relation attribute is 0 in the first stage and 1 in the others: a second bias.

    Parameters
    ----------
    normalisation
        Of positions and velocities; by default none, as published.
    widths
        Of the layers.
    steps
        Steps of the first and third stage.
    head_seconds
        Seconds by which displacements of rigid objects are divided.
    """

    def __init__(
        self, normalisation: Normalisation | None = None, widths: Widths | None = None,
        steps: int = STEPS, head_seconds: float = HEAD_SECONDS,
    ) -> None:  # fmt: skip
        super().__init__()
        widths = widths or Widths()
        effect, relation = widths.effect, widths.relation
        self.widths, self.steps, self.head_seconds = widths, steps, head_seconds
        self.normalisation = normalisation or Normalisation()
        stages = range(STAGES)
        inputs = 2 * FEATURES + 1
        self.particle_encoder_list = nn.ModuleList(
            ReluLayers([FEATURES, widths.particle, effect]) for _ in stages
        )
        self.relation_encoder_list = nn.ModuleList(
            ReluLayers([inputs, relation, relation, relation]) for _ in stages
        )
        self.relation_propagator_list = nn.ModuleList(
            Propagator(relation + 2 * effect, effect) for _ in stages
        )
        self.particle_propagator_list = nn.ModuleList(
            Propagator(2 * effect, effect) for _ in stages
        )
        self.rigid_particle_predictor = ThreeLayers(effect, effect, RIGID_OUTPUTS)
        self.fluid_particle_predictor = ThreeLayers(effect, effect, 3)

    def forward(self, graph: ReleasedGraph) -> Tensor:
        """Return the velocities (P, 3) after the step, m/s."""
        states, features = leaf_features(graph, self.normalisation)
        features = torch.cat([features, self._object_features(states[:-1], graph)])
        effects = features.new_zeros(len(features), self.widths.effect)
        for number, edges in enumerate(_stages(graph)):
            attribute = features.new_full((1, 1), float(number > 0))
            effects = run_stage(
                self._layers(number), effects, edges, features, attribute, features,
                self.steps if number in (0, 2) else 1,
            )  # fmt: skip
        return self._velocities(effects[: len(graph.positions)], graph)

    def _layers(self, number: int) -> StageLayers:
        lists = (
            self.particle_encoder_list, self.relation_encoder_list, self.relation_propagator_list,
            self.particle_propagator_list,
        )  # fmt: skip
        return StageLayers(*(layers[number] for layers in lists))  # type: ignore[arg-type]

    def _object_features(self, states: Tensor, graph: ReleasedGraph) -> Tensor:
        """Return the features (O, 15) of the nodes of objects: no offset, the mean velocity."""
        count = len(graph.rigid)
        return torch.cat(
            [
                states.new_tensor(NODE_ATTRIBUTE).expand(count, -1),
                states.new_zeros(count, STATE),
                without_position(object_means(states, graph)),
            ],
            1,
        )

    def _velocities(self, effects: Tensor, graph: ReleasedGraph) -> Tensor:
        """Return the velocities (P, 3), m/s, for the effects (P, F) of the particles."""
        motion = self.rigid_particle_predictor(object_means(effects, graph))
        rotation = rotations(motion[:, :4] + motion.new_tensor([1.0, 0.0, 0.0, 0.0]))
        shift = motion[:, 4:] * self.normalisation.position_std
        center = object_means(graph.positions, graph)[graph.owners]
        offset = graph.positions - center
        rotated = (rotation[graph.owners] @ offset[:, :, None])[:, :, 0]
        rigid = (rotated - offset + shift[graph.owners]) / self.head_seconds
        loose = self.normalisation.velocity(self.fluid_particle_predictor(effects))
        return torch.where(graph.rigid[graph.owners, None], rigid, loose)


def rotations(quaternions: Tensor) -> Tensor:
    """Return the rotation matrices (N, 3, 3) of quaternions (N, 4) of any length, (w, x, y, z).

    With q of length 1, R = (w w - v.v) I + 2 v v^T + 2 w [v]x for q = (w, v).
    """
    w, x, y, z = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def _stages(graph: ReleasedGraph) -> list[EdgeBlock]:
    """Return the relations of the four stages; nodes are particles, the floor, objects."""
    count, objects = len(graph.positions), len(graph.rigid)
    leaves, roots = slice(0, count), slice(count + 1, count + 1 + objects)
    leaf = torch.arange(count, device=graph.owners.device)
    root = torch.arange(objects, device=graph.owners.device)
    return [
        graph.particles,
        EdgeBlock(roots, leaves, graph.owners, leaf),
        EdgeBlock(roots, roots, root, root),
        EdgeBlock(leaves, roots, leaf, graph.owners),
    ]
