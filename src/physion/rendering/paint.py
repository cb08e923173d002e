"""The colours of their own that parts of a prop have: shades, flower pots, the sea of a globe.

Agent and patient are never painted: their one colour says who they are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from physion.rendering.geometry import Part
from physion.scenes.scene import Look
from physion.scenes.shapes.primitives import Shape
from physion.scenes.shapes.prop_parts import PropShape


def painted(part: Part, shape: Shape, add: Callable[[Look], int]) -> Part:
    """``part``, the triangles of ``shape``, with the looks of a prop's own parts.

    ``add`` gives the row of the table of materials for a look. Triangles of two looks are two
    surfaces, so that the edge between them is smooth in the picture.
    """
    if not (isinstance(shape, PropShape) and shape.own_looks):
        return part
    assert len(shape.paint) == len(part.faces), "a prop has no triangle without area"
    rows = np.array([part.materials[0], *(add(look) for look in shape.own_looks)], np.int32)
    both = part.surfaces.astype(np.int64) * len(rows) + shape.paint
    surfaces = np.unique(both, return_inverse=True)[1].reshape(-1).astype(np.int32)
    return dataclasses.replace(part, materials=rows[shape.paint], surfaces=surfaces)
