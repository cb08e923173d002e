"""Preparation of the movies and maps of a study: cut, check, and store under content hashes.

A movie that is shown before the answer contains the observed frames only. A file that already
contains exactly these frames is copied unchanged; otherwise the observed frames are encoded into a
new file, and the encoder never receives a later frame. File names are the SHA-256 of the content,
so they reveal neither the stimulus nor its outcome.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from PIL import Image

from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError
from physion.core.files import digest_of, new_folder, read_plain, write_atomic
from physion.experiment.study.identity import Secrets
from physion.experiment.study.settings import SHIPPED, format_settings
from physion.experiment.study.stimuli import (
    MAX_SIDE,
    MEDIA_FOLDER,
    STIMULI_FILE,
    Stimulus,
    check_distinct_names,
    write_stimuli,
)
from physion.experiment.study.study import STUDY_FILE, Study, load_study, write_settings
from physion.experiment.study.texts import TEXTS_FOLDER, shipped_file, shipped_question
from physion.scenes.scene import OBSERVED_FRAMES
from physion.trials.files import encode_png
from physion.trials.official.movies import SourceMovie
from physion.trials.video import MovieEncoder, read_frames

MAX_MOVIE_BYTES = 500_000_000
MAX_RATE = 60
"""Frames per second of common screens; a faster movie could not be shown with all its frames."""


@dataclass(frozen=True)
class StimulusSource:
    """Description of a stimulus to be added to a study, with the paths of its source files.

    Attributes
    ----------
    movie
        Movie with all frames.
    map
        PNG that marks agent and patient.
    observed
        Movie with the observed frames only; None if there is none.
    frames
        Number of observed frames.
    digests
        Expected SHA-256 of ``movie``, ``observed`` and ``map``, where known.

    The other attributes are as in `Stimulus`.
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
        """Files that will be read, by attribute name; the full movie only if it is needed."""
        files = {"map": self.map}
        if self.observed is not None:
            files["observed"] = self.observed
        if self.observed is None or self.phase == "familiarization":
            files["movie"] = self.movie
        return files


def import_stimulus(source: StimulusSource, folder: Path) -> Stimulus:
    """Write the media of a stimulus into the study ``folder``; return its row of stimuli.csv.

    Raises
    ------
    BadInputError
        A movie has the wrong number of frames, is damaged, is a link or exceeds `MAX_RATE`, or
        the map does not match the movie. The message names the file.
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
    """Bytes of a movie as it is served, its size in pixels and its rate in frames per second."""

    content: bytes
    width: int
    height: int
    rate: int


def _observed(source: StimulusSource) -> _Movie:
    """Return a movie of the observed frames only."""
    path = source.movie if source.observed is None else source.observed
    content = _read(source, "movie" if source.observed is None else "observed")
    movie = _open(path)
    if source.observed is None:
        content = _encode(path, movie, source.frames)
    else:
        _count(path, source.frames)
        if not _playable(movie):
            content = _encode(path, movie, source.frames)
    return _Movie(content, movie.width, movie.height, movie.rate)


def _whole(source: StimulusSource, shown: _Movie) -> tuple[bytes, int]:
    """Return the full movie, which is shown after the answer, and its number of frames."""
    content = _read(source, "movie")
    movie = _open(source.movie)
    if (movie.width, movie.height, movie.rate) != (shown.width, shown.height, shown.rate):
        raise BadInputError(
            f"movie {source.movie} is {movie.width} x {movie.height} at {movie.rate} frames/s, its "
            f"observed part {shown.width} x {shown.height} at {shown.rate}"
        )
    frames = sum(1 for _ in movie.frames())
    if frames <= source.frames:
        raise BadInputError(
            f"movie {source.movie} has {frames} frames, none after the {source.frames} observed"
        )
    return content if _playable(movie) else _encode(source.movie, movie, frames), frames


def _read(source: StimulusSource, name: str) -> bytes:
    """Read one of the source's files and compare it with its expected SHA-256."""
    path = source.files[name]
    content = read_plain(path, MAX_MOVIE_BYTES)
    wanted = source.digests.get(name)
    if wanted is not None and digest_of(content) != wanted:
        raise BadInputError(
            f"{path} does not have the SHA-256 in its dataset's index; run physion verify"
        )
    return content


def _open(path: Path) -> SourceMovie:
    """Open a movie and check its rate."""
    movie = SourceMovie(path)
    if movie.rate > MAX_RATE:
        raise BadInputError(
            f"movie {path} has {movie.rate} frames per second, more than the {MAX_RATE} that "
            "screens show; generate trials with --playback slow"
        )
    return movie


def _playable(movie: SourceMovie) -> bool:
    """Return whether every browser plays the file as it is: H.264, yuv420p, no other stream."""
    return movie.copied and movie.pixels == "yuv420p" and movie.streams == 1


def _encode(path: Path, movie: SourceMovie, frames: int) -> bytes:
    """Encode the first ``frames`` frames as a new movie."""
    try:
        encoder = MovieEncoder(movie.width, movie.height, frames, rate=movie.rate)
        for frame in itertools.islice(movie.frames(), frames):
            encoder.add(frame)
        return encoder.finish()
    except BadInputError as error:
        raise BadInputError(f"{path}: {error}") from error


def _count(path: Path, frames: int) -> None:
    """Decode a movie completely and check that it has exactly ``frames`` frames."""
    counted = len(read_frames(path, size=(16, 16)))
    if counted != frames:
        raise BadInputError(
            f"movie {path} has {counted} frames, not the {frames} that participants may observe"
        )


def clean_map(content: bytes, size: tuple[int, int], path: Path) -> bytes:
    """Re-encode a map as a PNG of its pixels only, without metadata.

    Parameters
    ----------
    content
        Bytes of the PNG file.
    size
        Width and height of the movie in pixels, which the map must have too.
    path
        Where ``content`` was read from; used in error messages only.

    Raises
    ------
    BadInputError
        The file is not a PNG of this size, or lacks red, yellow or transparent pixels.
    """
    try:
        with Image.open(io.BytesIO(content), formats=["PNG"]) as picture:
            if picture.size != size or max(size) > MAX_SIDE:
                raise BadInputError(
                    f"map {path} is {picture.width} x {picture.height} pixels, its movie "
                    f"{size[0]} x {size[1]}"
                )
            pixels = np.asarray(picture.convert("RGBA"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise BadInputError(f"map {path} is not a readable PNG image: {error}") from error
    covered = pixels[..., 3] > 0
    red, green, blue = (pixels[..., channel] > 127 for channel in range(3))
    for role, mask in (
        ("red for the agent", red & ~green & ~blue),
        ("yellow for the patient", red & green & ~blue),
    ):
        if not (mask & covered).any():
            raise BadInputError(f"map {path} has no {role}")
    if covered.all():
        raise BadInputError(f"map {path} has no transparent pixel: it would hide the movie")
    return encode_png(pixels)


def _store(folder: Path, content: bytes, ending: str) -> str:
    """Write a file named by its SHA-256 unless it exists; return its path within the study."""
    name = f"{MEDIA_FOLDER}/{digest_of(content)}{ending}"
    path = folder / name
    if path.is_symlink() or not path.is_file() or path.read_bytes() != content:
        write_atomic(path, content)
    return name


# Creation of a study folder from selected stimuli: under another name until it is complete.

SHOWN = 3
"""Maximum number of missing files named in an error message."""


def make_study(
    study: Study,
    sources: Sequence[StimulusSource],
    password: str,
    *,
    progress: Progress | None = None,
) -> Study:
    """Create the folder of a study, with its stimuli and the texts of this package, and load it.

    Parameters
    ----------
    study
        The settings, with the folder to create, which must be missing or empty.
    sources
        The stimuli and their source files.
    password
        Password of the experimenter's pages.
    progress
        Displays progress.

    Raises
    ------
    BadInputError
        Files are missing (the message names several) or something else is invalid. Nothing is left
        behind.
    """
    check_sources(sources)
    check_distinct_names(((s.scenario, s.stimulus) for s in sources), study.folder / STIMULI_FILE)
    format_settings(study, study.folder / STUDY_FILE)
    texts = {language: _texts(study, language) for language in study.languages}
    _check_folder(study.folder)
    with new_folder(study.folder) as part:
        for name in (MEDIA_FOLDER, TEXTS_FOLDER):
            (part / name).mkdir()
        rows = (import_stimulus(source, part) for source in sources)
        write_stimuli(part / STIMULI_FILE, list(tracked(rows, "movies", len(sources), progress)))
        for language, content in texts.items():
            write_atomic(part / TEXTS_FOLDER / f"{language}.toml", content)
        for question in study.questions:
            if question.name in SHIPPED:
                picture = shipped_question(question.name, question.picture)
                write_atomic(part / TEXTS_FOLDER / question.picture, picture)
        write_settings(replace(study, folder=part))
        Secrets.create(part, password)
        made = load_study(part)
    return replace(made, folder=study.folder)


def _texts(study: Study, language: str) -> bytes:
    """Return the text file of a language, with the texts of questions that ship."""
    named = [question.name for question in study.questions if question.name in SHIPPED]
    own = [shipped_question(name, f"{language}.toml") for name in named]
    return b"\n".join([shipped_file(language), *own])


def check_sources(sources: Sequence[StimulusSource]) -> None:
    """Check that all source files are regular files; the error names the first missing ones."""
    files = [path for source in sources for path in source.files.values()]
    missing = [path for path in dict.fromkeys(files) if path.is_symlink() or not path.is_file()]
    if missing:
        names = ", ".join(str(path) for path in missing[:SHOWN])
        more = f", and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
        raise BadInputError(
            f"{len(missing)} of {len(set(files))} files are missing, or are links: {names}{more}"
        )


def _check_folder(folder: Path) -> None:
    """Check that the folder is missing or empty."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise BadInputError(f"{folder} already exists and is a link or not a folder")
    names = {path.name for path in folder.iterdir()} if folder.exists() else set()
    if STUDY_FILE in names:
        raise BadInputError(
            f"there is a study in {folder} already: physion experiment serve {folder}; "
            "choose another folder for a new one"
        )
    if names:
        raise BadInputError(
            f"{folder} is not empty (it contains {min(names)}); choose a new folder"
        )
