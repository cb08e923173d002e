"""Digest of an anchor: what it is, its settings, and what it was fitted to."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray


def settings_digest(
    model: str, version: int, settings: Any, weights: Iterable[NDArray[Any]] = ()
) -> str:
    """Return the hexadecimal SHA-256 of a model.

    Parameters
    ----------
    model
        Its name.
    version
        Of its code; to be increased with every change that can alter a prediction.
    settings
        JSON values, mappings with text as keys.
    weights
        Arrays that were fitted, in a fixed order.
    """
    sha = hashlib.sha256(json.dumps([model, version, settings], sort_keys=True).encode())
    for array in weights:
        sha.update(repr((array.shape, array.dtype.str)).encode())
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()
