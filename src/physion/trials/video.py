"""Writing and reading of movies: H.264 in MP4.

The full movie and the observed movie of a trial are encoded separately: the observed one from its
own frames alone, so that the look-ahead of the encoder cannot carry over information of later
frames.
"""

from __future__ import annotations

import io
import os
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.scenes.scene import PLAYBACK_RATE
from physion.trials.decoder import MovieDecoder, MovieProperties, open_movie

CRF = 18
"""Quality of x264; at lower values the chroma subsampling of yuv420p limits the quality."""
GROUP = 15
"""Frames from one key frame to the next; a seek decodes at most half a second."""
X264 = "cpu-independent=1"
"""Option of x264 without which the bytes of some movies depend on the processor."""
_BT709 = 1
"""Code of ITU-R BT.709 in H.264, the same for matrix, primaries and transfer function."""
_CONVERSION = int(
    Interpolation.AREA
    | Interpolation.FULL_CHR_H_INT
    | Interpolation.ACCURATE_RND
    | Interpolation.BITEXACT
)
"""Flags with which swscale scales pictures and converts colours. Without exact rounding, scaling
darkens a uniform grey by 2 of 255; without ``BITEXACT``, results depend on the processor."""
_INDEX_BYTES = (2048, 24)
"""Bytes reserved for the index at the start of the file: for the header, and for each frame."""


class MovieEncoder:
    """Encoder of one MP4 file; equal frames give equal bytes.

    Parameters
    ----------
    width, height
        Size of the pictures in pixels, both even.
    frames
        Number of frames that will be added. It is needed in advance because the index is placed
        before the pictures, so that a browser can play while it loads ("faststart").
    rate
        Frames per second.
    crf
        Quality of x264, lower is better.
    """

    def __init__(
        self, width: int, height: int, frames: int, *, rate: int = PLAYBACK_RATE, crf: int = CRF
    ) -> None:
        if width % 2 or height % 2 or min(width, height) < 2:
            raise BadInputError(
                f"a movie needs an even width and height, not {width} x {height} pixels"
            )
        self._expected, self._added = frames, 0
        self._shape = (height, width, 3)
        self._buffer = io.BytesIO()
        index_bytes = _INDEX_BYTES[0] + _INDEX_BYTES[1] * frames
        self._container = av.open(
            self._buffer, "w", format="mp4", options={"moov_size": str(index_bytes)}
        )
        stream: Any = self._container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {
            "crf": str(crf),
            "preset": "veryfast",
            "g": str(GROUP),
            "threads": "1",
            "x264-params": X264,
        }
        # Without these tags players guess the matrix, which turns saturated red into orange.
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = int(ColorRange.MPEG)
        self._stream = stream
        self._reformatter = VideoReformatter()

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append one picture: (height, width, 3), sRGB, 0..255."""
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise BadInputError(
                f"movie frame {self._added} is {frame.dtype} {frame.shape}, not uint8 {self._shape}"
            )
        picture = self._reformatter.reformat(
            av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24"),
            format="yuv420p",
            dst_colorspace=Colorspace.ITU709,
            src_color_range=ColorRange.JPEG,
            dst_color_range=ColorRange.MPEG,
            interpolation=_CONVERSION,
        )
        picture.pts = self._added
        self._container.mux(self._stream.encode(picture))
        self._added += 1

    def finish(self) -> bytes:
        """Close the movie and return the bytes of its file."""
        if self._added != self._expected:
            raise BadInputError(f"movie got {self._added} frames, not {self._expected}")
        self._container.mux(self._stream.encode())
        self._container.close()
        return self._buffer.getvalue()


def encode_movie(frames: NDArray[np.uint8], *, rate: int = PLAYBACK_RATE, crf: int = CRF) -> bytes:
    """Return the bytes of a movie of ``frames`` (F, H, W, 3), sRGB, at ``rate`` per second."""
    encoder = MovieEncoder(frames.shape[2], frames.shape[1], len(frames), rate=rate, crf=crf)
    for frame in frames:
        encoder.add(frame)
    return encoder.finish()


def read_frames(
    path: Path,
    *,
    start: int = 0,
    count: int | None = None,
    stride: int = 1,
    size: tuple[int, int] | None = None,
) -> NDArray[np.uint8]:
    """Read frames ``start``, ``start + stride``, ... of a movie.

    Decoding begins at the key frame before ``start``. A movie whose end is not asked for is not
    checked to its end.

    Parameters
    ----------
    path
        Movie file.
    start, stride
        First frame, and distance between frames.
    count
        Number of frames to return; by default all to the end.
    size
        (height, width) in pixels to scale to by area averaging; by default the movie's own.

    Returns
    -------
    frames
        (count, height, width, 3) in sRGB, 0..255.

    Raises
    ------
    BadInputError
        If the movie is missing, damaged, cut short, or has fewer frames than requested.
    """
    if start < 0 or stride < 1 or (count is not None and count < 1):
        raise BadInputError(f"no frames at start {start}, stride {stride}, count {count}")
    with open_movie(path) as decoder:
        there = len(range(start, decoder.frames, stride))
        if there < (count or 1):
            wanted = "all frames" if count is None else f"{count} frames"
            raise BadInputError(
                f"movie {path} does not have the {wanted} requested from {start} in steps of "
                f"{stride}: it has {there}"
            )
        chosen = range(start, start + (count or there) * stride, stride)
        frames = _convert_all(decoder, chosen, size)
        if count is None:
            decoder.finish()
    return frames


def read_chosen(
    path: Path,
    frames: Sequence[int],
    *,
    size: tuple[int, int] | None = None,
    expected: MovieProperties | None = None,
) -> NDArray[np.uint8]:
    """Read the frames of a movie with the indices ``frames``, which must not decrease.

    Parameters
    ----------
    path
        Movie file.
    frames
        Indices of frames; a repeated one is returned again.
    size
        (height, width) in pixels to scale to by area averaging; by default the movie's own.
    expected
        Properties that the movie must have.

    Returns
    -------
    frames
        (len(frames), height, width, 3) in sRGB, 0..255.

    Raises
    ------
    BadInputError
        If the movie is missing, damaged, cut short, or not as expected.
    """
    indices = np.asarray(frames, np.int64)
    if not len(indices) or indices[0] < 0 or (np.diff(indices) < 0).any():
        raise BadInputError(f"frames must start at 0 or later and not decrease, not {list(frames)}")
    chosen, rows = np.unique(indices, return_inverse=True)
    with open_movie(path) as decoder:
        known = decoder.properties
        if expected is not None and not known.same(expected):
            raise BadInputError(
                f"movie {path} has {known}, not {expected} as expected; make the trial again"
            )
        if chosen[-1] >= known.frames:
            raise BadInputError(f"movie {path} has no frame {chosen[-1]}: it has {known.frames}")
        pictures = _convert_all(decoder, chosen.tolist(), size)
    return pictures if len(chosen) == len(indices) else pictures[rows]


def count_frames(path: Path) -> int:
    """Return the number of frames according to the movie's index, without decoding."""
    with open_movie(path) as decoder:
        return decoder.frames


class _Reformatters(threading.local):
    """One reformatter for each thread: it keeps tables between pictures of one size."""

    def __init__(self) -> None:
        self.rgb = VideoReformatter()


_reformatters = _Reformatters()
_of_parents: list[_Reformatters] = []


def _renew_reformatters() -> None:
    """Replace the reformatters in a forked process, which has none of the threads they wait for."""
    global _reformatters
    # To free them would wait for the threads, too.
    _of_parents.append(_reformatters)
    _reformatters = _Reformatters()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_reformatters)


def _convert_all(
    decoder: MovieDecoder, frames: Sequence[int], size: tuple[int, int] | None
) -> NDArray[np.uint8]:
    """Return the pictures of ``frames`` as (len(frames), height, width, 3) in sRGB."""
    out = np.empty((0, 0, 0, 3), np.uint8)
    # Conversion takes as long as decoding, so only the needed frames are converted.
    for row, picture in enumerate(decoder.pictures(frames)):
        height, width = size or (picture.height, picture.width)
        rgb: Any = _reformatters.rgb.reformat(
            picture,
            width=width,
            height=height,
            format="rgb24",
            src_colorspace=Colorspace.ITU709,
            src_color_range=ColorRange.MPEG,
            dst_color_range=ColorRange.JPEG,
            interpolation=_CONVERSION,
        )
        if row == 0:
            out = np.empty((len(frames), height, width, 3), np.uint8)
        out[row] = rgb.to_ndarray()
    return out
