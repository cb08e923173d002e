"""Movies of the viewer: image passes in colours, small movies for the grid, all passes at once."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import hsv_to_rgb
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.rendering.renderer import PASSES, Frame
from physion.scenes.scene import Scene
from physion.trials.trial_file import Trial
from physion.trials.video import encode_movie, read_frames

Picture = NDArray[np.uint8]

ROOM: tuple[int, int, int] = (38, 40, 44)
"""Colour of ids where there is no body."""
AGENT: tuple[int, int, int] = (230, 40, 40)
PATIENT: tuple[int, int, int] = (245, 205, 30)
OTHERS: tuple[tuple[int, int, int], ...] = (
    (78, 121, 167),
    (89, 161, 79),
    (176, 122, 161),
    (118, 183, 178),
    (156, 117, 95),
    (160, 203, 232),
    (140, 209, 125),
    (121, 112, 110),
    (212, 166, 200),
    (72, 96, 192),
)
"""Colours of all other things in turn; none passes for the red or the yellow of the roles."""
NOWHERE: tuple[int, int, int] = (128, 128, 128)
"""Flow that is not defined: the point passes behind the camera."""


@dataclass(frozen=True)
class Ranges:
    """Ends of the colour scales, the same for all frames of one trial.

    ``near``, ``far``: metres, ``far`` above ``near``. ``flow``: pixels per frame, above zero.
    """

    near: float
    far: float
    flow: float


def ranges_of(frames: Sequence[Frame]) -> Ranges:
    """Return scales that fit all ``frames``, which contain depth and flow.

    The most distant hundredth of the depths is left out, so that a window in a wall does not use up
    the scale; so is the fastest two-hundredth of the flow.
    """
    depths = [f.depth[np.isfinite(f.depth)] for f in frames if f.depth is not None]
    depth = np.concatenate(depths) if depths else np.zeros(0)
    near, far = (float(depth.min()), float(np.percentile(depth, 99))) if depth.size else (0.0, 1.0)
    speeds = [
        np.hypot(f.flow[..., 0], f.flow[..., 1]).ravel() for f in frames if f.flow is not None
    ]
    speed = np.concatenate(speeds) if speeds else np.zeros(0)
    speed = speed[np.isfinite(speed) & (speed > 1e-3)]
    flow = float(np.percentile(speed, 99.5)) if speed.size else 1.0
    return Ranges(near, max(far, near + 1e-3), max(flow, 1e-3))


def paint(frame: Frame, scene: Scene, ranges: Ranges) -> list[Picture]:
    """Return all passes of a frame as pictures (H, W, 3) uint8, in the order of `PASSES`."""
    assert frame.color is not None and frame.depth is not None and frame.normals is not None
    assert frame.ids is not None and frame.flow is not None
    painted = {
        "color": frame.color,
        "depth": paint_depth(frame.depth, ranges.near, ranges.far),
        "normals": paint_normals(frame.normals),
        "ids": paint_ids(frame.ids, scene),
        "flow": paint_flow(frame.flow, ranges.flow),
    }
    return [painted[name] for name in PASSES]


def paint_depth(depth: NDArray[np.floating], near: float, far: float) -> Picture:
    """Return depth (H, W) in metres as grey: bright at ``near``, dark at ``far`` and where
    undefined.
    """
    fraction = 1.0 - np.clip((np.asarray(depth, np.float64) - near) / (far - near), 0.0, 1.0)
    colors = colormaps["magma"](np.nan_to_num(fraction), bytes=True)
    return np.ascontiguousarray(colors[..., :3])


def paint_normals(normals: NDArray[np.floating]) -> Picture:
    """Return normals (H, W, 3) in world axes as colours: -1..1 along x, y, z as red, green, blue.

    Undefined normals are mid grey, which no unit normal has.
    """
    return _bytes(np.asarray(normals, np.float64) * 0.5 + 0.5)


def thing_colors(scene: Scene) -> list[tuple[int, int, int]]:
    """Return the colour of each of `Scene.names` in the picture of ids: agent red, patient
    yellow.
    """
    names = scene.names()
    roles = {scene.roles.agent: AGENT, scene.roles.patient: PATIENT}
    return [roles.get(name, OTHERS[i % len(OTHERS)]) for i, name in enumerate(names)]


def paint_ids(ids: NDArray[np.integer], scene: Scene) -> Picture:
    """Return ids (H, W), 0 the room and i + 1 the i-th of `Scene.names`, in the colours of the
    bodies.
    """
    table = np.array([ROOM, *thing_colors(scene)], np.uint8)
    return np.asarray(table[ids])


def paint_flow(flow: NDArray[np.floating], scale: float) -> Picture:
    """Return flow (H, W, 2), pixels right and down, as colours: direction as hue, speed as
    brightness.

    Red is to the right, and the hue goes through yellow (down), cyan (left) to violet (up). Full
    brightness is ``scale`` pixels or more, half of it a quarter of that, so that slow motion is
    visible; black is rest; grey is undefined.
    """
    x, y = (np.asarray(flow[..., k], np.float64) for k in (0, 1))
    known = np.isfinite(x) & np.isfinite(y)
    x, y = np.where(known, x, 0.0), np.where(known, y, 0.0)
    hue = np.arctan2(y, x) / (2 * np.pi) % 1.0
    speed = np.clip(np.hypot(x, y) / scale, 0.0, 1.0)
    colors = np.stack([hue, np.ones_like(hue), np.sqrt(speed)], axis=-1)
    picture = _bytes(hsv_to_rgb(colors))
    picture[~known] = NOWHERE
    return picture


def _bytes(values: NDArray[np.floating]) -> Picture:
    """Return values 0..1 as 0..255, rounded; others are clipped."""
    return np.asarray(np.rint(np.clip(np.nan_to_num(values), 0.0, 1.0) * 255), np.uint8)


# --- movies -------------------------------------------------------------------------------------

CRF = 25
"""Quality setting of x264 for small movies."""


@dataclass(frozen=True)
class Strip:
    """Movie whose every picture shows ``tiles`` side by side, each ``width`` x ``height``.

    It shows every ``stride``-th frame of the trial at ``rate`` pictures a second.
    """

    data: bytes
    tiles: tuple[str, ...]
    width: int
    height: int
    stride: int
    rate: int

    def as_record(self) -> dict[str, Any]:
        """Return the values for the page's script."""
        return {
            "data": base64.b64encode(self.data).decode("ascii"),
            "tiles": list(self.tiles),
            "width": self.width,
            "height": self.height,
            "stride": self.stride,
            "rate": self.rate,
        }


def fitted(width: int, height: int, longest: int) -> tuple[int, int]:
    """Return width and height, both even, of a picture whose longer side is about ``longest``."""
    scale = min(1.0, longest / max(width, height))
    even = [max(2, 2 * round(side * scale / 2)) for side in (width, height)]
    return even[0], even[1]


def small_movie(path: Path, trial: Trial, longest: int) -> Strip:
    """Return the movie at ``path`` scaled to ``longest`` pixels along its longer side, all frames.

    A trial that was made without movies is rendered from its state.
    """
    meta = trial.metadata
    width, height = fitted(meta.width, meta.height, longest)
    if meta.movies:
        frames = read_frames(path, size=(height, width))
        if len(frames) != meta.frames:
            raise BadInputError(f"{path} has {len(frames)} frames, its trial {meta.frames}")
    else:
        renderer = trial.renderer(width, height)
        frames = np.stack([_color(renderer.render(index)) for index in range(meta.frames)])
    data = encode_movie(frames, rate=meta.playback_rate, crf=CRF)
    return Strip(data, ("color",), width, height, 1, meta.playback_rate)


def _color(frame: Frame) -> NDArray[np.uint8]:
    assert frame.color is not None
    return frame.color


def passes_movie(trial: Trial, longest: int, stride: int) -> tuple[Strip, Ranges]:
    """Render all passes of every ``stride``-th frame from the state; return the movie and the
    scales.
    """
    meta = trial.metadata
    width, height = fitted(meta.width, meta.height, longest)
    renderer = trial.renderer(width, height)
    frames = [renderer.render(index, PASSES) for index in range(0, meta.frames, stride)]
    ranges = ranges_of(frames)
    pictures: NDArray[np.uint8] = np.stack(
        [np.concatenate(paint(frame, trial.scene, ranges), axis=1) for frame in frames]
    )
    rate = max(1, round(meta.playback_rate / stride))
    data = encode_movie(pictures, rate=rate, crf=CRF)
    return Strip(data, PASSES, width, height, stride, rate), ranges
