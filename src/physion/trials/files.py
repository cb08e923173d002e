"""Encoding of pictures as PNG, and writing of the files of a trial."""

from __future__ import annotations

import io
import zlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from physion.atomic import write_atomic
from physion.trials.layout import TrialPaths


def encode_png(picture: NDArray[np.uint8], compress_level: int = 6) -> bytes:
    """Return the bytes of a PNG file of ``picture`` (H, W, 3 or 4), sRGB and alpha, 0..255.

    ``compress_level`` is zlib's, from 0 (fast) to 9 (small).
    """
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="png", compress_level=compress_level)
    return buffer.getvalue()


def same_picture(one: bytes, other: bytes) -> bool:
    """Return whether two PNG files differ at most in how their pixels are compressed.

    All chunks except those of the compressed pixels must be equal, so that a file with a damaged
    header or end is another one.
    """
    first, second = _uncompressed_chunks(one), _uncompressed_chunks(other)
    if first is None or first != second:
        return False
    try:
        left, right = (np.asarray(Image.open(io.BytesIO(data))) for data in (one, other))
    except (OSError, SyntaxError, ValueError, zlib.error):
        return False
    return np.array_equal(left, right)


def _uncompressed_chunks(data: bytes) -> list[bytes] | None:
    """Return all chunks of a PNG file but those of its pixels; None if one is damaged."""
    chunks, place = [data[:8]], 8
    while place < len(data):
        end = place + 12 + int.from_bytes(data[place : place + 4], "big")
        body, checksum = data[place + 4 : end - 4], data[end - 4 : end]
        if end > len(data) or zlib.crc32(body).to_bytes(4, "big") != checksum:
            return None
        if body[:4] != b"IDAT":
            chunks.append(body)
        place = end
    return chunks


def write_files(paths: TrialPaths, files: Mapping[str, bytes]) -> None:
    """Write the files of a trial, by names as in `TrialPaths.all`, the trial file last."""
    paths.trial_file.parent.mkdir(parents=True, exist_ok=True)
    for name, path in paths.all(free=True).items():
        if name in files:
            write_atomic(path, files[name])
