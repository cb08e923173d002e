"""Devices of a training, by Lightning Fabric."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
from lightning_fabric import Fabric
from lightning_fabric.strategies.ddp import DDPStrategy
from lightning_fabric.utilities.rank_zero import rank_zero_only

from physion.core.errors import BadInputError
from physion.models.build import OutOfMemoryError, is_out_of_memory
from physion.models.interface import TrainingSettings

PRECISIONS = ("32-true", "16-mixed", "bf16-mixed")
"""Precisions in which weights and features stay float32."""
_TIMEOUT = timedelta(hours=6)
"""How long processes wait for one of them, which may compute features before the others."""


@dataclass(frozen=True, slots=True)
class Devices:
    """Devices of a training.

    - ``accelerator``: Lightning's name: ``auto``, ``cpu``, ``cuda``, ``mps``. ``auto`` never takes
      Apple's MPS, which has no float64 and therefore cannot run the particle models.
    - ``devices``: of each node; more than one train together, each on a part of every batch.
    - ``nodes``: machines, on each of which the same command is started, as Lightning describes.
    """

    accelerator: str = "auto"
    devices: int = 1
    nodes: int = 1


def make_fabric(devices: Devices, precision: str = "32-true") -> Fabric:
    """Return a Fabric on the given devices, launched if there are several.

    Raises `BadInputError` for devices that are not there, or an unknown precision.
    """
    if precision not in PRECISIONS:
        raise BadInputError(
            f"training: precision must be one of {', '.join(PRECISIONS)}, not {precision!r}"
        )
    if min(devices.devices, devices.nodes) < 1:
        raise BadInputError("training: devices and nodes must be at least 1")
    options: dict[str, Any] = {}
    if devices.devices * devices.nodes > 1:
        # A model may have weights that a batch does not use.
        options["strategy"] = DDPStrategy(find_unused_parameters=True, timeout=_TIMEOUT)
    try:
        fabric = Fabric(
            accelerator=_accelerator(devices.accelerator),
            devices=devices.devices,
            num_nodes=devices.nodes,
            precision=precision,  # type: ignore[arg-type]
            **options,
        )
    except (ValueError, RuntimeError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise BadInputError(
            f"{devices.devices} devices {devices.accelerator!r} cannot be used: {reason}"
        ) from error
    if options:
        fabric.launch()
    return fabric


def _accelerator(name: str) -> str:
    """Return the name of the accelerator, with the CPU where ``auto`` would take MPS."""
    only_mps = torch.backends.mps.is_available() and not torch.cuda.is_available()
    return "cpu" if name == "auto" and only_mps else name


def is_first_process() -> bool:
    """Return whether this is the process that writes and prints, of those that train together."""
    return int(getattr(rank_zero_only, "rank", 0) or 0) == 0


def move_to_device(fabric: Fabric, model: Any) -> None:
    """Move the weights of a model to the device; `OutOfMemoryError` if they do not fit there."""
    try:
        fabric.to_device(model)
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise OutOfMemoryError(
            f"the weights of {model.provenance().model} do not fit the memory of {fabric.device}; "
            "use a smaller size of the model, or accelerator cpu"
        ) from error


@contextmanager
def memory_advice(settings: TrainingSettings) -> Iterator[None]:
    """Replace an error for memory that is used up by one that names the setting to lower."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        clips, parts = settings.batch, settings.accumulate
        # The smallest divisor above 1: the same clips make a step.
        least = next((part for part in range(2, clips + 1) if clips % part == 0), 1)
        advice = (
            f"lower the batch and accumulate more, such as batch {clips // least} and accumulate "
            f"{least * parts}"
            if clips > 1
            else "use a smaller image_size or size of the model, or precision bf16-mixed"
        )
        raise OutOfMemoryError(f"training ran out of memory at batch {clips}; {advice}") from error
