"""Writing and reading of movies: H.264 in MP4, in memory.

The full movie and the observed movie of a trial are encoded separately: the observed one from its
own frames alone, so that the look-ahead of the encoder cannot carry over information of later
frames.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.scenes.scene import PLAYBACK_RATE

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
    kept: list[NDArray[np.uint8]] = []
    reformatter = VideoReformatter()
    for index, picture in _decode(path):
        if index < start or (index - start) % stride:
            continue
        height, width = size or (picture.height, picture.width)
        # Conversion takes three times as long as decoding, so only the needed frames are converted.
        rgb = reformatter.reformat(
            picture,
            width=width,
            height=height,
            format="rgb24",
            src_colorspace=Colorspace.ITU709,
            src_color_range=ColorRange.MPEG,
            dst_color_range=ColorRange.JPEG,
            interpolation=_CONVERSION,
        )
        kept.append(rgb.to_ndarray())  # type: ignore[arg-type]
        if len(kept) == count:
            break
    if not kept or (count is not None and len(kept) < count):
        wanted = "all frames" if count is None else f"{count} frames"
        raise BadInputError(
            f"movie {path} does not have the {wanted} requested from {start} in steps of {stride}: "
            f"it has {len(kept)}"
        )
    return np.stack(kept)


def count_frames(path: Path) -> int:
    """Return the number of frames according to the movie's index, without decoding."""
    with _open(path) as container:
        return int(container.streams.video[0].frames)


def _open(path: Path) -> Any:
    if not path.is_file():
        raise BadInputError(f"movie {path} is missing")
    try:
        container = av.open(str(path), metadata_errors="replace")
    except (av.FFmpegError, ValueError) as error:
        raise BadInputError(f"movie {path} cannot be read: {error}") from error
    # A stream whose header is damaged can lack a codec.
    if not container.streams.video or container.streams.video[0].codec_context is None:
        container.close()
        raise BadInputError(f"movie {path} holds no pictures")
    return container


def _decode(path: Path) -> Iterator[tuple[int, av.VideoFrame]]:
    """Yield index and picture of every frame in order; `BadInputError` at damage."""
    with _open(path) as container:
        stream = container.streams.video[0]
        stream.codec_context.thread_count = 1
        expected, index = stream.frames, 0
        try:
            for picture in container.decode(stream):
                if picture.is_corrupt:
                    raise BadInputError(f"movie {path} is damaged at frame {index}")
                yield index, picture
                index += 1
        except av.FFmpegError as error:
            raise BadInputError(f"movie {path} is damaged at frame {index}: {error}") from error
        if index != expected:
            raise BadInputError(f"movie {path} is cut short: {index} of {expected} frames")
