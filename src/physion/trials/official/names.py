"""Names and encodings of the official files, shared by export and import.

Source: docs/official-system.md, sections 1, 2.6 and 4.
"""

from __future__ import annotations

import io
import re
import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from physion.core.errors import BadInputError
from physion.physics.cloth.solver import CLOTH_CONTACT_GAP
from physion.rendering.camera import projection_matrix, view_matrix
from physion.scenes.scene import Camera
from physion.trials.files import MAX_SIDE

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
FLOW_FULL = 0.02
"""Motion per frame with full brightness in ``_flow``, as a fraction of the picture's width."""

EVALUATOR_LABELS = "all_video_labels.json"
"""File of version 1.5 with outcomes and frames of contacts, next to its movies."""
EVALUATOR_SPLITS = {"readout": "train", "testing": "test"}
"""Folders of version 1.5 by split."""
MARK = "-redyellow"
"""End of the names of configurations with red agent and yellow patient."""
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
    return f"{config.removesuffix(MARK)}{MARK}_{number}"


def shown_name(trial: str, split: str, look: str) -> str:
    """Return the official name of a trial in a look.

    A name without ``-redyellow`` shows the natural colours, except in the readout split, whose
    published movies are red and yellow under plain names.
    """
    marked = look == "redyellow" and split != "readout"
    return redyellow_name(trial) if marked else "_".join(split_name(trial))


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
    """Encode depth (H, W) in metres as the triplets (H, W, 3) of ``_depth``, top row first.

    The official writer stores what `TDWUtils.get_shaped_depth_pass` returns, which turns the rows
    of the raw pass (read in TDW 1.7.16 to 1.8.29), so the stored picture is upright.

    The resolution is 6 micrometres. Depth beyond 99.9 m and undefined depth become 99.9 m.
    """
    codes = np.clip(np.nan_to_num(depth, nan=np.inf), 0.0, _DEPTH_RANGE) / _DEPTH_RANGE * 2**24
    codes = np.minimum(np.rint(codes), 2**24 - 1).astype(np.uint32)
    triplets = np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=-1)
    return triplets.astype(np.uint8)


def decode_depth(triplets: NDArray[Any]) -> NDArray[np.float64]:
    """Decode the triplets (H, W, 3) of ``_depth`` to depth (H, W) in metres, rows as stored."""
    weights = _DEPTH_RANGE / 256 / np.array([1.0, 256.0, 65536.0])
    return np.asarray((triplets.astype(np.float64) * weights).sum(axis=-1))


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


# Conversion of arrays between the axes of this package and of the official files.
#
# This package: z up, right-handed, quaternions (w, x, y, z). Official files (Unity): y up,
# left-handed, quaternions (x, y, z, w). A point (x, y, z) here is (x, z, y) there. Swapping two
# axes is a reflection, so the sign of rotations and angular velocities changes as well. Arrays may
# have any leading axes (docs/official-system.md, section 1).

Floats = NDArray[np.float64]

SWAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
"""Matrix (3, 3) that converts a point from either system to the other."""
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Matrix from camera axes here (right, down, forward) to Unity's axes (right, up, backward)."""
_UPRIGHT = 1e-3
"""Largest vertical component of a camera's right axis that counts as a rounding error."""


def swap_axes(points: ArrayLike) -> Floats:
    """Convert points, directions or velocities (..., 3) to the other system; its own inverse."""
    return np.asarray(points, np.float64)[..., [0, 2, 1]]


def swap_angular_velocity(angular_velocities: ArrayLike) -> Floats:
    """Convert angular velocities (..., 3) to the other system; its own inverse."""
    return np.negative(swap_axes(angular_velocities))


def to_official_rotation(rotations: ArrayLike) -> Floats:
    """Convert quaternions (..., 4) from (w, x, y, z) here to official (x, y, z, w)."""
    q = np.asarray(rotations, np.float64)
    return np.stack([-q[..., 1], -q[..., 3], -q[..., 2], q[..., 0]], axis=-1)


def from_official_rotation(rotations: ArrayLike) -> Floats:
    """Convert official quaternions (..., 4), (x, y, z, w), to (w, x, y, z) here."""
    q = np.asarray(rotations, np.float64)
    return np.stack([q[..., 3], -q[..., 0], -q[..., 2], -q[..., 1]], axis=-1)


def rotation_matrices(rotations: ArrayLike) -> Floats:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4), which are normalised first."""
    q = np.asarray(rotations, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def to_official_euler(rotations: ArrayLike) -> Floats:
    """Convert quaternions (..., 4) to Unity's Euler angles (..., 3) in degrees, about x, y, z.

    They are applied in the order z, x, y. In gimbal lock (x is 90 or -90 degrees), z is 0.
    """
    m = SWAP @ rotation_matrices(rotations) @ SWAP
    x = np.arcsin(np.clip(-m[..., 1, 2], -1.0, 1.0))
    level = np.abs(m[..., 1, 2]) < 1.0 - 1e-9
    y = np.where(
        level,
        np.arctan2(m[..., 0, 2], m[..., 2, 2]),
        np.arctan2(-m[..., 2, 0], m[..., 0, 0]),
    )
    z = np.where(level, np.arctan2(m[..., 1, 0], m[..., 1, 1]), 0.0)
    return np.asarray(np.degrees(np.stack([x, y, z], axis=-1)) + 0.0)


def to_official_camera(camera: Camera, width: int, height: int) -> tuple[Floats, Floats]:
    """Return ``camera_matrix`` and ``projection_matrix`` (4, 4) of the official files.

    The first maps official world points to camera axes x right, y up, z backward (the determinant
    of its rotation is -1, as in the official files), the second maps these to OpenGL clip space.
    """
    swap = np.eye(4)
    swap[:3, :3] = SWAP
    world_to_camera = _OPENGL @ view_matrix(camera) @ swap
    return world_to_camera, projection_matrix(camera, width, height) @ _OPENGL


def from_official_camera(
    world_to_camera: Floats, projection: Floats, look_at: ArrayLike
) -> tuple[Camera, bool]:
    """Convert official camera matrices to a camera, and return whether it was upright.

    Parameters
    ----------
    world_to_camera, projection
        Official matrices (4, 4).
    look_at
        Point (3,) in axes of this package near which `Camera.target` is put, on the view axis;
        it does not change the picture.

    Returns
    -------
    camera, upright
        The camera, without roll, and False if the official one had roll.

    Raises
    ------
    BadInputError
        If the matrices do not belong to a perspective camera.
    """
    rotation = world_to_camera[:3, :3]
    if not np.isfinite(world_to_camera).all() or not np.allclose(
        rotation @ rotation.T, np.eye(3), 0, 1e-3
    ):
        raise BadInputError("the camera matrix is not a rotation with a translation")
    scale, a, b = projection[1, 1], projection[2, 2], projection[2, 3]
    if not np.isfinite(projection).all() or scale <= 0 or a in (1.0, -1.0):
        raise BadInputError("the projection matrix does not belong to a perspective camera")
    eye = swap_axes(-rotation.T @ world_to_camera[:3, 3])
    forward, right = swap_axes(-rotation[2]), swap_axes(rotation[0])
    distance = max(float((np.asarray(look_at) - eye) @ forward), 0.1)
    target = eye + distance * forward
    camera = Camera(
        position=(float(eye[0]), float(eye[1]), float(eye[2])),
        target=(float(target[0]), float(target[1]), float(target[2])),
        fov=float(2 * np.arctan(1 / scale)),
        near=round(float(b / (a - 1)), 4),
        far=round(float(b / (a + 1)), 1),
    )
    if not 0 < camera.near < camera.far:
        raise BadInputError(
            f"the clipping planes of the camera are at {camera.near} and {camera.far} m"
        )
    return camera, abs(float(right[2])) < _UPRIGHT
