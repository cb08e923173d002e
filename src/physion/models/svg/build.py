"""Building of SVG by its name, with random, shipped or given weights."""

from __future__ import annotations

from typing import Any

from physion.models.build import make_config
from physion.models.checkpoints.trained import load_named
from physion.models.svg.config import SvgOptions, svg_config
from physion.models.svg.model import NAME, Svg


def svg(**options: Any) -> Svg:
    """Build SVG; ``options`` are those of `SvgOptions`."""
    chosen = make_config(SvgOptions, NAME, options)
    model = Svg(svg_config(chosen), chosen)
    load_named(model, chosen.weights)
    return model
