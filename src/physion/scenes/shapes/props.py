"""Stand-ins for the library models of the official scenes: vases, chairs, dogs, lamps, ...

The official models may not be shipped, so each prop is built from a few solids, in the modules that
are imported here. It fills the box [-0.5, 0.5] x [-0.5, 0.5] x [0, 1] exactly: a body's scale is
the size of the model that it stands for, whatever that is. Front is +y. Props are shapes like any
other (``prop:vase``): mostly scenery, but their parts are also pieces for contacts.
"""

from __future__ import annotations

from physion.scenes.shapes import (  # noqa: F401  # importing them registers their props
    prop_furniture,
    prop_plants_and_animals,
    prop_things,
    prop_vessels,
)
from physion.scenes.shapes.primitives import shapes
from physion.scenes.shapes.prop_parts import NATURAL_SIZES, PropShape

__all__ = ["NATURAL_SIZES", "PropShape", "shapes"]
