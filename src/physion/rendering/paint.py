"""Colours of a prop's own parts: shades, flower pots, the sea of a globe.

Agent and patient are never painted: their one colour tells which they are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from physion.rendering.geometry import MeshPart
from physion.scenes.scene import Look
from physion.scenes.shapes.primitives import Shape
from physion.scenes.shapes.prop_parts import PropShape


def painted(part: MeshPart, shape: Shape, add: Callable[[Look], int]) -> MeshPart:
    """Return a mesh with the materials of the prop's own parts; other shapes stay as they are.

    Parameters
    ----------
    part
        The mesh of ``shape``, all of one material.
    shape
        The shape of the body.
    add
        Takes a look and returns the index of its material.

    Notes
    -----
    Triangles of two materials become two surfaces. A pixel that shows both is then shaded for
    each, and the edge between them is anti-aliased.
    """
    if not (isinstance(shape, PropShape) and shape.own_looks):
        return part
    assert len(shape.paint) == len(part.faces), "a prop has no triangle without area"
    rows = np.array([part.materials[0], *(add(look) for look in shape.own_looks)], np.int32)
    pairs = part.groups.astype(np.int64) * len(rows) + shape.paint
    groups = np.unique(pairs, return_inverse=True)[1].reshape(-1).astype(np.int32)
    return dataclasses.replace(part, materials=rows[shape.paint], groups=groups)
