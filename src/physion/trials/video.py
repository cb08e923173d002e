"""Writing and reading of movies: H.264 in MP4.

The full movie and the observed movie of a trial are encoded separately: the observed one from its
own frames only, so that the look-ahead of the encoder cannot carry over information of later
frames.
"""

from __future__ import annotations

import io
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.scenes.scene import PLAYBACK_RATE

# Decoding of movie files from the key frame before each picture that is asked for.

_IDR = 5
"""Type of the NAL units of an IDR picture."""


class MovieProperties(NamedTuple):
    """Number of frames of a movie, its size in pixels, and its frames per second."""

    frames: int
    width: int
    height: int
    rate: float

    def __str__(self) -> str:
        size = f"{self.width} x {self.height} pixels"
        return f"{self.frames} frames of {size} at {self.rate:g} a second"

    def same(self, other: MovieProperties) -> bool:
        """Return whether both are equal, the rate to a millionth."""
        return self[:3] == other[:3] and abs(self.rate - other.rate) <= 1e-6 * self.rate


class MovieDecoder:
    """Decoder of the pictures of one open movie, made by `open_movie`.

    An H.264 movie of a constant rate is entered at the key frame before a picture, so that the cost
    of a picture does not depend on where it lies. Pictures are the same as when all before them are
    decoded, since nothing after an IDR picture refers to anything before it. Where a key frame is
    of another kind (an open group of pictures), and in other movies, all is decoded from the start.
    """

    def __init__(self, path: Path, container: Any) -> None:
        self._path, self._container = path, container
        self._stream = container.streams.video[0]
        self._stream.codec_context.thread_count = 1
        self.frames = int(self._stream.frames)
        """Number of frames according to the movie's index; 0 if it does not say."""
        self._step, self._keys = _frame_times(self._stream)
        self._pictures = container.decode(self._stream)
        self._next = 0

    @property
    def properties(self) -> MovieProperties:
        """Properties according to the movie's index."""
        context = self._stream.codec_context
        rate = float(self._stream.average_rate or 0)
        return MovieProperties(self.frames, int(context.width), int(context.height), rate)

    def pictures(self, frames: Iterable[int]) -> Iterator[av.VideoFrame]:
        """Yield the pictures of ``frames``, which increase.

        Raises `BadInputError` if the movie is damaged, or ends before one of them.
        """
        for frame in frames:
            key = self._keys[bisect_right(self._keys, frame) - 1] if self._keys else 0
            if key > self._next and not self._seek(key):
                self._keys = []
                self._seek(0)
            for index, picture in self._decode():
                if index == frame:
                    yield picture
                    break

    def finish(self) -> None:
        """Decode what follows; `BadInputError` if the movie is damaged or cut short."""
        for _ in self._decode(to_end=True):
            pass

    def _seek(self, key: int) -> bool:
        """Continue with the key frame ``key``; return whether it can be decoded by itself."""
        try:
            offset = self._stream.start_time + key * self._step
            self._container.seek(offset, stream=self._stream, backward=True)
            packets = self._container.demux(self._stream)
            first = next(packets)
        except (av.FFmpegError, OSError) as error:
            raise self._damaged(key, error) from error
        self._pictures, self._next = _decode_packets(chain([first], packets)), key
        return _is_idr(bytes(first))

    def _decode(self, to_end: bool = False) -> Iterator[tuple[int, av.VideoFrame]]:
        """Yield index and picture of the frames from ``self._next`` on.

        The movie must not end before the caller does, unless ``to_end`` is set and all its frames
        were decoded.
        """
        try:
            for picture in self._pictures:
                index = self._index(picture)
                if index < self._next:
                    continue  # from before the key frame
                if index > self._next or picture.is_corrupt:
                    raise self._damaged(self._next)
                self._next += 1
                yield index, picture
        except av.FFmpegError as error:
            raise self._damaged(self._next, error) from error
        if not to_end or self._next != self.frames:
            raise BadInputError(
                f"movie {self._path} is cut short: {self._next} of {self.frames} frames"
            )

    def _index(self, picture: av.VideoFrame) -> int:
        """Return the index of a picture by its time, or by counting if the rate is not constant."""
        if self._step == 0 or picture.pts is None:
            return self._next
        return int((picture.pts - self._stream.start_time) // self._step)

    def _damaged(self, frame: int, error: Exception | None = None) -> BadInputError:
        reason = "" if error is None else f": {error}"
        return BadInputError(f"movie {self._path} is damaged at frame {frame}{reason}")


@contextmanager
def open_movie(path: Path) -> Iterator[MovieDecoder]:
    """Open a movie for decoding; raise as `open_container`."""
    with open_container(path) as container:
        yield MovieDecoder(path, container)


@contextmanager
def open_container(path: Path) -> Iterator[Any]:
    """Open a movie as av does; `BadInputError` if it is missing, damaged or without pictures."""
    if not path.is_file():
        raise BadInputError(f"movie {path} is missing")
    try:
        container: Any = av.open(str(path), metadata_errors="replace")
    except (av.FFmpegError, ValueError) as error:
        raise BadInputError(f"movie {path} cannot be read: {error}") from error
    with container:
        # A stream whose header is damaged can lack a codec.
        if not container.streams.video or container.streams.video[0].codec_context is None:
            raise BadInputError(f"movie {path} holds no pictures")
        yield container


def _decode_packets(packets: Iterable[Any]) -> Iterator[av.VideoFrame]:
    for packet in packets:
        yield from packet.decode()


def _is_idr(packet: bytes) -> bool:
    """Return whether a packet of H.264 as MP4 stores it holds an IDR picture.

    It is a sequence of NAL units, each after its length in four bytes. The last five bits of a unit
    are its type (ITU-T H.264, table 7-1).
    """
    start = 0
    while start + 4 < len(packet):
        if packet[start + 4] & 0x1F == _IDR:
            return True
        start += 4 + int.from_bytes(packet[start : start + 4], "big")
    return False


def _frame_times(stream: Any) -> tuple[int, list[int]]:
    """Return the time from frame to frame in ``stream.time_base``, and the key frames.

    Without a constant rate, or where the index does not list every frame, they are 0 and empty:
    such a movie is decoded from the start. So is one that is not H.264 with lengths of four bytes.
    """
    entries = list(getattr(stream, "index_entries", None) or ())  # absent in older versions of av
    if len(entries) < 2 or len(entries) != stream.frames or stream.start_time is None:
        return 0, []
    times = [entry.timestamp for entry in entries]
    steps = {after - before for before, after in pairwise(times)}
    if len(steps) != 1 or min(steps) < 1 or any(entry.is_discard for entry in entries):
        return 0, []
    settings = bytes(stream.codec_context.extradata or b"")
    lengths = settings[4] & 3 if len(settings) > 4 and settings[0] == 1 else None
    if stream.codec_context.name != "h264" or lengths != 3:
        return min(steps), []
    # Entries are in the order of decoding. All that is decoded before an IDR picture is shown
    # before it, so that the n-th entry, if it is one, is the n-th frame.
    return min(steps), [index for index, entry in enumerate(entries) if entry.is_keyframe]


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

    - ``width``, ``height``: size of the pictures in pixels, both even.
    - ``frames``: number of frames that will be added. It is needed in advance because the index is
      placed before the pictures, so that a browser can play while it loads ("faststart").
    - ``rate``: frames per second.
    - ``crf``: quality of x264, lower is better.
    - ``causal``: encode each frame from those before it only, so that movies with equal pictures up
      to a frame are equal up to there; it takes more bytes.
    """

    def __init__(
        self,
        width: int,
        height: int,
        frames: int,
        *,
        rate: int = PLAYBACK_RATE,
        crf: int = CRF,
        causal: bool = False,
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
        if causal:
            stream.options = {**stream.options, "tune": "zerolatency"}
        # Without these tags players guess the matrix, which turns saturated red into orange.
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = int(ColorRange.MPEG)
        self._stream = stream
        self._reformatter = VideoReformatter()

    def add(self, frame: NDArray[np.uint8] | av.VideoFrame) -> av.VideoFrame:
        """Append one picture: (height, width, 3), sRGB, 0..255.

        Returns it as it is encoded, which another encoder for pictures of this size and rate takes
        too, without converting it again.
        """
        picture = frame if isinstance(frame, av.VideoFrame) else self._converted(frame)
        picture.pts = self._added
        self._container.mux(self._stream.encode(picture))
        self._added += 1
        return picture

    def _converted(self, frame: NDArray[np.uint8]) -> av.VideoFrame:
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise BadInputError(
                f"movie frame {self._added} is {frame.dtype} {frame.shape}, not uint8 {self._shape}"
            )
        return self._reformatter.reformat(
            av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24"),
            format="yuv420p",
            dst_colorspace=Colorspace.ITU709,
            src_color_range=ColorRange.JPEG,
            dst_color_range=ColorRange.MPEG,
            interpolation=_CONVERSION,
            threads=1,
        )

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


def replace_end(path: Path, later: NDArray[np.uint8]) -> bytes:
    """Return the bytes of a movie that ends with ``later``; the frames before stay exactly."""
    with open_movie(path) as decoder:
        frames, width, height, rate = decoder.properties
        encoder = MovieEncoder(width, height, frames, rate=round(rate), crf=0)
        for picture in decoder.pictures(range(frames - len(later))):
            plain = av.VideoFrame.from_ndarray(picture.to_ndarray(), format=picture.format.name)
            encoder.add(plain)  # without time and type in the first movie
    for frame in later:
        encoder.add(frame)
    return encoder.finish()


def repack_movie(path: Path) -> bytes:
    """Return the bytes of an MP4 file with the same pictures, and nothing else of the first one."""
    buffer = io.BytesIO()
    with av.open(str(path)) as source, av.open(buffer, "w", format="mp4") as target:
        known = source.streams.video[0]
        stream = target.add_stream_from_template(known)
        for packet in source.demux(known):
            if packet.dts is not None:  # the last one is empty
                packet.stream = stream
                target.mux(packet)
    return buffer.getvalue()


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


def _convert_all(
    decoder: MovieDecoder, frames: Sequence[int], size: tuple[int, int] | None
) -> NDArray[np.uint8]:
    """Return the pictures of ``frames`` as (len(frames), height, width, 3) in sRGB."""
    out = np.empty((0, 0, 0, 3), np.uint8)
    # Conversion takes as long as decoding, so only the needed frames are converted. Further threads
    # would take longer to wake up than pictures of these sizes take.
    reformatter = VideoReformatter()
    for row, picture in enumerate(decoder.pictures(frames)):
        height, width = size or (picture.height, picture.width)
        rgb: Any = reformatter.reformat(
            picture,
            width=width,
            height=height,
            format="rgb24",
            src_colorspace=Colorspace.ITU709,
            src_color_range=ColorRange.MPEG,
            dst_color_range=ColorRange.JPEG,
            interpolation=_CONVERSION,
            threads=1,
        )
        if row == 0:
            out = np.empty((len(frames), height, width, 3), np.uint8)
        out[row] = rgb.to_ndarray()
    return out
