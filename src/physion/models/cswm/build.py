"""Building of C-SWM by name, with random, shipped or given weights."""

from __future__ import annotations

from typing import Any

from physion.models.build import make_config
from physion.models.checkpoints.trained import load_named
from physion.models.cswm.config import cswm_config
from physion.models.cswm.model import NAME, Cswm
from physion.models.vision.model import VisionOptions


def cswm(**options: Any) -> Cswm:
    """Build a contrastively trained world model; ``options`` are those of `VisionOptions`."""
    chosen = make_config(VisionOptions, NAME, options)
    model = Cswm(cswm_config(chosen.size), chosen)
    load_named(model, chosen.weights)
    return model
