"""Names and encodings of the official files, shared by export and import.

Source: docs/official-system.md, sections 1, 2.6 and 4.
"""

from __future__ import annotations

import io
import re
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from physion.errors import BadInputError
from physion.physics.cloth.contact_gap import CLOTH_CONTACT_GAP
from physion.trials.metadata import MAX_SIDE

Bytes = NDArray[np.uint8]

ROOMS = {"box": "box", "bright": "tdw"}
"""Official names of rooms, by the name in this package."""
RAMPS = ("ramp_with_platform_30", "ramp_with_platform_60")
CLOTH_MODEL = "cloth_square"
CLOTH_THRESHOLD = 0.1222
"""Metres between the centres of particles below which official cloths touch the zone (.1220 to
.1225, by configuration)."""
CLOTH_DISTANCE = CLOTH_THRESHOLD - CLOTH_CONTACT_GAP
"""Metres by which ``minimum_distance_target_to_zone`` (between particle centres) exceeds the gap
between surfaces of this package; it makes each threshold valid for the other's data."""
TRIAL_FILE = "physion/trial_file"
"""Path of the embedded trial file in official files that this package exports."""
FLOW_FULL = 0.02
"""Motion per frame with full brightness in ``_flow``, as a fraction of the picture's width."""

_DEPTH_RANGE = 100.0 - 0.1
_NUMBERED = re.compile(r"(?P<config>.+)_(?P<number>\d{4})$")


def split_name(trial: str) -> tuple[str, str]:
    """Split the name of a stimulus, ``a_b_0007``, into configuration ``a_b`` and number ``0007``.

    A name without a number is number 0000 of a configuration of that name.
    """
    match = _NUMBERED.fullmatch(trial)
    return (match["config"], match["number"]) if match else (trial, "0000")


def redyellow_name(trial: str) -> str:
    """Return the name of the version of a stimulus with red agent and yellow patient."""
    config, number = split_name(trial)
    return f"{config}-redyellow_{number}"


def segmentation_colors(count: int) -> Bytes:
    """Return colours (count, 3) of the objects in ``_id`` pictures; the room is black.

    No two colours have the same value in any channel, because an official reader compares single
    channels. `BadInputError` for more than 255 objects.
    """
    if count > 255:
        raise BadInputError(
            f"{count} objects are more than the 255 that an _id picture can distinguish"
        )
    order = np.arange(count)
    # Steps that share no factor with 255 visit each of 1..255 once.
    return np.stack([1 + (order * step + start) % 255 for step, start in _STEPS], -1).astype(
        np.uint8
    )


_STEPS = ((97, 210), (151, 60), (41, 130))


def decode_picture(data: Bytes) -> Bytes:
    """Decode a PNG or JPEG to a picture (H, W, 3); `BadInputError` if it is neither."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data.tobytes()), formats=("PNG", "JPEG")) as image:
                if max(image.size) > MAX_SIDE:
                    raise BadInputError(f"picture of {image.size} pixels is too large")
                return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise BadInputError(f"not a PNG or JPEG picture: {error}") from error


def encode_depth(depth: NDArray[np.floating[Any]]) -> Bytes:
    """Encode depth (H, W) in metres as the triplets (H, W, 3) of ``_depth``, bottom row first.

    The resolution is 6 micrometres. Depth beyond 99.9 m and undefined depth become 99.9 m.
    """
    codes = np.clip(np.nan_to_num(depth, nan=np.inf), 0.0, _DEPTH_RANGE) / _DEPTH_RANGE * 2**24
    codes = np.minimum(np.rint(codes), 2**24 - 1).astype(np.uint32)
    triplets = np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=-1)
    return triplets.astype(np.uint8)[::-1]


def decode_depth(triplets: Bytes) -> NDArray[np.float64]:
    """Decode the triplets (H, W, 3) of ``_depth`` to depth (H, W) in metres."""
    weights = _DEPTH_RANGE / 256 / np.array([1.0, 256.0, 65536.0])
    return np.asarray((triplets[::-1].astype(np.float64) * weights).sum(axis=-1))


def encode_normals(normals: NDArray[np.floating[Any]], view: NDArray[np.float64]) -> Bytes:
    """Encode world normals (H, W, 3) as colours (H, W, 3) relative to the camera.

    -1..1 along the camera's right, up and backward axes becomes 0..255. The rows of ``view`` (3, 3)
    are the camera's right, down and forward axes, as returned by `rendering.camera.axes`.
    """
    seen = normals.astype(np.float64) @ (view * np.array([[1.0], [-1.0], [-1.0]])).T
    return np.asarray(np.rint((np.clip(seen, -1, 1) + 1) * 127.5).astype(np.uint8))


def encode_flow(flow: NDArray[np.floating[Any]]) -> Bytes:
    """Encode flow (H, W, 2) in pixels as colours (H, W, 3): hue is direction, brightness is speed.

    Red points right, further hues follow clockwise; black does not move; full brightness is
    `FLOW_FULL` of the picture's width or more. As in the official files, it is not metric.
    """
    moving = np.nan_to_num(flow).any(axis=-1)
    x, y = np.nan_to_num(flow[moving].astype(np.float64), posinf=0.0, neginf=0.0).T
    hue = np.arctan2(y, x) / (2 * np.pi) % 1.0
    value = np.minimum(np.hypot(x, y) / (FLOW_FULL * flow.shape[1]), 1.0)
    # Full saturation: each channel is a trapezoid over the hue, shifted by 120 degrees.
    thirds = np.array([0.0, 2.0, 4.0]) / 6
    wave = np.abs((hue[:, None] - thirds) % 1.0 - 0.5) * 6 - 1
    # Only moving pixels are computed: most do not move.
    colors = np.zeros((*moving.shape, 3), np.uint8)
    colors[moving] = np.rint(np.clip(wave, 0, 1) * value[:, None] * 255)
    return colors
