"""Steps of message passing between particles, for CPU and GPU, with gradients.

One step of the networks of the published particle code is, for the edge e from sender s to
receiver r,

    a_e = E_e + W_r h_r + W_s h_s              E: part that is the same in every step
    m_r = sum over the edges e into r of max(a_e, 0)
    h_r = max(C_r + W_m m_r + h_r, 0)          C: part that is the same in every step

The plain form multiplies every edge's joined inputs by one matrix [W_e, W_r, W_s] in every step.
Here ``W_e`` is multiplied once, before, and W_r and W_s by nodes, of which there are fewer than
edges. On the CPU one loop over the edges does the rest without a matrix of edges in between. The
gradients, for the gradient g of h after the step, masks where h > 0 and where a_e > 0:

    g_r = g [h > 0],   dC = g_r,   dW_m = sum_r g_r m_r^T,   d_m = W_m^T g_r
    d_e = d_m[r] [a_e > 0],   dE_e = d_e summed over the steps,   dR_r, dS_s = sums of d_e
    dW_r = sum_r dR_r h_r^T,  dW_s = sum_s dS_s h_s^T,  dh = g_r + W_r^T dR + W_s^T dS

a_e is computed again in the backward pass, so that no step keeps anything for every edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from physion.core.errors import BadInputError
from physion.numerics.kernel import in_place_kernel

Rows = NDArray[np.floating[Any]]
I64 = NDArray[np.int64]

KERNEL_TYPES = (torch.float32, torch.float64)
"""Types of numbers of the loops on the CPU; others go through torch."""


@dataclass(frozen=True, eq=False)
class EdgeBlock:
    """Edges from one block of nodes to another, or within one.

    - ``receiving``, ``sending``: which rows of the nodes receive and send.
    - ``receivers``, ``senders`` (E,): int64, counted within these blocks. Edges that are sorted by
      receiver are faster.
    """

    receiving: slice
    sending: slice
    receivers: Tensor
    senders: Tensor


@dataclass(frozen=True, eq=False)
class StepWeights:
    """Weights of a step: ``receiver`` W_r, ``sender`` W_s and ``message`` W_m, (F, F) each."""

    receiver: Tensor
    sender: Tensor
    message: Tensor


def propagate(
    states: Tensor, edges: EdgeBlock, edge_part: Tensor, node_part: Tensor, weights: StepWeights,
    steps: int,
) -> Tensor:  # fmt: skip
    """Return the states (N, F) of all nodes after steps of message passing; see the module.

    Parameters
    ----------
    states : (N, F)
        h before the first step. Those that do not receive stay as they are.
    edges
        Who receives from whom, E edges to R receiving nodes.
    edge_part : (E, F)
        The constant part E of the messages, with their bias.
    node_part : (R, F)
        The constant part C of the receiving nodes, with its bias.
    weights
        The matrices W_r, W_s and W_m.
    steps
        Number of steps, at least 1.

    Raises
    ------
    BadInputError
        If an edge names a node that does not exist.
    """
    _check(states, edges)
    result: Tensor = _Propagation.apply(  # type: ignore[no-untyped-call]
        states, edges, edge_part, node_part, weights.receiver, weights.sender, weights.message,
        steps,
    )  # fmt: skip
    return result


def _check(states: Tensor, edges: EdgeBlock) -> None:
    # The loops on the CPU read and write by these numbers without any check; a GPU checks them.
    if states.device.type != "cpu":
        return
    for name, block, numbers in (
        ("receivers", edges.receiving, edges.receivers),
        ("senders", edges.sending, edges.senders),
    ):
        count = len(states[block])
        if len(numbers) and not (int(numbers.min()) >= 0 and int(numbers.max()) < count):
            raise BadInputError(
                f"{name} of edges are {int(numbers.min())} to {int(numbers.max())}, but there are "
                f"{count} nodes: make the edges of the graph again"
            )


class _Propagation(torch.autograd.Function):
    """`propagate` with the gradients of the module's docstring."""

    @staticmethod
    def forward(
        ctx: Any, states: Tensor, edges: EdgeBlock, edge_part: Tensor, node_part: Tensor,
        receiver: Tensor, sender: Tensor, message: Tensor, steps: int,
    ) -> Tensor:  # fmt: skip
        rows = edges.receiving
        kept, sums = [states], []
        for _ in range(steps):
            total = _sum_messages(
                edge_part, states[rows] @ receiver.T, states[edges.sending] @ sender.T, edges
            )
            after = states.clone()
            after[rows] = torch.addmm(node_part, total, message.T).add_(states[rows]).relu_()
            states = after
            kept.append(states)
            sums.append(total)
        ctx.save_for_backward(edge_part, receiver, sender, message, *kept, *sums)
        ctx.edges = edges
        return states

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        edge_part, receiver, sender, message, *kept = ctx.saved_tensors
        edges: EdgeBlock = ctx.edges
        rows, from_rows = edges.receiving, edges.sending
        steps = len(kept) // 2
        states, sums = kept[: steps + 1], kept[steps + 1 :]
        d_edge = edge_part.new_zeros(edge_part.shape)
        d_node = torch.zeros_like(sums[0])
        d_receiver, d_sender, d_message = map(torch.zeros_like, (receiver, sender, message))
        for k in reversed(range(steps)):
            own = gradient[rows] * (states[k + 1][rows] > 0)
            d_node += own
            d_message.addmm_(own.T, sums[k])
            to, origin = states[k][rows], states[k][from_rows]
            d_to, d_origin = _message_gradients(
                edge_part, to @ receiver.T, origin @ sender.T, edges, own @ message, d_edge
            )
            d_receiver.addmm_(d_to.T, to)
            d_sender.addmm_(d_origin.T, origin)
            gradient = gradient.clone()
            gradient[rows] = torch.addmm(own, d_to, receiver)
            gradient[from_rows] += d_origin @ sender
        return gradient, None, d_edge, d_node, d_receiver, d_sender, d_message, None


def _sum_messages(edge_part: Tensor, to: Tensor, origin: Tensor, edges: EdgeBlock) -> Tensor:
    """Return the sums (R, F) of messages into each receiver.

    Parameters
    ----------
    edge_part : (E, F)
        E_e.
    to : (R, F)
        W_r h of the receiving nodes.
    origin : (S, F)
        W_s h of the sending nodes.
    edges
        Who receives from whom.
    """
    total = to.new_zeros(to.shape)
    if _by_kernel(edge_part):
        _add_messages(*_arrays(edge_part, to, origin, edges.receivers, edges.senders, total))
        return total
    sums = edge_part + to.index_select(0, edges.receivers)
    sums += origin.index_select(0, edges.senders)
    return total.index_add_(0, edges.receivers, sums.relu_())


def _message_gradients(
    edge_part: Tensor, to: Tensor, origin: Tensor, edges: EdgeBlock, gradient: Tensor,
    d_edge: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return the gradients of ``to`` and ``origin``; add those of the edges to ``d_edge``.

    ``gradient`` (R, F) is that of the sums of messages; for the rest see `_sum_messages`.
    """
    d_to, d_origin = to.new_zeros(to.shape), origin.new_zeros(origin.shape)
    if _by_kernel(edge_part):
        _add_gradients(
            *_arrays(edge_part, to, origin, edges.receivers, edges.senders, gradient),
            *_arrays(d_edge, d_to, d_origin),
        )
        return d_to, d_origin
    sums = edge_part + to.index_select(0, edges.receivers)
    sums += origin.index_select(0, edges.senders)
    by_edge = gradient.index_select(0, edges.receivers).masked_fill_(sums <= 0, 0)
    d_edge += by_edge
    d_to.index_add_(0, edges.receivers, by_edge)
    d_origin.index_add_(0, edges.senders, by_edge)
    return d_to, d_origin


def _by_kernel(values: Tensor) -> bool:
    return values.device.type == "cpu" and values.dtype in KERNEL_TYPES


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    # Kernels know contiguous arrays. What they write to was made contiguous, so it is not copied.
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)


@in_place_kernel
def _add_messages(
    edge_part: Rows, to: Rows, origin: Rows, receivers: I64, senders: I64, total: Rows
) -> None:
    """Add max(E_e + R_r + S_s, 0) of every edge e to ``total`` (R, F) of its receiver r."""
    zero = edge_part.dtype.type(0)
    for e in range(len(receivers)):
        r, s = receivers[e], senders[e]
        for c in range(edge_part.shape[1]):
            a = edge_part[e, c] + to[r, c] + origin[s, c]
            # Not max(): NaN has to stay NaN.
            total[r, c] += zero if a <= zero else a


@in_place_kernel
def _add_gradients(
    edge_part: Rows, to: Rows, origin: Rows, receivers: I64, senders: I64, gradient: Rows,
    d_edge: Rows, d_to: Rows, d_origin: Rows,
) -> None:  # fmt: skip
    """Add the gradient of each edge's message to those of its three parts; see the module."""
    zero = edge_part.dtype.type(0)
    for e in range(len(receivers)):
        r, s = receivers[e], senders[e]
        for c in range(edge_part.shape[1]):
            a = edge_part[e, c] + to[r, c] + origin[s, c]
            d = zero if a <= zero else gradient[r, c]
            d_edge[e, c] += d
            d_to[r, c] += d
            d_origin[s, c] += d
