"""Decoding of movie files from the key frame before each picture that is asked for."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import av

from physion.errors import BadInputError

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
    """Open a movie for decoding; `BadInputError` if it is missing, damaged or without pictures."""
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
        yield MovieDecoder(path, container)


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
