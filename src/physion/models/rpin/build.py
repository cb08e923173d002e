"""Building of RPIN by name, with random, shipped or given weights."""

from __future__ import annotations

from typing import Any

from physion.models.build import make_config
from physion.models.checkpoints.trained import load_named
from physion.models.rpin.config import rpin_config
from physion.models.rpin.model import NAME, Rpin
from physion.models.vision.model import VisionOptions


def rpin(**options: Any) -> Rpin:
    """Build a region proposal interaction network; ``options`` are those of `VisionOptions`."""
    chosen = make_config(VisionOptions, NAME, options)
    model = Rpin(rpin_config(chosen.size), chosen)
    load_named(model, chosen.weights)
    return model
