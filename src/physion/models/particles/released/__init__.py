"""Networks of the published particle code for Physion, with its defects: GNS and DPI-Net."""

from physion.models.particles.released.dpi import ReleasedDPI
from physion.models.particles.released.gns import ReleasedGNS
from physion.models.particles.released.graph import ReleasedGraph, released_graph
from physion.models.particles.released.inputs import Normalisation
from physion.models.particles.released.layers import Widths

__all__ = [
    "Normalisation",
    "ReleasedDPI",
    "ReleasedGNS",
    "ReleasedGraph",
    "Widths",
    "released_graph",
]
