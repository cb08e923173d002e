"""Movies of official trials, brought over: copied as they are, or encoded again.

The published movies do not say how their colours are coded; players, and ffmpeg which made them,
take such small ones for ITU-R BT.601. Ours are BT.709 and say so, and all our readers rely on it.
So a movie that says so is copied byte by byte, and any other is encoded again. The observed part
is always encoded from its own frames alone: nothing in it has seen the future.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.scenes.scene import OBSERVED_FRAMES
from physion.trials.official.names import MAX_SIDE
from physion.trials.official.read_hdf5 import MAX_FRAMES, OfficialFile
from physion.trials.video import MovieEncoder

_BT709 = 1
_MPEG_RANGES = (0, 1)
"""Unsaid, or said to be the usual one of movies."""
_MATRICES = {_BT709: Colorspace.ITU709}
PICTURES = "images/_img"


def beside(path: Path, folder: str, name: str) -> Path | None:
    """A file of PhysionTest-Core that belongs to one in a folder beside its own, if it is there."""
    found = path.parent.parent / folder / name
    return found if found.is_file() and not found.is_symlink() else None


class SourceMovie:
    """An official movie file: what it says of itself, and its frames. `BadInputError` if broken."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_symlink() or not path.is_file():
            raise BadInputError(f"movie {path} is no plain file")
        with self._open() as container:
            stream: Any = container.streams.video[0]
            context = stream.codec_context
            self.width, self.height = int(context.width), int(context.height)
            self.rate = max(round(float(stream.average_rate or 30)), 1)
            self.pixels, self.streams = str(context.pix_fmt), len(container.streams)
            self.copied = (
                context.name == "h264"
                and int(context.colorspace) == _BT709
                and int(context.color_range) in _MPEG_RANGES
                and container.format.name.startswith("mov")
            )
            self._matrix = _MATRICES.get(int(context.colorspace), Colorspace.ITU601)
        if max(self.width, self.height) > MAX_SIDE:
            raise BadInputError(f"movie {path} is {self.width} x {self.height} pixels large")

    def frames(self) -> Iterator[NDArray[np.uint8]]:
        """All frames (H, W, 3) in sRGB, one by one."""
        reformatter = VideoReformatter()
        with self._open() as container:
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            try:
                for picture in container.decode(stream):
                    rgb = reformatter.reformat(
                        picture,
                        format="rgb24",
                        src_colorspace=self._matrix,
                        dst_color_range=ColorRange.JPEG,
                    )
                    yield rgb.to_ndarray()  # type: ignore[misc]
            except av.FFmpegError as error:
                raise BadInputError(f"movie {self.path} is damaged: {error}") from error

    def _open(self) -> Any:
        try:
            container = av.open(str(self.path), metadata_errors="replace")
        except (av.FFmpegError, ValueError) as error:
            raise BadInputError(f"movie {self.path} cannot be read: {error}") from error
        if not container.streams.video or container.streams.video[0].codec_context is None:
            container.close()
            raise BadInputError(f"movie {self.path} holds no pictures")
        return container


@dataclass(frozen=True)
class Movies:
    """The bytes of a trial's movies: all frames, and the observed ones alone.

    ``size`` is (width, height) in pixels, ``frames`` how many there are in all, ``rate`` frames a
    second.
    """

    full: bytes
    observed: bytes
    size: tuple[int, int]
    frames: int
    rate: int


def read_movie(path: Path, frames: int | None = None) -> Movies:
    """A movie file as ours; `BadInputError` unless it has as many frames as asked for, if any."""
    source = SourceMovie(path)
    if frames is None:
        frames = sum(1 for _ in source.frames())
    made = make_movies(source.frames(), frames, source.rate)
    return replace(made, full=path.read_bytes()) if source.copied else made


def stored_frames(file: OfficialFile, frames: list[str]) -> Iterator[NDArray[np.uint8]]:
    """The colour pictures (H, W, 3) inside an official HDF5 file, one by one."""
    for frame in frames:
        yield file.picture(f"{frame}/{PICTURES}")


def make_movies(pictures: Iterable[NDArray[np.uint8]], frames: int, rate: int) -> Movies:
    """Movies of ``frames`` pictures (H, W, 3) at ``rate`` a second.

    Pictures of another number or of changing size raise `BadInputError`.
    """
    if not OBSERVED_FRAMES < frames <= MAX_FRAMES:
        raise BadInputError(
            f"{frames} frames; a trial has more than the {OBSERVED_FRAMES} observed ones and at "
            f"most {MAX_FRAMES}"
        )
    full = observed = None
    size = (0, 0)
    for index, picture in enumerate(pictures):
        if full is None or observed is None:
            size = picture.shape[1], picture.shape[0]
            full = MovieEncoder(*size, frames, rate=rate)
            observed = MovieEncoder(*size, OBSERVED_FRAMES, rate=rate)
        if index >= frames:
            raise BadInputError(f"there are more than {frames} pictures")
        full.add(picture)
        if index < OBSERVED_FRAMES:
            observed.add(picture)
    if full is None or observed is None:
        raise BadInputError("there is no picture")
    return Movies(full.finish(), observed.finish(), size, frames, rate)
