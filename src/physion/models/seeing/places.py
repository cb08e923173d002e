"""Places of objects in all frames, from masks and the camera.

The network of `expected` says of every object, without depth, how far away it is in some frames,
how large it is, and what shape it has. With o the camera, r_t the mean of the rays to its pixels in
frame t (to depth 1), and d_t its depth, interpolated between those frames, its middle is

    m_t = o + d_t r_t + (m_0 - o - d_0 r_0),

with m_0 the middle that the network gives in the first of its frames that shows the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.models.seeing.expected import FEW, FRAMES, expect
from physion.models.seeing.pixels import picture_of
from physion.models.seeing.solids import library

F64 = NDArray[np.float64]

SHAPES = tuple(solid.name for solid in library())
"""Names of the shapes that are told apart."""


@dataclass(frozen=True, eq=False)
class SeenPlaces:
    """Objects of a clip of T frames.

    - ``numbers``: of the K objects, as in ``Batch.ids``.
    - ``there`` (K, T): whether an object is seen. ``places`` (K, T, 3): its middle in the world,
      metres; 0 where it is not seen.
    - ``sizes`` (K, 3): longer and shorter side of the box around it, along the axes of the world,
      and its height in the first frame, metres. ``shapes`` (K, S): probabilities of `SHAPES`.
    """

    numbers: tuple[int, ...]
    there: NDArray[np.bool_]
    places: F64
    sizes: F64
    shapes: F64


def seen_places(frames: Sequence[int], ids: NDArray[np.uint8], camera: F64) -> SeenPlaces:
    """Return the places of at most `physion.models.seeing.expected.MOST` objects.

    Parameters
    ----------
    frames
        (T,) numbers of the frames.
    ids, camera
        (T, H, W) and (2, 4, 4), as in `physion.clips.batch.Batch`.
    """
    depth, expected = expect(frames, ids, None, camera)
    shown = [int(np.argmin(np.abs(np.array(frames) - frame))) for frame in FRAMES]
    picture = picture_of(ids[0], depth[0], camera)
    rays = picture.vectors.reshape(-1, 3)
    pixels, sums = np.zeros((len(ids), 256)), np.zeros((len(ids), 256, 3))
    for t, of in enumerate(ids):
        pixels[t] = np.bincount(of.ravel(), minlength=256)
        for axis in range(3):
            sums[t, :, axis] = np.bincount(of.ravel(), rays[:, axis], 256)
    numbers = tuple(expected)
    there = np.zeros((len(numbers), len(ids)), np.bool_)
    places = np.zeros((*there.shape, 3))
    for k, (number, of) in enumerate(expected.items()):
        there[k] = pixels[:, number] > 0
        for t in np.flatnonzero(there[k]).tolist():
            far = depth[t].ravel()[np.argmax(ids[t].ravel() == number)]
            places[k, t] = picture.origin + sums[t, number] / pixels[t, number] * far
        first = [t for t in shown if pixels[t, number] >= FEW]
        if of.middle is not None and first:
            places[k, there[k]] += of.middle[0] - places[k, first[0]]
    sizes = [np.exp([of.wide[0], of.narrow[0], of.height[0]]) for of in expected.values()]
    shapes = [[np.exp(of.shapes[name]) for name in SHAPES] for of in expected.values()]
    return SeenPlaces(
        numbers, there, places, np.reshape(sizes, (-1, 3)), np.reshape(shapes, (-1, len(SHAPES)))
    )
