"""Building of the particle models by name, with random, shipped or given weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

from physion.core.errors import BadInputError
from physion.models.build import make_config
from physion.models.checkpoint import SHIPPED, load_named
from physion.models.particles.config import ParticleOptions, own_config
from physion.models.particles.released.config import released_config
from physion.models.particles.released.simulator import ReleasedSimulator
from physion.models.particles.simulator import ParticleSimulator


def gns(**options: Any) -> ParticleSimulator:
    """Build a graph network simulator (GNS); ``options`` are those of `ParticleOptions`."""
    return _build("gns", "messages", options)


def gns_ransac(**options: Any) -> ParticleSimulator:
    """Build a GNS that keeps bodies rigid by a robust fit; ``options`` as `gns`."""
    return _build("gns-ransac", "messages", options, robust=True)


def dpi(**options: Any) -> ParticleSimulator:
    """Build a DPI-Net; ``options`` are those of `ParticleOptions`."""
    return _build("dpi", "objects", options)


def _build(
    name: str,
    network: Literal["messages", "objects"],
    options: Mapping[str, Any],
    *,
    robust: bool = False,
) -> ParticleSimulator:
    chosen = make_config(ParticleOptions, name, options)
    if chosen.size == "released":
        published = released_config(network, keep_rigid=robust)
        return _weighted(ReleasedSimulator(name, published, chosen))
    config = own_config(network, chosen)
    if robust:
        config = replace(config, rigid="robust")
    return _weighted(ParticleSimulator(name, config, chosen))


def _weighted(model: ParticleSimulator) -> ParticleSimulator:
    """Return a model with the weights that its options name."""
    options = model.options
    own = options.size == "small" and options.swept and options.stride == 3
    if options.weights == SHIPPED and not own:
        raise BadInputError(
            "weights of particle models are shipped for size=small, swept=true and stride=3; "
            "train others with physion train"
        )
    load_named(model, options.weights)
    return model
