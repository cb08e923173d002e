"""Props that replace the library models of the official scenes: vases, chairs, dogs, lamps, ...

The licence of the official models forbids shipping them, so each prop is built from a few solids,
in the modules imported here. A prop fills the box [-0.5, 0.5] x [-0.5, 0.5] x [0, 1] exactly, so
that the scale of a body is the size of the model it replaces. Its front is +y. Props are shapes
like any other (``prop:vase``): mostly scenery, but they have collision pieces as well.
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
