"""Comparison of a study's media files with its stimuli.csv, done before the study is served.

A lab may edit stimuli.csv or replace movies. A movie with one frame too many would show
participants what they are asked to predict.
"""

from __future__ import annotations

from pathlib import Path

import av
from PIL import Image

from physion.core.errors import BadInputError
from physion.core.files import check_plain
from physion.experiment.study.stimuli import Stimulus
from physion.experiment.study.study import Study


def check_media(study: Study) -> None:
    """Check that all movies and maps of a study are as stimuli.csv describes them.

    Movies must be H.264, which every browser plays, without sound. Frames are counted from the
    packets of the file, without decoding.

    Raises
    ------
    BadInputError
        Frames, size, rate or codec of a movie, or the size of a map, differ. The message names
        the first such file.
    """
    seen: set[tuple[str, int]] = set()
    for s in study.stimuli:
        for name, frames in ((s.movie, s.frames), (s.full, s.full_frames)):
            if name and (name, frames) not in seen:
                seen.add((name, frames))
                _check_movie(study.folder / name, frames, s)
        if (s.map, 0) not in seen:
            seen.add((s.map, 0))
            _check_map(study.folder / s.map, s)


def _check_movie(path: Path, frames: int, s: Stimulus) -> None:
    """Check the streams, frames, size, rate and codec of a movie."""
    check_plain(path)
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            if len(container.streams) != 1 or not container.streams.video:
                raise BadInputError(f"movie {path} must have one video stream and no other stream")
            stream = container.streams.video[0]
            context = stream.codec_context
            size = (context.width, context.height)
            rate, codec = float(stream.average_rate or 0), context.name
            counted = sum(1 for packet in container.demux(stream) if packet.size)
    except (av.FFmpegError, ValueError, AttributeError) as error:
        raise BadInputError(f"movie {path} cannot be read: {error}") from error
    if counted != frames:
        raise BadInputError(
            f"movie {path} has {counted} frames; stimuli.csv says {frames} of {s.stimulus}"
        )
    if size != (s.width, s.height) or abs(rate - s.rate) > 0.01:
        raise BadInputError(
            f"movie {path} is {size[0]} x {size[1]} at {rate:g} frames/s; stimuli.csv says "
            f"{s.width} x {s.height} at {s.rate:g} of {s.stimulus}"
        )
    if codec != "h264":
        raise BadInputError(f"movie {path} is {codec}, not H.264, which every browser plays")


def _check_map(path: Path, s: Stimulus) -> None:
    """Check that a map is a PNG of the movie's size."""
    check_plain(path)
    try:
        with Image.open(path, formats=["PNG"]) as picture:
            size = picture.size
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise BadInputError(f"map {path} is not a readable PNG image: {error}") from error
    if size != (s.width, s.height):
        raise BadInputError(
            f"map {path} is {size[0]} x {size[1]} pixels; stimuli.csv says "
            f"{s.width} x {s.height} of {s.stimulus}"
        )
