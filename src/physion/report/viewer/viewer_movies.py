"""Movies of the viewer: small ones for the grid, and one with all passes side by side."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.rendering.renderer import PASSES, Frame
from physion.report.viewer.passes import Ranges, paint, ranges_of
from physion.trials.trial_file import Trial
from physion.trials.video import encode_movie, read_frames

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
