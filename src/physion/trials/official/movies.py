"""Import of official movies: copied without change if possible, otherwise encoded again.

The published movies have no tag for the coding of their colours; players, and ffmpeg which made
them, assume ITU-R BT.601 for movies of this size. Movies of this package are BT.709 and tagged so,
and its readers rely on it. Therefore a movie with this tag is copied byte by byte, and any other is
encoded again. The observed part is always encoded from its own frames only.
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

from physion.core.errors import BadInputError
from physion.scenes.scene import OBSERVED_FRAMES
from physion.trials.files import MAX_FRAMES, MAX_SIDE
from physion.trials.official.read_file import OfficialFile
from physion.trials.video import MovieEncoder, open_container

_BT709 = 1
_MPEG_RANGES = (0, 1)
"""Codes of the colour range: not specified, and limited range."""
_MATRICES = {_BT709: Colorspace.ITU709}
PICTURES = "images/_img"


def neighbouring_file(path: Path, folder: str, name: str) -> Path | None:
    """Return the file ``name`` in ``folder`` next to the folder of ``path``, or None if absent.

    Our exports keep configurations apart: ``configurations/Drop/<config>/0000.hdf5`` has its
    neighbours in ``Drop/<folder>``.
    """
    scenario = path.parent.parent
    for place in (scenario, scenario.parent.parent / scenario.name):
        found = place / folder / name
        if found.is_file() and not found.is_symlink():
            return found
    return None


class SourceMovie:
    """Reader of an official movie file; `BadInputError` if it is damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_symlink() or not path.is_file():
            raise BadInputError(f"movie {path} is not a regular file")
        with open_container(path) as container:
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
        """Yield all frames (H, W, 3) in sRGB."""
        reformatter = VideoReformatter()
        with open_container(self.path) as container:
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            try:
                for picture in container.decode(stream):
                    rgb = reformatter.reformat(
                        picture,
                        format="rgb24",
                        src_colorspace=self._matrix,
                        dst_color_range=ColorRange.JPEG,
                        threads=1,
                    )
                    yield rgb.to_ndarray()  # type: ignore[misc]
            except av.FFmpegError as error:
                raise BadInputError(f"movie {self.path} is damaged: {error}") from error


@dataclass(frozen=True)
class EncodedMovies:
    """Bytes of the two movies of a trial: ``full`` and ``observed``.

    ``size`` is (width, height) in pixels, ``frames`` the number of frames of the full movie,
    ``rate`` frames per second.
    """

    full: bytes
    observed: bytes
    size: tuple[int, int]
    frames: int
    rate: int


def read_movie(path: Path, frames: int | None = None) -> EncodedMovies:
    """Read and convert a movie file; `BadInputError` unless it has ``frames`` frames, if given."""
    source = SourceMovie(path)
    if frames is None:
        frames = sum(1 for _ in source.frames())
    made = make_movies(source.frames(), frames, source.rate)
    return replace(made, full=path.read_bytes()) if source.copied else made


def stored_frames(file: OfficialFile, frames: list[str]) -> Iterator[NDArray[np.uint8]]:
    """Yield the colour pictures (H, W, 3) stored in an official HDF5 file."""
    for frame in frames:
        yield file.picture(f"{frame}/{PICTURES}")


def make_movies(pictures: Iterable[NDArray[np.uint8]], frames: int, rate: int) -> EncodedMovies:
    """Encode ``frames`` pictures (H, W, 3) as movies at ``rate`` frames per second.

    Raises `BadInputError` if the number of pictures differs or their size changes.
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
        converted = full.add(picture)
        if index < OBSERVED_FRAMES:
            observed.add(converted)
    if full is None or observed is None:
        raise BadInputError("there is no picture")
    return EncodedMovies(full.finish(), observed.finish(), size, frames, rate)
