"""Message passing: the loops of the CPU, torch's operations, and numerical gradients agree."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from physion.core.errors import BadInputError
from physion.models.particles.released import propagation
from physion.models.particles.released.propagation import EdgeBlock, StepWeights, propagate

NODES, WIDTH, EDGES = 9, 4, 30


def example(dtype: torch.dtype = torch.float64) -> tuple[EdgeBlock, list[Tensor]]:
    """Edges from nodes 2 to 8 to nodes 0 to 5, without order, and random numbers."""
    rng = torch.Generator().manual_seed(5)
    receiving, sending = slice(0, 6), slice(2, 9)
    edges = EdgeBlock(
        receiving,
        sending,
        torch.randint(0, 6, (EDGES,), generator=rng),
        torch.randint(0, 7, (EDGES,), generator=rng),
    )
    shapes = [(NODES, WIDTH), (EDGES, WIDTH), (6, WIDTH), *[(WIDTH, WIDTH)] * 3]
    values = [torch.randn(shape, generator=rng, dtype=dtype) for shape in shapes]
    return edges, [value.requires_grad_() for value in values]


def run(edges: EdgeBlock, values: list[Tensor], steps: int = 3) -> Tensor:
    states, edge_part, node_part, *matrices = values
    return propagate(states, edges, edge_part, node_part, StepWeights(*matrices), steps)


def outcome(edges: EdgeBlock, values: list[Tensor]) -> list[Tensor]:
    """Return the states and the gradients of their squares."""
    out = run(edges, values)
    return [out.detach(), *torch.autograd.grad(out.square().sum(), values)]


def test_gradients_are_those_of_finite_differences() -> None:
    edges, values = example()
    assert torch.autograd.gradcheck(lambda *given: run(edges, list(given)), values)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_loops_and_torch_agree(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    edges, values = example(dtype)
    by_loops = outcome(edges, values)
    monkeypatch.setattr(propagation, "_by_kernel", lambda _: False)
    by_torch = outcome(edges, values)
    for a, b in zip(by_loops, by_torch, strict=True):
        torch.testing.assert_close(a, b)


def test_inputs_of_any_memory_layout_work() -> None:
    """Transposed and repeated inputs: what the loops write has to arrive."""
    edges, values = example()
    contiguous = [value.detach() for value in values]
    contiguous[1] = contiguous[1][:1].expand(EDGES, WIDTH).contiguous()
    other = [value.T.contiguous().T for value in contiguous]
    other[1] = contiguous[1][:1].expand(EDGES, WIDTH)
    first, second = ([v.requires_grad_() for v in given] for given in (contiguous, other))
    for a, b in zip(outcome(edges, first), outcome(edges, second), strict=True):
        torch.testing.assert_close(a, b)


def test_nodes_that_do_not_receive_stay() -> None:
    edges, values = example()
    assert torch.equal(run(edges, values)[6:], values[0][6:])


@pytest.mark.parametrize("kernel", [True, False])
def test_nan_is_passed_on(kernel: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    edges, values = example()
    monkeypatch.setattr(propagation, "_by_kernel", lambda _: kernel)
    with torch.no_grad():
        values[1][7] = torch.nan
    assert run(edges, values, 1)[edges.receivers[7]].isnan().all()


@pytest.mark.parametrize("change", [{"receivers": 6}, {"receivers": -1}, {"senders": 7}])
def test_edges_to_nodes_that_do_not_exist_are_refused(change: dict[str, int]) -> None:
    edges, values = example()
    parts: dict[str, Any] = vars(edges).copy()
    ((name, number),) = change.items()
    parts[name] = parts[name].clone()
    parts[name][3] = number
    with pytest.raises(BadInputError, match=f"{name} of edges"):
        run(EdgeBlock(**parts), values)
