"""Time of the networks `released` on a graph.

    python benchmarks/models/particle_graph.py [--write]

The graph has 3,190 particles: boxes and balls of random size and rotation, filled with points
0.05 m apart, on the floor; neighbours are at most 0.08 m apart.

Networks: `ReleasedGNS` and `ReleasedDPI` next to their plain form with the same weights, in which
every relation's inputs are joined and multiplied by one matrix in every step. The plain form
gathers by index; the published code multiplies by sparse matrices of zeros and ones instead.
Neighbours: the tree of `neighbours` and the cell list of `cell_list`, next to the published way,
which asks a tree for the neighbours of all particles and joins them in a Python loop.

CPU seconds, median of 5 runs in turns, one thread, after one that is not timed. The run stops with
an error if outputs differ by more than 1e-4 of the largest, the whole gradient by more than 1e-4 of
its norm, or searches at all. Gradients differ more than outputs do: where a float32 number before
one of some 100 million ReLUs is almost 0, rounding decides about a whole term of the gradient.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from physion.core import seeds
from physion.models.particles.neighbours import radius_edges, radius_edges_on_device
from physion.models.particles.released import ReleasedGraph, dpi, gns, released_graph
from physion.models.particles.released.layers import StageLayers
from physion.models.particles.released.propagation import EdgeBlock

RESULTS = Path(__file__).parents[1] / "results"
PARTICLES, SPACING, RADIUS, APART = 3190, 0.05, 0.08, 1.5
REPEATS = 5
SAME = 1e-4
TO_REACH = "To reach: GNS, forward and backward, 3.2 times, better 5; the tree 10 times."


def random_objects() -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (P, 3) of all particles, metres, and the object (P,) of each."""
    rng = seeds.generator("particle graph")
    objects: list[np.ndarray] = []
    while sum(map(len, objects)) < PARTICLES:
        half = rng.uniform(0.1, 0.35, 3)
        axes = [np.arange(-size, size, SPACING) for size in half]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        if rng.random() < 0.5:
            points = points[np.sum((points / half) ** 2, 1) <= 1]
        points = Rotation.random(rng=rng).apply(points)
        column, row = divmod(len(objects), 4)
        objects.append(points + np.array([APART * column, APART * row, -points[:, 2].min()]))
    owners = np.repeat(np.arange(len(objects)), [len(points) for points in objects])
    return np.concatenate(objects)[:PARTICLES], owners[:PARTICLES]


def plain_stage(
    layers: StageLayers, states: Tensor, edges: EdgeBlock, features: Tensor, relation: Tensor,
    own: Tensor, steps: int,
) -> Tensor:  # fmt: skip
    """Return what `layers.run_stage` returns, relation by relation."""
    r = edges.receivers + edges.receiving.start
    s = edges.senders + edges.sending.start
    joined = [features[r], features[s], relation.expand(len(r), -1)]
    code = layers.relation_encoder(torch.cat(joined, 1))
    encoded = layers.particle_encoder(own[edges.receiving])
    for _ in range(steps):
        joined = [code, states[r], states[s]]
        messages = layers.relation_propagator.linear(torch.cat(joined, 1)).relu()
        sums = messages.new_zeros(len(encoded), messages.shape[1])
        sums = sums.index_add(0, edges.receivers, messages)
        change = layers.particle_propagator.linear(torch.cat([encoded, sums], 1))
        after = (change + states[edges.receiving]).relu()
        states = torch.cat([states[: edges.receiving.start], after, states[edges.receiving.stop :]])
    return states


def loop_over_particles(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return receivers and senders (E,) as the published way finds them, each particle included."""
    neighbours = cKDTree(points).query_ball_point(points, RADIUS)
    pairs = []
    for particle, near in enumerate(neighbours):
        receivers = np.ones(len(near), dtype=np.int64) * particle
        pairs.append(np.stack([receivers, np.array(near)], axis=1))
    joined = np.concatenate(pairs)
    return joined[:, 0], joined[:, 1]


def medians(functions: dict[str, Callable[[], Any]]) -> dict[str, float]:
    """Return the median CPU seconds of functions that run in turns."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for run in range(REPEATS + 1):
        for name, function in functions.items():
            start = time.process_time()
            function()
            if run:
                times[name].append(time.process_time() - start)
    return {name: statistics.median(values) for name, values in times.items()}


def both_ways(network: nn.Module, graph: ReleasedGraph) -> tuple[Tensor, Tensor]:
    """Return the outputs and the gradient of the mean of their squares."""
    network.zero_grad()
    outputs = network(graph)
    outputs.square().mean().backward()
    gradients = [weight.grad.flatten() for weight in network.parameters()]  # type: ignore[union-attr]
    return outputs.detach(), torch.cat(gradients)


def forward(network: nn.Module, graph: ReleasedGraph) -> Tensor:
    """Return the outputs alone."""
    with torch.no_grad():
        outputs: Tensor = network(graph)
    return outputs


def time_network(name: str, module: Any, kind: type[nn.Module], graph: ReleasedGraph) -> list[str]:
    """Return the cells of the row of a network; stop if it differs from its plain form."""
    torch.manual_seed(0)
    network = kind()

    def plain(function: Callable[..., Any]) -> Any:
        with mock.patch.object(module, "run_stage", plain_stage):
            return function(network, graph)

    outputs, gradient = both_ways(network, graph)
    plain_outputs, plain_gradient = plain(both_ways)
    difference = float((outputs - plain_outputs).abs().max() / plain_outputs.abs().max())
    error = float((gradient - plain_gradient).norm() / plain_gradient.norm())
    if max(difference, error) > SAME:
        raise SystemExit(f"{name}: outputs differ by {difference:.1e}, gradients by {error:.1e}")
    cells = [name]
    for function in (forward, both_ways):
        seconds = medians(
            {"plain": lambda f=function: plain(f), "ours": lambda f=function: f(network, graph)}
        )
        ratio = seconds["plain"] / seconds["ours"]
        cells += [f"{seconds['plain']:.2f}", f"{seconds['ours']:.2f}", f"{ratio:.1f}"]
    return [*cells, f"{difference:.1e}", f"{error:.1e}"]


def time_search(points: np.ndarray) -> dict[str, float]:
    """Return the seconds of each search of neighbours; stop if they differ."""
    scene = np.zeros(len(points), np.int64)
    on_device = torch.tensor(points), torch.tensor(scene)
    receivers, senders = radius_edges(points, scene, RADIUS)
    by_loop = np.stack(loop_over_particles(points))
    by_loop = by_loop[:, by_loop[0] != by_loop[1]]
    by_loop = by_loop[:, np.lexsort(by_loop[::-1])]
    by_cells = np.stack([part.numpy() for part in radius_edges_on_device(*on_device, RADIUS)])
    for other in (by_loop, by_cells):
        if not np.array_equal(other, [receivers, senders]):
            raise SystemExit("searches of neighbours differ")
    return medians(
        {
            "Python loop": lambda: loop_over_particles(points),
            "tree": lambda: radius_edges(points, scene, RADIUS),
            "cell list": lambda: radius_edges_on_device(*on_device, RADIUS),
        }
    )


def main() -> None:
    """Time networks and searches, and print or keep the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="keep the result in results/")
    write = parser.parse_args().write
    torch.set_num_threads(1)
    points, owners = random_objects()
    receivers, senders = radius_edges(points, np.zeros(len(points), np.int64), RADIUS)
    rng = seeds.generator("particle graph", "velocities")
    graph = released_graph(
        torch.tensor(points, dtype=torch.float32),
        torch.tensor(rng.normal(size=points.shape), dtype=torch.float32),
        torch.tensor(owners),
        torch.ones(int(owners.max()) + 1, dtype=torch.bool),
        torch.tensor(receivers),
        torch.tensor(senders),
    )
    search = time_search(points)
    rows = [
        time_network("GNS", gns, gns.ReleasedGNS, graph),
        time_network("DPI", dpi, dpi.ReleasedDPI, graph),
    ]
    text = "\n".join(
        [
            "# Networks `released` on a graph of particles",
            f"{datetime.now(UTC).date()}, AMD EPYC, 2 cores, one thread, Python "
            f"{platform.python_version()}, torch {torch.__version__}, "
            "`python benchmarks/models/particle_graph.py --write`. "
            "Other programs ran at the same time.",
            f"{len(points)} particles of {len(graph.rigid)} objects, {len(receivers)} pairs of "
            f"neighbours, {len(graph.receivers)} relations with the floor and each particle "
            f"itself. CPU seconds, median of {REPEATS}; differences as part of the largest output "
            "and of the norm of the whole gradient.",
            TO_REACH,
            "",
            "| network | forward, plain | ours | times faster | forward and backward, plain | ours "
            "| times faster | difference of outputs | of gradients |",
            "|---|---|---|---|---|---|---|---|---|",
            *("| " + " | ".join(row) + " |" for row in rows),
            "",
            "| search of neighbours | CPU ms | times the Python loop's speed |",
            "|---|---|---|",
            *(
                f"| {name} | {1e3 * s:.1f} | {search['Python loop'] / s:.1f} |"
                for name, s in search.items()
            ),
        ]
    )
    print(text)
    if write:
        (RESULTS / "particle_graph.md").write_text(text + "\n")


if __name__ == "__main__":
    main()
