"""Losses of a model: checked, wrapped for Fabric, and averaged over held-out clips."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from physion.errors import BadInputError, PhysionError
from physion.models.batch import Batch
from physion.models.raised import describe_raised, is_out_of_memory
from physion.seeds import stable_hash
from physion.training.sources.background import background
from physion.training.windows import Request, Windows

LOSS = "loss"


class Given:
    """Batch on its way through Fabric, which would take a frozen dataclass apart."""

    __slots__ = ("batch",)

    def __init__(self, batch: Batch) -> None:
        self.batch = batch


class Learner(nn.Module):
    """Module whose ``forward`` is the loss of a model, for Fabric to wrap."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, given: Given) -> dict[str, Tensor]:
        """Return the loss and its parts; only the loss has a gradient."""
        losses = losses_of(self.model, given.batch)
        return {name: v if name == LOSS else v.detach() for name, v in losses.items()}


@contextmanager
def evaluating(model: nn.Module, fabric: Fabric) -> Iterator[None]:
    """Set a model to evaluation mode without gradients; random numbers drawn inside are local."""
    model.eval()
    try:
        with torch.no_grad(), fabric.autocast(), torch.random.fork_rng(devices=[]):
            yield
    finally:
        model.train()


def call(model: Any, method: str, batch: Batch) -> Any:
    """Return what a method of a model returns; what it raises names model, method and line."""
    try:
        return getattr(model, method)(batch)
    except PhysionError:
        raise
    except Exception as error:
        if is_out_of_memory(error):
            raise
        raise describe_raised(error, model.provenance().model, method) from error


def losses_of(model: Any, batch: Batch) -> dict[str, Tensor]:
    """Return loss and parts of a batch; raise `BadInputError` if they are no scalars."""
    name = model.provenance().model
    losses = call(model, "loss", batch)
    if not isinstance(losses, Mapping) or LOSS not in losses:
        raise BadInputError(f"model {name!r}: loss must give a mapping with {LOSS!r}")
    for part, value in losses.items():
        if not isinstance(value, Tensor) or value.ndim != 0:
            found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise BadInputError(f"model {name!r}: loss gave {part} as {found}, expected a scalar")
    if torch.is_grad_enabled() and not losses[LOSS].requires_grad:
        raise BadInputError(f"model {name!r}: loss gave a loss that depends on no weight")
    return dict(losses)


def mean_over(
    function: Callable[[Batch], Mapping[str, Tensor]],
    windows: Windows,
    requests: list[Request],
    fabric: Fabric,
    seed: int,
) -> dict[str, float]:
    """Return the means, weighted by clips, of what ``function`` gives for ``requests``.

    The batches are divided among the processes. Random operations are seeded by ``seed`` and the
    number of the batch.
    """
    rank, processes = fabric.global_rank, fabric.world_size
    sums: Tensor | None = None
    names: tuple[str, ...] = ()
    # A process without a batch of its own computes the first one and gives it no weight.
    own = list(range(rank, len(requests), processes)) or [0]
    batches = background([requests[number] for number in own], windows.read)
    for number, batch in zip(own, batches, strict=True):
        weight = len(batch) if number % processes == rank else 0
        torch.manual_seed(stable_hash("validation", seed, number) % 2**63)
        values = function(batch.to(fabric.device))
        names = ordered(values)
        row = torch.stack([values[name].detach().float() for name in names])
        row = torch.cat([row * weight, row.new_tensor([weight])])
        sums = row if sums is None else sums + row
    reduced = fabric.all_reduce(sums, reduce_op="sum") if sums is not None else None
    assert isinstance(reduced, Tensor), "there is a batch"
    *totals, count = reduced.double().cpu().tolist()
    return {name: total / count for name, total in zip(names, totals, strict=True)}


def ordered(losses: Mapping[str, Tensor]) -> tuple[str, ...]:
    """Return the names of the losses: the loss itself first, then its parts by name."""
    return (LOSS, *sorted(name for name in losses if name != LOSS))
