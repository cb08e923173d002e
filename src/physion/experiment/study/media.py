"""Movies and maps of a study: cut to what may be seen, checked, and named by their content.

A movie that is shown before the answer holds the observed frames and nothing after them. One that
holds exactly these is copied byte by byte; from any other the observed frames are encoded anew,
without the encoder ever seeing the next one. File names are SHA-256 of the content and so tell
neither stimulus nor outcome.
"""

from __future__ import annotations

import hashlib
import io
import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from physion.atomic import write_atomic
from physion.errors import BadInputError
from physion.experiment.study.plain_files import read_plain
from physion.experiment.study.stimuli import MAX_SIDE, MEDIA_FOLDER, Stimulus
from physion.scenes.scene import OBSERVED_FRAMES
from physion.trials.files import encode_png
from physion.trials.official.movies import SourceMovie
from physion.trials.video import MovieEncoder, read_frames

MAX_MOVIE_BYTES = 500_000_000
MAX_RATE = 60
"""Frames a second that a common screen shows; of a faster movie, frames would be left out."""


@dataclass(frozen=True)
class Source:
    """A stimulus that a study is to have, and where its files are.

    ``movie`` has all frames, ``observed`` (where there is one) the observed ones alone, ``map``
    agent and patient. ``digests`` are the SHA-256 that these three should have, where known. The
    rest is as in `Stimulus`.
    """

    stimulus: str
    scenario: str
    phase: str
    place: int
    label: bool
    look: str
    movie: Path
    map: Path
    observed: Path | None = None
    frames: int = OBSERVED_FRAMES
    digests: Mapping[str, str] = field(default_factory=dict)

    @property
    def files(self) -> dict[str, Path]:
        """The files that are read, by their names here: the whole movie only where it is needed."""
        found = {"map": self.map}
        if self.observed is not None:
            found["observed"] = self.observed
        if self.observed is None or self.phase == "familiarization":
            found["movie"] = self.movie
        return found


def take_stimulus(source: Source, folder: Path) -> Stimulus:
    """Write the media of a stimulus into the study's ``folder``; its row.

    `BadInputError` names the file where a movie has too few frames (or an observed one too many),
    is damaged, is a link, is faster than screens, or where the map does not fit to it.
    """
    practice = source.phase == "familiarization"
    shown = _observed(source)
    full, full_frames = _whole(source, shown) if practice else (b"", 0)
    picture = clean_map(_read(source, "map"), (shown.width, shown.height), source.map)
    return Stimulus(
        stimulus=source.stimulus,
        scenario=source.scenario,
        phase=source.phase,
        place=source.place,
        label=source.label,
        movie=_store(folder, shown.content, ".mp4"),
        map=_store(folder, picture, ".png"),
        full=_store(folder, full, ".mp4") if practice else "",
        frames=source.frames,
        full_frames=full_frames,
        rate=float(shown.rate),
        width=shown.width,
        height=shown.height,
        look=source.look,
    )


@dataclass(frozen=True)
class _Movie:
    """The bytes of a movie as it is served, and what it is like."""

    content: bytes
    width: int
    height: int
    rate: int


def _observed(source: Source) -> _Movie:
    """The movie of the observed frames alone."""
    path = source.movie if source.observed is None else source.observed
    content = _read(source, "movie" if source.observed is None else "observed")
    found = _open(path)
    if source.observed is None:
        content = _encode(path, found, source.frames)
    else:
        _count(path, source.frames)
        if not _playable(found):
            content = _encode(path, found, source.frames)
    return _Movie(content, found.width, found.height, found.rate)


def _whole(source: Source, shown: _Movie) -> tuple[bytes, int]:
    """The bytes of the whole movie, which is shown after the answer, and its frames."""
    content = _read(source, "movie")
    found = _open(source.movie)
    if (found.width, found.height, found.rate) != (shown.width, shown.height, shown.rate):
        raise BadInputError(
            f"movie {source.movie} is {found.width} x {found.height} at {found.rate} frames/s, its "
            f"observed part {shown.width} x {shown.height} at {shown.rate}"
        )
    frames = sum(1 for _ in found.frames())
    if frames <= source.frames:
        raise BadInputError(
            f"movie {source.movie} has {frames} frames, none after the {source.frames} observed"
        )
    return content if _playable(found) else _encode(source.movie, found, frames), frames


def _read(source: Source, name: str) -> bytes:
    path = source.files[name]
    content = read_plain(path, MAX_MOVIE_BYTES)
    wanted = source.digests.get(name)
    if wanted is not None and hashlib.sha256(content).hexdigest() != wanted:
        raise BadInputError(f"{path} is not the file that its dataset's index tells of; verify it")
    return content


def _open(path: Path) -> SourceMovie:
    movie = SourceMovie(path)
    if movie.rate > MAX_RATE:
        raise BadInputError(
            f"movie {path} has {movie.rate} frames a second, more than the {MAX_RATE} that screens "
            "show; generate trials with --playback slow"
        )
    return movie


def _playable(movie: SourceMovie) -> bool:
    """Every browser plays it, in the right colours, and there is nothing in it but pictures."""
    return movie.copied and movie.pixels == "yuv420p" and movie.streams == 1


def _encode(path: Path, movie: SourceMovie, frames: int) -> bytes:
    """A new movie of the first ``frames`` frames."""
    try:
        encoder = MovieEncoder(movie.width, movie.height, frames, rate=movie.rate)
        for frame in itertools.islice(movie.frames(), frames):
            encoder.add(frame)
        return encoder.finish()
    except BadInputError as error:
        raise BadInputError(f"{path}: {error}") from error


def _count(path: Path, frames: int) -> None:
    """Decode all of a movie: it must have exactly so many frames, and promise no more."""
    found = len(read_frames(path, size=(16, 16)))
    if found != frames:
        raise BadInputError(
            f"movie {path} has {found} frames, not the {frames} that people may observe"
        )


def clean_map(content: bytes, size: tuple[int, int], path: Path) -> bytes:
    """A map as a new PNG of its pixels alone, in ``size`` (width, height) as the movie has it.

    `BadInputError` unless some of it is red, some yellow, and most of it lets the movie through.
    """
    try:
        with Image.open(io.BytesIO(content), formats=["PNG"]) as picture:
            if picture.size != size or max(size) > MAX_SIDE:
                raise BadInputError(
                    f"map {path} is {picture.width} x {picture.height} pixels large, its movie "
                    f"{size[0]} x {size[1]}"
                )
            pixels = np.asarray(picture.convert("RGBA"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise BadInputError(f"map {path} is no readable PNG picture: {error}") from error
    covered = pixels[..., 3] > 0
    red, green, blue = (pixels[..., channel] > 127 for channel in range(3))
    for role, found in (
        ("red for the agent", red & ~green & ~blue),
        ("yellow for the patient", red & green & ~blue),
    ):
        if not (found & covered).any():
            raise BadInputError(f"map {path} has no {role}")
    if covered.all():
        raise BadInputError(f"map {path} is nowhere transparent: it would hide the movie")
    return encode_png(pixels)


def _store(folder: Path, content: bytes, ending: str) -> str:
    """Write a file under the name of its content, unless it is there; its path in the study."""
    name = f"{MEDIA_FOLDER}/{hashlib.sha256(content).hexdigest()}{ending}"
    path = folder / name
    if path.is_symlink() or not path.is_file() or path.read_bytes() != content:
        write_atomic(path, content)
    return name
