"""Encoding of pictures as PNG, and writing of the files of a trial."""

from __future__ import annotations

import io
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


def write_files(paths: TrialPaths, files: Mapping[str, bytes]) -> None:
    """Write the files of a trial, by names as in `TrialPaths.all`, the trial file last."""
    paths.trial_file.parent.mkdir(parents=True, exist_ok=True)
    for name, path in paths.all(free=True).items():
        if name in files:
            write_atomic(path, files[name])
