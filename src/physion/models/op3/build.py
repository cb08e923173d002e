"""Building of OP3 by its name, with random, shipped or given weights."""

from __future__ import annotations

from typing import Any

from physion.models.build import make_config
from physion.models.checkpoints.trained import load_named
from physion.models.op3.config import Op3Options, op3_config
from physion.models.op3.model import NAME, Op3


def op3(**options: Any) -> Op3:
    """Build OP3; ``options`` are those of `Op3Options`."""
    chosen = make_config(Op3Options, NAME, options)
    model = Op3(op3_config(chosen), chosen)
    load_named(model, chosen.weights)
    return model
