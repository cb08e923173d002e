"""What the official files call things, and how they pack pictures: shared by export and import.

Facts are from docs/official-system.md, sections 1, 2.6 and 4.
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
from physion.physics.labels import CLOTH_CONTACT_GAP

Bytes = NDArray[np.uint8]

ROOMS = {"box": "box", "bright": "tdw"}
"""What the official files call our rooms."""
RAMPS = ("ramp_with_platform_30", "ramp_with_platform_60")
CLOTH_MODEL = "cloth_square"
CLOTH_THRESHOLD = 0.1222
"""Metres between the centres of particles below which official cloths touch the zone (.1220 to
.1225, by configuration)."""
CLOTH_DISTANCE = CLOTH_THRESHOLD - CLOTH_CONTACT_GAP
"""What ``minimum_distance_target_to_zone`` is more than our gap between the surfaces, so that the
official threshold tells our outcomes, and our threshold the official ones."""
TRIAL_FILE = "physion/trial_file"
"""Where the bytes of the trial file are in an official file of ours."""
MAX_SIDE = 4096
"""Pixels; larger pictures are refused."""
FLOW_FULL = 0.02
"""Share of the picture's width that a point moves in a frame where ``_flow`` is brightest."""

_DEPTH_RANGE = 100.0 - 0.1
_NUMBERED = re.compile(r"(?P<config>.+)_(?P<number>\d{4})$")


def split_name(trial: str) -> tuple[str, str]:
    """Configuration and number of a stimulus: ``a_b_0007`` is 7 of ``a_b``.

    A name without a number is the first of a configuration of its own.
    """
    match = _NUMBERED.fullmatch(trial)
    return (match["config"], match["number"]) if match else (trial, "0000")


def redyellow_name(trial: str) -> str:
    """The stimulus name of the version with red agent and yellow patient."""
    config, number = split_name(trial)
    return f"{config}-redyellow_{number}"


def segmentation_colors(count: int) -> Bytes:
    """Colours (count, 3) for the objects in ``_id``; the room is black.

    No two share a channel's value, nor does one with the room: an official reader takes a pixel
    for an object where a single channel agrees. `BadInputError` beyond 255 objects.
    """
    if count > 255:
        raise BadInputError(f"{count} objects are more than the 255 that an _id picture can tell")
    order = np.arange(count)
    # Steps that share no factor with 255 visit each of 1..255 once.
    return np.stack([1 + (order * step + start) % 255 for step, start in _STEPS], -1).astype(
        np.uint8
    )


_STEPS = ((97, 210), (151, 60), (41, 130))


def decode_picture(data: Bytes) -> Bytes:
    """The picture (H, W, 3) in the bytes of a PNG or JPEG; `BadInputError` if there is none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data.tobytes()), formats=("PNG", "JPEG")) as image:
                if max(image.size) > MAX_SIDE:
                    raise BadInputError(f"picture of {image.size} pixels is too large to be true")
                return np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise BadInputError(f"no PNG or JPEG picture: {error}") from error


def encode_depth(depth: NDArray[np.floating[Any]]) -> Bytes:
    """Depth (H, W) in metres as the triplets (H, W, 3) of ``_depth``, bottom row first.

    Resolved to 6 micrometres; what lies beyond 99.9 m, or nowhere, is there.
    """
    codes = np.clip(np.nan_to_num(depth, nan=np.inf), 0.0, _DEPTH_RANGE) / _DEPTH_RANGE * 2**24
    codes = np.minimum(np.rint(codes), 2**24 - 1).astype(np.uint32)
    triplets = np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=-1)
    return triplets.astype(np.uint8)[::-1]


def decode_depth(triplets: Bytes) -> NDArray[np.float64]:
    """Depth (H, W) in metres from the triplets of ``_depth``."""
    weights = _DEPTH_RANGE / 256 / np.array([1.0, 256.0, 65536.0])
    return np.asarray((triplets[::-1].astype(np.float64) * weights).sum(axis=-1))


def encode_normals(normals: NDArray[np.floating[Any]], view: NDArray[np.float64]) -> Bytes:
    """World normals (H, W, 3), ours, as colours (H, W, 3) relative to the camera.

    -1..1 becomes 0..255 along the camera's right, up and backward axes. ``view`` (3, 3) holds the
    camera's right, down and forward axes in its rows, as `rendering.camera.axes` has them.
    """
    seen = normals.astype(np.float64) @ (view * np.array([[1.0], [-1.0], [-1.0]])).T
    return np.asarray(np.rint((np.clip(seen, -1, 1) + 1) * 127.5).astype(np.uint8))


def encode_flow(flow: NDArray[np.floating[Any]]) -> Bytes:
    """Flow (H, W, 2) in pixels as colours (H, W, 3): hue its direction, brightness its size.

    Red is to the right, then by the colour wheel clockwise; black is still; full brightness is
    `FLOW_FULL` of the picture's width or more. A picture, not a measurement, as there.
    """
    moving = np.nan_to_num(flow).any(axis=-1)
    x, y = np.nan_to_num(flow[moving].astype(np.float64), posinf=0.0, neginf=0.0).T
    hue = np.arctan2(y, x) / (2 * np.pi) % 1.0
    value = np.minimum(np.hypot(x, y) / (FLOW_FULL * flow.shape[1]), 1.0)
    # Full saturation: each channel is a trapezoid over the hue, a third of a turn apart.
    thirds = np.array([0.0, 2.0, 4.0]) / 6
    wave = np.abs((hue[:, None] - thirds) % 1.0 - 0.5) * 6 - 1
    # Most of a picture stands still.
    colors = np.zeros((*moving.shape, 3), np.uint8)
    colors[moving] = np.rint(np.clip(wave, 0, 1) * value[:, None] * 255)
    return colors
