"""Convex hulls as arrays that the compiled collision functions read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class Hulls(NamedTuple):
    """G convex hulls, those of one body after the other; a hull is also called geom.

    - ``vertices`` (V, 3): corners in metres, in the frame of the actor that the hull moves with.
    - ``first_vertex`` (G + 1,): first corner of each hull, and at the end V.
    - ``loops`` (L,): rows of ``vertices``, counterclockwise round every face.
    - ``first_loop`` (F + 1,): first entry in ``loops`` of each face, and at the end L.
    - ``first_face`` (G + 1,): first face of each hull, and at the end F.
    - ``plane`` (F, 4): outward unit normal n of each face and d in n . p = d, metres.
    - ``margin`` (G,): metres that a contact may drift before it is found anew.
    - ``tolerance`` (G,): metres within which faces at the closest point count as equally close.
    - ``radius`` (G,): half diagonal in metres of the box inside the hull.
    - ``extent`` (G,): largest distance in metres of a corner from the actor's centre of mass.
    - ``box`` (G, 6): centre and half extents of the box round the hull, in the actor's frame.
    """

    vertices: F64
    first_vertex: I64
    loops: I64
    first_loop: I64
    first_face: I64
    plane: F64
    margin: F64
    tolerance: F64
    radius: F64
    extent: F64
    box: F64
