"""Records that the colour pass reads and writes: camera, surfaces, materials, light, points.

Fields of one kind stand side by side in one array of records. With one array for each field, in
nested NamedTuples, the colour pass took 1.5 times as long: numba passes each array to each kernel
by value and counts references to it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.rendering.depth_maps import DepthMap
from physion.rendering.textures.lookup import Atlas

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]
Records = NDArray[np.void]

CAMERA = np.dtype([("position", "f8", 3), ("rays", "f8", (3, 3))], align=True)
"""The camera: its position in metres; the matrix from a pixel (x, y, 1) to the world vector from
the camera to depth 1 m."""
SURFACE = np.dtype(
    [
        ("normals", "f4", (3, 3)),
        ("uv", "f4", (3, 2)),
        ("tangents", "f4", (2, 3)),
        ("material", "i4"),
    ],
    align=True,
)
"""A triangle.

- ``normals``: normal of each corner in the world. ``uv``: texture coordinates of each corner.
- ``tangents``: world directions of growing u and v.
- ``material``: index of its `MATERIAL`.
"""
MATERIAL = np.dtype(
    [
        *(("color", "f8", 3), ("texture", "i8"), ("specular", "f8"), ("exponent", "f8")),
        *(("reflectance", "f8"), ("metalness", "f8"), ("normal_scale", "f8")),
        *(("emission", "f8"), ("occluded", "?")),
    ],
    align=True,
)
"""A surface material.

- ``color``: linear colour; the albedo is its product with the texture. ``texture``: index into the
  atlas.
- ``specular``, ``exponent``: strength and exponent of the highlight.
- ``reflectance``: fraction of the environment that is reflected seen straight on.
- ``metalness``: 0 dielectric .. 1 metal, whose reflections have the colour of its albedo.
- ``normal_scale``: factor of the texture's slopes in the normal map; 0 is without.
- ``emission``: light of its own, as a multiple of the albedo.
- ``occluded``: whether the room's walls darken it near the edges between them.
"""
LIGHT = np.dtype(
    [
        *(("direction", "f8", 3), ("color", "f8", 3)),
        *(("ambient", "f8", 3), ("ambient_slopes", "f8", (3, 3)), ("environment", "f8", (3, 3))),
        *(("window_low", "f8", 3), ("window_high", "f8", 3), ("window_color", "f8", 3)),
        *(("room_low", "f8", 3), ("room_high", "f8", 3), ("background", "f8", 3)),
        *(("shadow_strength", "f8"), ("occlusion_strength", "f8")),
    ],
    align=True,
)
"""Light of a room; colours are linear.

- ``direction``: unit vector towards the directional light. ``color``: its colour.
- ``ambient``, ``ambient_slopes``: the ambient light of a normal n is
  ``ambient + n @ ambient_slopes``, so that walls differ.
- ``environment``: what reflections show at the sides, below and above (rows).
- ``window_low``, ``window_high``, ``window_color``: corners of a bright rectangle in a plane of one
  y, which reflections show too, and its colour.
- ``room_low``, ``room_high``: corners of the room, for ambient occlusion near its edges.
- ``background``: colour where nothing is seen.
- ``shadow_strength``: fraction of the directional light that a full shadow takes.
- ``occlusion_strength``: fraction of all light that full occlusion under objects takes.
"""
POINT = np.dtype(
    [
        *(("position", "f4", 3), ("normal", "f4", 3)),
        *(("ambient", "f4", 3), ("direct", "f4", 3), ("levelness", "f4")),
    ],
    align=True,
)
"""A surface point with its light before shadows.

- ``position``: metres in the world. ``normal``: unit, before normal mapping.
- ``ambient``: ambient light, environment and emission that the point sends.
- ``direct``: the directional light that it sends if lit.
- ``levelness``: 1 for a horizontal surface that faces up, 0 from 60 degrees on; the weight of the
  occlusion under objects.
"""


class ShadingInputs(NamedTuple):
    """Everything about a scene that is the same for all its pixels.

    - ``camera`` (1,) of `CAMERA`; ``lights`` (1,) of `LIGHT`; ``materials`` (M,) of `MATERIAL`.
    - ``edges`` (T, 3, 3): edge functions of the triangles, written by
      `physion.rendering.rasterizer.rasterize`.
    - ``surfaces`` (T,) of `SURFACE`; ``groups`` (T,): triangles of one number make one smooth
      surface and are shaded as one.
    - ``atlas``: the textures.
    - ``tones`` (TONES,) uint8: the sRGB bytes of linear light, see
      `physion.rendering.light.tone_table`.
    """

    camera: Records
    edges: F64
    surfaces: Records
    groups: I32
    materials: Records
    atlas: Atlas
    lights: Records
    tones: U8


class LightMaps(NamedTuple):
    """Depth maps of one frame: of the directional light, and of what hangs low over the ground."""

    shadow: DepthMap
    occlusion: DepthMap
