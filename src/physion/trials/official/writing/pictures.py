"""Pictures of one frame, encoded as in the official files."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.rendering.renderer import Frame
from physion.trials.official.names import encode_depth, encode_flow, encode_normals
from physion.trials.official.writing.arrays import put_bytes, put_picture

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_RGB8 = (8, 2, 0, 0, 0)
"""PNG header: 8 bits, red green blue, deflate, adaptive filters, not interlaced."""
_UP = 2
"""PNG filter that stores the difference to the pixel above."""


def write_pictures(
    group: Any,
    images: Frame,
    ids: NDArray[np.int16],
    colors: NDArray[np.uint8],
    view: NDArray[np.float64],
) -> None:
    """Write the group ``images`` of a frame.

    Parameters
    ----------
    group
        Group of h5py's lower layer.
    images
        Passes color, depth, normals and flow of the frame.
    ids
        Official object ids (H, W), 0 the room.
    colors
        Colours (objects + 1, 3) by official object id.
    view
        Axes of the camera (3, 3), see `encode_normals`.
    """
    assert images.color is not None and images.depth is not None
    assert images.normals is not None and images.flow is not None
    pictures = {
        "_img": images.color,
        "_id": colors[ids],
        "_normals": encode_normals(images.normals, view),
        "_flow": encode_flow(images.flow),
    }
    for name, picture in pictures.items():
        put_bytes(group, name, encode_rgb(picture))
    put_picture(group, "_depth", encode_depth(images.depth))


def encode_rgb(picture: NDArray[np.uint8]) -> bytes:
    """Return the bytes of a PNG file of ``picture`` (H, W, 3), made fast.

    One filter for all rows takes half the time of the choice of a filter for each row that
    `physion.trials.files.encode_png` makes, for 10 % more bytes.
    """
    height, width, channels = picture.shape
    rows = np.ascontiguousarray(picture).reshape(height, width * channels)
    filtered = np.empty((height, 1 + rows.shape[1]), np.uint8)
    filtered[:, 0] = _UP
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
    header = struct.pack(">IIBBBBB", width, height, *_RGB8)
    body = zlib.compress(filtered.tobytes(), 1)
    chunks = ((b"IHDR", header), (b"IDAT", body), (b"IEND", b""))
    return _SIGNATURE + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    checksum = zlib.crc32(data, zlib.crc32(kind))
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)
