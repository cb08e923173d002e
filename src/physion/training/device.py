"""Device of a network."""

from __future__ import annotations

from typing import Any

from lightning_fabric import Fabric
from torch import nn


def place_model(model: nn.Module, accelerator: str) -> None:
    """Move a network to the device that Lightning calls ``accelerator``: auto, cpu, cuda, ..."""
    options: dict[str, Any] = {"accelerator": accelerator, "devices": 1}
    Fabric(**options).to_device(model)
