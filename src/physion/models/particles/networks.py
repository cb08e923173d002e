"""Scenes as graphs, and the graph networks of the particle models.

Inputs of the networks are what nodes, edges and objects know of their motion.

All of it is relative: positions of particles count from the centre of their object, from one
another and from the floor, so that a shift of a scene along the floor changes nothing.

With the last two states of an object, centre c and rotation R, its velocity and spin a step are

    v = c1 - c0,    w = log(R1 R0^T)

and if it keeps this motion (*drift*), a particle at offset r from its centre moves in the next step
by

    u = v + (exp(w) - 1) r

A particle of a cloth moves by its last displacement d. So does a particle of a body that deforms,
but relative to the body's motion, which turns: u = v + exp(w) (d - v). Where the body was rigid
this is the same as above.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from physion.models.particles.bodies import (
    KINEMATIC,
    RIGID,
    Poses,
    SceneParticles,
    fit_rigid,
    mean_by,
    rotation_from_vector,
    vector_from_rotation,
)
from physion.models.particles.neighbours import near_edges, swept_edges

# Particles of several scenes as one set of tensors, and the state of their objects.
#
# Numbers of objects and rows of particles run over all scenes, which lie one after the other, so
# that the graphs of all scenes are one graph without edges between scenes.

I64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SceneLayout:
    """What does not change in time: K objects with P particles of B scenes.

    - ``shape`` (P, 3) float64: offset of a particle from the centre of its object at rest, metres.
    - ``normals`` (P, 3) float64: outward unit normals at rest; 0 where there are none.
    - ``owners`` (P,), ``kinds`` (K,), ``scene`` (K,): see `bodies.SceneParticles`.
    - ``loose`` (C,): rows of the particles that move on their own. ``deforms`` (K,): their objects,
      which are cloths, and bodies that are free.
    - ``links`` (2, L): edges within objects that never change: receivers and senders.
    - ``floor`` (K,): height of the floor, metres. ``size`` (K,): root mean square of ``shape``.
    - ``starts`` (K + 1,), ``scene_array`` (K,), ``moves`` (K,): for `neighbours`, numpy.
    - ``ends`` (B + 1,): rows at which the particles of a scene begin. ``object_ends``: objects.
    """

    shape: Tensor
    normals: Tensor
    owners: Tensor
    kinds: Tensor
    scene: Tensor
    loose: Tensor
    deforms: Tensor
    links: Tensor
    floor: Tensor
    size: Tensor
    starts: I64
    scene_array: I64
    moves: NDArray[np.bool_]
    ends: I64
    object_ends: I64

    @property
    def objects(self) -> int:
        """Number of objects K."""
        return len(self.kinds)

    @property
    def scenes(self) -> int:
        """Number of scenes B."""
        return len(self.ends) - 1

    @property
    def soft_bodies(self) -> Tensor:
        """Which objects (K,) are bodies whose particles move on their own."""
        return self.deforms & (self.kinds == RIGID)


@dataclass(frozen=True, eq=False)
class ObjectState:
    """Where the objects of a `SceneLayout` are; float64, metres.

    - ``centers`` (K, 3): means of the particles. ``rotations`` (K, 3, 3): of bodies; where one
      deforms, the rotation of the rigid motion that fits its particles best.
    - ``loose`` (C, 3): particles that move on their own.
    """

    centers: Tensor
    rotations: Tensor
    loose: Tensor

    def positions(self, layout: SceneLayout) -> Tensor:
        """Return the positions of all particles (P, 3)."""
        rotated = (self.rotations[layout.owners] @ layout.shape[..., None])[..., 0]
        return (self.centers[layout.owners] + rotated).index_copy(0, layout.loose, self.loose)

    def detached(self) -> ObjectState:
        """Return this state without gradient."""
        return ObjectState(self.centers.detach(), self.rotations.detach(), self.loose.detach())


def join_scenes(scenes: Sequence[SceneParticles], device: torch.device) -> SceneLayout:
    """Return the layout of several scenes."""
    counts = np.array([len(scene.owners) for scene in scenes], np.int64)
    objects = np.array([len(scene.kinds) for scene in scenes], np.int64)
    ends, object_ends = (np.concatenate([[0], np.cumsum(n)]) for n in (counts, objects))
    owners = np.concatenate(
        [scene.owners + start for scene, start in zip(scenes, object_ends[:-1], strict=True)]
    )
    shape = np.concatenate([scene.shape for scene in scenes])
    kinds = np.concatenate([scene.kinds for scene in scenes])
    loose = np.flatnonzero(np.concatenate([scene.loose for scene in scenes]))
    deforms = np.isin(np.arange(len(kinds)), owners[loose])
    links = [scene.links + start for scene, start in zip(scenes, ends[:-1], strict=True)]
    total = len(kinds)

    def tensor(values: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(device)

    scene_array = np.repeat(np.arange(len(scenes)), objects)
    return SceneLayout(
        shape=tensor(shape),
        normals=tensor(np.concatenate([scene.normals for scene in scenes])),
        owners=tensor(owners),
        kinds=tensor(kinds),
        scene=tensor(scene_array),
        loose=tensor(loose),
        deforms=tensor(deforms),
        links=tensor(np.concatenate(links, axis=1)),
        floor=tensor(np.repeat([scene.floor for scene in scenes], objects)),
        size=tensor(np.concatenate([scene.sizes for scene in scenes])),
        starts=np.searchsorted(owners, np.arange(total + 1)).astype(np.int64),
        scene_array=scene_array,
        moves=kinds != KINEMATIC,
        ends=ends,
        object_ends=object_ends,
    )


def join_poses(poses: Sequence[Poses], frame: int, device: torch.device) -> ObjectState:
    """Return the state in one row of the motions of several scenes."""
    parts = (
        [motion.centers[frame] for motion in poses],
        [motion.rotations[frame] for motion in poses],
        [motion.loose[frame] for motion in poses],
    )
    centers, rotations, loose = (
        torch.from_numpy(np.concatenate(part)).to(device) for part in parts
    )
    return ObjectState(centers, rotations, loose)


def rotate_scenes(state: ObjectState, layout: SceneLayout, rotations: Tensor) -> ObjectState:
    """Return a state whose scenes rotate about the vertical axis by ``rotations`` (B, 3, 3)."""
    by_object = rotations[layout.scene]
    by_loose = by_object[layout.owners[layout.loose]]
    return ObjectState(
        (by_object @ state.centers[..., None])[..., 0],
        by_object @ state.rotations,
        (by_loose @ state.loose[..., None])[..., 0],
    )


def with_loose(
    layout: SceneLayout, centers: Tensor, rotations: Tensor, loose: Tensor
) -> ObjectState:
    """Return a state in which the poses of objects that deform follow from their particles.

    Their centres are means. The rotation of a body belongs to the rigid motion that fits best;
    fewer than three particles determine none, and it stays as given. The other arguments are as in
    `ObjectState`.
    """
    if len(loose):
        owners = layout.owners[layout.loose]
        means = mean_by(loose, owners, layout.objects)
        centers = torch.where(layout.deforms[:, None], means, centers)
        bodies = layout.soft_bodies
        if bool(bodies.any()):
            fitted, _ = fit_rigid(layout.shape[layout.loose], loose, owners, layout.objects)
            bodies = bodies & (torch.bincount(layout.owners, minlength=layout.objects) > 2)
            rotations = torch.where(bodies[:, None, None], fitted, rotations)
    return ObjectState(centers, rotations, loose)


NODE, EDGE, OBJECT, MOMENTS = 14, 17, 11, 6
"""Sizes of the inputs of nodes, edges and objects, and of the moments of an object."""
_SPIN = 0.1
"""Unit of spins, radians a step."""


@dataclass(frozen=True, eq=False)
class Drift:
    """Motion of the last step, and where it leads.

    - ``velocity``, ``spin`` (K, 3): metres and radians a step.
    - ``positions``, ``normals`` (P, 3): now. ``moves`` (P, 3): displacement in the next step.
    """

    velocity: Tensor
    spin: Tensor
    positions: Tensor
    normals: Tensor
    moves: Tensor


@dataclass(frozen=True, eq=False)
class Graph:
    """Inputs of a network, float32: N nodes, E edges, K objects.

    Nodes are the particles of all objects that can move, and the ones of kinematic bodies that have
    an edge: the others would change nothing. For DPI-Net without edges within bodies, which move as
    wholes, they are the particles of cloths, and of bodies only those that have an edge or, if the
    body can move, come nearer to the floor than the radius in the step.

    - ``particles``: P. ``rows`` (N,): particle of each node. ``owners`` (N,): its object.
    - ``receivers``, ``senders`` (E,): nodes.
    - ``nodes`` (N, `NODE`), ``edges`` (E, `EDGE`), ``things`` (K, `OBJECT`).
    - ``moments`` (K, `MOMENTS`): second moments of the particles of an object about their centre
      along the axes of the world, xx, yy, zz, xy, xz, yz, divided by their trace. They tell how an
      object lies and where it is long. Empty but for DPI-Net.
    """

    particles: int
    rows: Tensor

    receivers: Tensor
    senders: Tensor
    owners: Tensor
    nodes: Tensor
    edges: Tensor
    things: Tensor
    moments: Tensor


def drift_of(layout: SceneLayout, before: ObjectState, now: ObjectState) -> Drift:
    """Return velocities and spins of the last step, and displacements of the next."""
    velocity = now.centers - before.centers
    spin = vector_from_rotation(now.rotations @ before.rotations.transpose(-1, -2))
    positions = now.positions(layout)
    offsets = positions - now.centers[layout.owners]
    turn = rotation_from_vector(spin)
    rotated = (turn[layout.owners] @ offsets[..., None])[..., 0]
    moves = velocity[layout.owners] + rotated - offsets
    last = now.loose - before.loose
    bodies = layout.soft_bodies
    if bool(bodies.any()):
        owners = layout.owners[layout.loose]
        own = velocity[owners]
        turned = own + (turn[owners] @ (last - own)[..., None])[..., 0]
        last = torch.where(bodies[owners][:, None], turned, last)
    moves = moves.index_copy(0, layout.loose, last)
    moves = moves.masked_fill((layout.kinds == KINEMATIC)[layout.owners][:, None], 0.0)
    normals = (now.rotations[layout.owners] @ layout.normals[..., None])[..., 0]
    return Drift(velocity, spin, positions, normals, moves)


def move(
    layout: SceneLayout, now: ObjectState, drift: Drift, change: Tensor, spin: Tensor
) -> ObjectState:
    """Return the state after a step in which velocity and spin of bodies change.

    ``change`` (K, 3) metres a step, ``spin`` (K, 3) radians a step. Kinematic bodies and
    cloths stay: the particles of a cloth move on their own (`move_loose`).
    """
    free = (layout.kinds == RIGID)[:, None]
    centers = now.centers + torch.where(free, drift.velocity + change, 0.0)
    rotations = rotation_from_vector(torch.where(free, drift.spin + spin, 0.0)) @ now.rotations
    return ObjectState(centers, rotations, now.loose)


def move_loose(
    layout: SceneLayout, state: ObjectState, drift: Drift, change: Tensor
) -> ObjectState:
    """Return a state whose loose particles moved, with changes (C, 3) of displacements."""
    loose = state.loose + drift.moves[layout.loose] + change
    return with_loose(layout, state.centers, state.rotations, loose)


def make_graph(
    layout: SceneLayout,
    drift: Drift,
    radius: float,
    unit: float,
    *,
    swept: bool,
    within: bool = False,
    roots: bool = False,
) -> Graph:
    """Return the graph of a state.

    Parameters
    ----------
    layout, drift
        Objects and their motion.
    radius : float
        Metres within which particles of different objects are neighbours.
    unit : float
        Unit of displacements, metres a step.
    swept : bool
        Whether particles that come within the radius during the step are neighbours too.
    within : bool
        Whether particles of one object that are within the radius now are neighbours, too.
    roots : bool
        Whether the graph is for DPI-Net, whose objects have a node.
    """
    moves = drift.moves if swept else torch.zeros_like(drift.moves)
    outer = outer_edges(layout, drift.positions, moves, radius)
    inner = inner_edges(layout, drift.positions, radius) if within else layout.links
    pairs = torch.cat([outer, inner], dim=1)
    used = (layout.kinds != KINEMATIC)[layout.owners]
    if roots and not within:
        # Fast bodies reach the floor within the step, with plain edges too.
        lowest = drift.positions[:, 2] + drift.moves[:, 2].clamp_max(0)
        used &= lowest - layout.floor[layout.owners] < radius
        used[layout.loose] = True
    used[pairs[0]] = True
    rows = used.nonzero()[:, 0]
    node_of = used.long().cumsum(0) - 1
    offsets = (
        drift.positions - mean_by(drift.positions, layout.owners, layout.objects)[layout.owners]
    )
    return Graph(
        particles=len(layout.owners),
        rows=rows,
        receivers=node_of[pairs[0]],
        senders=node_of[pairs[1]],
        owners=layout.owners[rows],
        nodes=_node_inputs(layout, drift, offsets, radius, unit, rows),
        edges=_edge_inputs(drift, pairs, outer.shape[1], radius, unit),
        things=_object_inputs(layout, drift, radius, unit),
        moments=_moments(layout, offsets) if roots else drift.positions.new_zeros(0),
    )


def outer_edges(layout: SceneLayout, positions: Tensor, moves: Tensor, radius: float) -> Tensor:
    """Return the swept pairs (2, E) of particles of different objects, by `neighbours`.

    One of the two objects can move. Both directions, sorted by receiver, then sender; `neighbours`
    says what is swept by ``moves`` (P, 3), metres in the step. The search is on the CPU.
    """
    edges = swept_edges(
        positions.cpu().numpy(),
        moves.cpu().numpy(),
        layout.starts,
        layout.scene_array,
        layout.moves,
        radius,
    )
    return torch.from_numpy(np.stack(edges)).to(positions.device)


def inner_edges(layout: SceneLayout, positions: Tensor, radius: float) -> Tensor:
    """Return the pairs (2, E) of particles of one object that can move, closer than the radius."""
    edges = near_edges(positions.cpu().numpy(), layout.starts, layout.moves, radius)
    return torch.from_numpy(np.stack(edges)).to(positions.device)


def _node_inputs(
    layout: SceneLayout, drift: Drift, offsets: Tensor, radius: float, unit: float, rows: Tensor
) -> Tensor:
    """Return displacement, offset from the centre, normal, heights now and after, and kind.

    ``offsets`` (P, 3): of all particles from the centres of their objects, metres.
    """
    owners, moves = layout.owners[rows], drift.moves[rows]
    # Nothing depends on where the middle of a kinematic body is, which may be metres away.
    kinematic = (layout.kinds == KINEMATIC)[owners][:, None]
    offsets = (offsets[rows] / radius).masked_fill(kinematic, 0.0)
    height = drift.positions[rows, 2] - layout.floor[owners]
    heights = torch.stack([height, height + moves[:, 2]], -1) / radius
    kinds = torch.nn.functional.one_hot(layout.kinds, 3)[owners]
    parts = [moves / unit, offsets, drift.normals[rows], heights.clamp(-2, 1), kinds.double()]
    return torch.cat(parts, dim=-1).float()


def _edge_inputs(drift: Drift, pairs: Tensor, outer: int, radius: float, unit: float) -> Tensor:
    """Return distance now, relative motion, distance when closest, and both along the normals."""
    receivers, senders = pairs
    apart = drift.positions[senders] - drift.positions[receivers]
    relative = drift.moves[senders] - drift.moves[receivers]
    squared = relative.pow(2).sum(-1)
    moment = (-(apart * relative).sum(-1) / squared.clamp_min(1e-12)).clamp(0, 1)
    closest = apart + moment[:, None] * relative
    normals = torch.stack([drift.normals[receivers], drift.normals[senders]], 1)
    along = torch.cat([(normals * vector[:, None]).sum(-1) for vector in (apart, closest)], -1)
    within = torch.zeros_like(moment)
    within[outer:] = 1
    parts = [
        apart / radius,
        apart.norm(dim=-1, keepdim=True) / radius,
        relative / unit,
        closest / radius,
        closest.norm(dim=-1, keepdim=True) / radius,
        along / radius,
        moment[:, None],
        within[:, None],
    ]
    return torch.cat(parts, dim=-1).float()


def _object_inputs(layout: SceneLayout, drift: Drift, radius: float, unit: float) -> Tensor:
    """Return velocity, spin, size, speed of the rim, and kind."""
    kinds = torch.nn.functional.one_hot(layout.kinds, 3).double()
    spin = drift.spin / _SPIN
    rim = drift.spin.norm(dim=-1, keepdim=True) * layout.size[:, None] / unit
    parts = [drift.velocity / unit, spin, layout.size[:, None] / radius, rim, kinds]
    return torch.cat(parts, dim=-1).float()


def _moments(layout: SceneLayout, offsets: Tensor) -> Tensor:
    """Return the second moments (K, `MOMENTS`) of the particles of each object; see `Graph`."""
    products = offsets[:, [0, 1, 2, 0, 0, 1]] * offsets[:, [0, 1, 2, 1, 2, 2]]
    means = mean_by(products, layout.owners, layout.objects)
    return (means / means[:, :3].sum(-1, keepdim=True).clamp_min(1e-12)).float()


# Graph networks of the particle models.
#
# `MessageNetwork` (GNS): nodes pass messages along edges, in rounds with weights of their own and
# residual updates with layer normalisation (Sanchez-Gonzalez et al. 2020).
#
#     m_ij  = f(h_i, h_j, e_ij),     h_i <- h_i + g(h_i, sum_j m_ij)
#
# `ObjectNetwork` (DPI-Net): in addition every object has a node, which receives from the nodes of
# its particles that are in the graph (0 if none is) and gives to them in every round (Li et al.
# 2019). How the particles of an object are spread is one of its inputs.
#
#     H_o <- H_o + G(H_o, mean_i q_i, max_i q_i),  q_i = q(h_i, sum_j m_ij)
#     h_i <- h_i + g(h_i, sum_j m_ij, H_o)
#
# The first layer of f is the sum of three products, W_r h_i + W_s h_j + W_e e_ij, of which the
# first two are computed once for every node, not for every edge.
#
# References
# ----------
# A. Sanchez-Gonzalez et al., Learning to simulate complex physics with graph networks, ICML 2020.
# Y. Li et al., Learning particle dynamics for manipulating rigid bodies, deformable objects, and
# fluids, ICLR 2019.


def mlp(inputs: int, width: int, outputs: int, *, normalized: bool = True) -> nn.Sequential:
    """Return two linear layers with a ReLU between them, and layer normalisation at the end."""
    layers = [nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, outputs)]
    return nn.Sequential(*layers, *([nn.LayerNorm(outputs)] if normalized else []))


class JoinedInputs(nn.Sequential):
    """`mlp` of several inputs side by side.

    The first layer is the sum of a product for each input. So nothing is copied into one matrix,
    and rows that are used several times are multiplied once.
    """

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__(*mlp(inputs, width, width))

    def forward(  # type: ignore[override]
        self, *inputs: Tensor, shared: Tensor | None = None, rows: Tensor | None = None
    ) -> Tensor:
        """Return outputs (n, width) for inputs (n, ...), the last of which is ``shared[rows]``."""
        first = cast("nn.Linear", self[0])
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
