"""Networks `released`: equal to the published equations, edge by edge and object by object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from physion.core import seeds
from physion.core.errors import BadInputError
from physion.models.particles.neighbours import radius_edges
from physion.models.particles.released import (
    Normalisation,
    ReleasedDPI,
    ReleasedGNS,
    ReleasedGraph,
    released_graph,
)

RADIUS = 0.08
Weights = dict[str, Tensor]


def random_graph(
    seed: str, sizes: tuple[int, ...], rigid: tuple[bool, ...], dtype: torch.dtype = torch.float64
) -> ReleasedGraph:
    """Objects of random particles, one next to the other, some below and some above 0.1 m."""
    rng = seeds.generator("released", seed)
    centers = np.repeat(np.arange(len(sizes)) * [[0.12], [0.05], [0.03]], sizes, axis=1).T
    points = centers + rng.uniform(0, 0.18, (sum(sizes), 3))
    receivers, senders = radius_edges(points, np.zeros(len(points), np.int64), RADIUS)
    return released_graph(
        torch.tensor(points, dtype=dtype),
        torch.tensor(rng.normal(size=points.shape), dtype=dtype),
        torch.tensor(np.repeat(np.arange(len(sizes)), sizes)),
        torch.tensor(rigid),
        torch.tensor(receivers),
        torch.tensor(senders),
    )


def random_normalisation(seed: str) -> Normalisation:
    rng = seeds.generator("released normalisation", seed)
    position, velocity = torch.tensor(rng.uniform(0.3, 1.5, (2, 2, 3)), dtype=torch.float32)
    velocity[1, 2] = 0  # counts as 1
    return Normalisation(position, velocity)


def seeded(network: type[nn.Module], dtype: torch.dtype, **options: object) -> nn.Module:
    """Return a network with random weights, larger than usual so that errors show."""
    torch.manual_seed(3)
    made = network(**options).to(dtype)
    with torch.no_grad():
        for weight in made.parameters():
            weight *= 1.3
    return made


def affine(weights: Weights, name: str, x: Tensor) -> Tensor:
    return weights[f"{name}.weight"] @ x + weights[f"{name}.bias"]


def encoded(weights: Weights, name: str, count: int, x: Tensor) -> Tensor:
    for layer in range(count):
        x = affine(weights, f"{name}.model.{2 * layer}", x).relu()
    return x


def predicted(weights: Weights, name: str, x: Tensor) -> Tensor:
    x = affine(weights, f"{name}.linear_0", x).relu()
    return affine(weights, f"{name}.linear_2", affine(weights, f"{name}.linear_1", x).relu())


def plain_inputs(network: nn.Module, graph: ReleasedGraph) -> tuple[list[Tensor], list[Tensor]]:
    """Return the normalised state, and attributes with offset, of each particle and the floor."""
    norm = network.normalisation
    states, attributes = [], []
    for x, v in zip(graph.positions, graph.velocities, strict=True):
        states.append(torch.cat([(x - norm.position_mean) / norm.position_std,
                                 (v - norm.velocity_mean) / norm.velocity_std]))  # fmt: skip
    for row, owner in enumerate(graph.owners.tolist()):
        offset = torch.zeros(6, dtype=states[0].dtype)
        if graph.rigid[owner]:
            members = [states[i] for i in (graph.owners == owner).nonzero()[:, 0]]
            offset = states[row] - sum(members) / len(members)
        attributes.append(torch.cat([torch.zeros(3, dtype=offset.dtype), offset]))
    nothing = torch.zeros(3, dtype=states[0].dtype)
    states.append(torch.cat([(nothing - norm.position_mean) / norm.position_std,
                             (nothing - norm.velocity_mean) / norm.velocity_std]))  # fmt: skip
    attributes.append(torch.tensor([0, 0, 1, 0, 0, 0, 0, 0, 0], dtype=states[0].dtype))
    return states, attributes


def masked(state: Tensor) -> Tensor:
    return state * torch.tensor([0, 0, 0, 1, 1, 1], dtype=state.dtype)


def plain_stage(weights: Weights, names: list[str], nodes: dict[int, Tensor],
                relations: list[tuple[int, int, Tensor]], effects: list[Tensor],
                steps: int) -> list[Tensor]:  # fmt: skip
    """Return the effects after the steps: per relation, all inputs joined, one full matrix."""
    node_encoder, relation_encoder, relation_matrix, node_matrix = names
    codes = {row: encoded(weights, node_encoder, 2, x) for row, x in nodes.items()}
    between = [encoded(weights, relation_encoder, 3, x) for _, _, x in relations]
    for _ in range(steps):
        sums = {row: torch.zeros_like(effects[0]) for row in nodes}
        for (r, s, _), code in zip(relations, between, strict=True):
            joined = torch.cat([code, effects[r], effects[s]])
            sums[r] = sums[r] + affine(weights, f"{relation_matrix}.linear", joined).relu()
        after = list(effects)
        for row, code in codes.items():
            joined = torch.cat([code, sums[row]])
            after[row] = (affine(weights, f"{node_matrix}.linear", joined) + effects[row]).relu()
        effects = after
    return effects


def plain_gns(network: ReleasedGNS, graph: ReleasedGraph) -> Tensor:
    weights = dict(network.named_parameters())
    states, attributes = plain_inputs(network, graph)
    nodes = {i: torch.cat([attributes[i], masked(states[i])]) for i in range(len(states) - 1)}
    relations = []
    for r, s in zip(graph.receivers.tolist(), graph.senders.tolist(), strict=True):
        apart = states[r][:3] - states[s][:3]
        own = torch.cat([apart, (apart @ apart).sqrt()[None], torch.zeros_like(apart[:1])])
        relations.append((r, s, torch.cat([attributes[r], attributes[s], own])))
    names = ["particle_encoder", "relation_encoder", "relation_propagator", "particle_propagator"]
    effects = [torch.zeros(200, dtype=states[0].dtype)] * len(states)
    effects = plain_stage(weights, names, nodes, relations, effects, 10)
    out = torch.stack([predicted(weights, "particle_predictor", h) for h in effects[:-1]])
    return out * network.normalisation.velocity_std + network.normalisation.velocity_mean


def plain_dpi(network: ReleasedDPI, graph: ReleasedGraph) -> Tensor:
    weights = dict(network.named_parameters())
    norm = network.normalisation
    states, attributes = plain_inputs(network, graph)
    count, dtype = len(states) - 1, states[0].dtype
    members = [(graph.owners == k).nonzero()[:, 0].tolist() for k in range(len(graph.rigid))]
    for rows in members:
        states.append(sum(states[i] for i in rows) / len(rows))
        attributes.append(attributes[count])
    features = [torch.cat([a, masked(s)]) for a, s in zip(attributes, states, strict=True)]
    root = [count + 1 + k for k in range(len(members))]
    leaf_root = [(root[k], i) for k, rows in enumerate(members) for i in rows]
    pairs = [
        list(zip(graph.receivers.tolist(), graph.senders.tolist(), strict=True)),
        leaf_root,
        [(row, row) for row in root],
        [(i, row) for row, i in leaf_root],
    ]
    effects = [torch.zeros(200, dtype=dtype)] * len(states)
    for stage, steps in enumerate((2, 1, 2, 1)):
        attribute = torch.tensor([float(stage > 0)], dtype=dtype)
        relations = [
            (r, s, torch.cat([features[r], features[s], attribute])) for r, s in pairs[stage]
        ]
        nodes = {i: features[i] for i in (root if stage in (1, 2) else range(count))}
        kinds = ("particle_encoder", "relation_encoder", "relation_propagator",
                 "particle_propagator")  # fmt: skip
        names = [f"{kind}_list.{stage}" for kind in kinds]
        effects = plain_stage(weights, names, nodes, relations, effects, steps)
    out = [torch.zeros(3, dtype=dtype)] * count
    for k, rows in enumerate(members):
        if graph.rigid[k]:
            mean = sum(effects[i] for i in rows) / len(rows)
            head = predicted(weights, "rigid_particle_predictor", mean)
            q = head[:4] + torch.tensor([1.0, 0, 0, 0], dtype=dtype)
            w, v = (q / q.norm())[0], (q / q.norm())[1:]
            x = graph.positions[rows]
            for i, d in zip(rows, x - x.mean(0), strict=True):
                rotated = d + 2 * torch.linalg.cross(v, torch.linalg.cross(v, d) + w * d)
                moved = rotated + x.mean(0) + head[4:] * norm.position_std
                out[i] = (moved - graph.positions[i]) / 0.01
        else:
            for i in rows:
                head = predicted(weights, "fluid_particle_predictor", effects[i])
                out[i] = head * norm.velocity_std + norm.velocity_mean
    return torch.stack(out)


PLAIN = {ReleasedGNS: plain_gns, ReleasedDPI: plain_dpi}
NETWORKS = pytest.mark.parametrize("network", [ReleasedGNS, ReleasedDPI])


def relative(a: Tensor, b: Tensor) -> float:
    """Largest difference as part of the largest value."""
    return float(((a - b).abs().max() / b.abs().max()).detach())


@NETWORKS
@pytest.mark.parametrize(("dtype", "limit"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("normalised", [False, True])
def test_outputs_and_gradients_are_those_of_the_published_equations(
    network: type[nn.Module], dtype: torch.dtype, limit: float, normalised: bool
) -> None:
    normalisation = random_normalisation("equations") if normalised else None
    net = seeded(network, dtype, normalisation=normalisation)
    graph = random_graph("equations", (14, 9, 1, 11), (True, False, True, True), dtype)
    assert len(graph.receivers) > 100 and (graph.senders == len(graph.positions)).sum() > 5
    results = []
    for forward in (net, lambda g: PLAIN[network](net, g)):
        net.zero_grad()
        out = forward(graph)
        (out / out.detach().abs().max()).square().sum().backward()
        results.append((out.detach(), {name: w.grad for name, w in net.named_parameters()}))
    (ours, our_gradients), (plain, plain_gradients) = results
    assert plain.std(0).min() > 0.01 * plain.abs().max()  # no test on constant outputs
    assert relative(ours, plain) < limit
    if dtype == torch.float32:
        return  # a rounding error at the corner of one ReLU changes a gradient by far more
    for name, gradient in plain_gradients.items():
        if gradient.abs().max() > 0:
            assert relative(our_gradients[name], gradient) < 10 * limit, name
        else:
            assert not our_gradients[name].any()


@NETWORKS
def test_a_graph_of_many_scenes_gives_the_results_of_each(network: type[nn.Module]) -> None:
    net = seeded(network, torch.float64)
    first = random_graph("first", (12, 7), (True, False))
    second = random_graph("second", (5, 16, 3), (True, True, False))
    count, objects = len(first.positions), len(first.rigid)

    def without_floor(graph: ReleasedGraph, add: int) -> tuple[Tensor, Tensor]:
        pairs = graph.senders < len(graph.positions)
        different = pairs & (graph.senders != graph.receivers)
        return graph.receivers[different] + add, graph.senders[different] + add

    edges = zip(without_floor(first, 0), without_floor(second, count), strict=True)
    both = released_graph(
        torch.cat([first.positions, second.positions]),
        torch.cat([first.velocities, second.velocities]),
        torch.cat([first.owners, second.owners + objects]),
        torch.cat([first.rigid, second.rigid]),
        *(torch.cat(pair) for pair in edges),
    )
    with torch.no_grad():
        alone = torch.cat([net(first), net(second)])
        assert relative(net(both), alone) < 1e-12


@pytest.mark.parametrize(("network", "count"), [(ReleasedGNS, 532_603), (ReleasedDPI, 1_978_810)])
def test_the_number_of_weights_is_that_of_the_published_code(
    network: type[nn.Module], count: int
) -> None:
    assert sum(weight.numel() for weight in network().parameters()) == count


@NETWORKS
def test_one_particle_without_neighbours_works(network: type[nn.Module]) -> None:
    net = seeded(network, torch.float64)
    graph = random_graph("one", (1,), (True,))
    assert len(graph.receivers) <= 2  # itself and the floor
    assert relative(net(graph), PLAIN[network](net, graph)) < 1e-12
    none = replace(graph, receivers=graph.receivers[:0], senders=graph.senders[:0])
    assert relative(net(none), PLAIN[network](net, none)) < 1e-12


def test_the_floor_is_related_to_particles_below_a_tenth_of_a_metre() -> None:
    points = torch.tensor([[0.0, 0, 0.099], [0, 0, 0.2], [5, 5, -1]])
    none = torch.zeros(0, dtype=torch.int64)
    graph = released_graph(
        points, points, torch.tensor([0, 0, 1]), torch.tensor([True, True]), none, none
    )
    pairs = list(zip(graph.receivers.tolist(), graph.senders.tolist(), strict=True))
    assert pairs == [(0, 0), (0, 3), (1, 1), (2, 2), (2, 3)]


def test_gns_depends_on_the_absolute_position_near_the_floor_alone() -> None:
    """A kept defect: the floor is a node at the origin."""
    net = seeded(ReleasedGNS, torch.float64)
    near = random_graph("near", (6, 5), (True, True))
    far = random_graph("near", (6, 5), (True, True))
    high = near.senders < len(near.positions)
    near_moved = replace(near, positions=near.positions + torch.tensor([3.0, 0, 0]))
    without = replace(far, receivers=far.receivers[high], senders=far.senders[high])
    without_moved = replace(without, positions=without.positions + torch.tensor([3.0, 0, 0]))
    assert relative(net(near_moved), net(near)) > 1e-3
    assert relative(net(without_moved), net(without)) < 1e-10


def test_dpi_knows_no_position_of_cloth() -> None:
    """A kept defect: moving single particles changes nothing as long as relations stay."""
    net = seeded(ReleasedDPI, torch.float64)
    graph = random_graph("cloth", (12,), (False,))
    moved = replace(graph, positions=graph.positions + torch.rand_like(graph.positions))
    assert torch.equal(net(moved), net(graph))


def test_dpi_divides_by_the_seconds_of_its_head() -> None:
    graph = random_graph("head", (12, 5), (True, True))
    as_published = seeded(ReleasedDPI, torch.float64)(graph)
    by_the_step = seeded(ReleasedDPI, torch.float64, head_seconds=0.03)(graph)
    assert relative(3 * by_the_step, as_published) < 1e-12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": torch.zeros(0, 3)}, "at least one particle"),
        ({"velocities": torch.zeros(2, 3)}, "positions and velocities"),
        ({"owners": torch.tensor([0, 0, 2])}, "one of the 2 objects"),
        ({"owners": torch.tensor([0, 0, 0])}, "object 1 of the graph has no particles"),
    ],
)
def test_graphs_without_particles_are_refused(change: dict[str, Tensor], message: str) -> None:
    none = torch.zeros(0, dtype=torch.int64)
    given = {
        "positions": torch.zeros(3, 3), "velocities": torch.zeros(3, 3),
        "owners": torch.tensor([0, 0, 1]), "rigid": torch.tensor([True, True]),
        "receivers": none, "senders": none,
    }  # fmt: skip
    with pytest.raises(BadInputError, match=message):
        released_graph(**(given | change))


@NETWORKS
def test_edges_to_particles_that_do_not_exist_are_refused(network: type[nn.Module]) -> None:
    graph = random_graph("wrong", (6,), (True,))
    wrong = replace(graph, senders=graph.senders + 7)
    with pytest.raises((BadInputError, IndexError)):
        seeded(network, torch.float64)(wrong)
