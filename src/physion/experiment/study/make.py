"""Preparation of the movies and maps of a study: cut, check, and store under content hashes.

A movie that is shown before the answer contains the observed frames only. A file that already
contains exactly these frames is copied unchanged; otherwise the observed frames are encoded into a
new file, and the encoder never receives a later frame. File names are the SHA-256 of the content,
so they reveal neither the stimulus nor its outcome.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from physion.compute.tasks import Progress, tracked
from physion.core.errors import BadInputError
from physion.core.files import folder_lock, read_plain, remove_leftovers, write_atomic
from physion.experiment.study.identity import SECRET_FILE, Secrets, set_password
from physion.experiment.study.settings import format_settings
from physion.experiment.study.stimuli import (
    MAX_SIDE,
    MEDIA_FOLDER,
    STIMULI_FILE,
    Stimulus,
    check_distinct_names,
    write_stimuli,
)
from physion.experiment.study.study import STUDY_FILE, Study, load_study, write_settings
from physion.experiment.study.texts import TEXTS_FOLDER, shipped_file
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
    if wanted is not None and hashlib.sha256(content).hexdigest() != wanted:
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
    name = f"{MEDIA_FOLDER}/{hashlib.sha256(content).hexdigest()}{ending}"
    path = folder / name
    if path.is_symlink() or not path.is_file() or path.read_bytes() != content:
        write_atomic(path, content)
    return name


# Creation of a study folder from selected stimuli; an interrupted run can be resumed.
#
# During creation the folder contains a journal with one line for each stimulus whose media have
# been written. Running the same command again skips these stimuli. The journal is deleted last.

JOURNAL = "init.journal"
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
        The settings, with the folder to create. The folder must be missing, empty, or left by an
        interrupted run.
    sources
        The stimuli and their source files.
    password
        Password of the experimenter's pages.
    progress
        Displays progress.

    Raises
    ------
    BadInputError
        Files are missing (the message names several) or something else is invalid. Media written
        so far are kept for the next run.
    """
    check_sources(sources)
    check_distinct_names(((s.scenario, s.stimulus) for s in sources), study.folder / STIMULI_FILE)
    format_settings(study, study.folder / STUDY_FILE)
    texts = {language: shipped_file(language) for language in study.languages}
    folder = study.folder
    _check_folder(folder)
    (folder / MEDIA_FOLDER).mkdir(parents=True, exist_ok=True)
    with folder_lock(folder):
        journal = _Journal(folder)
        stimuli = journal.take(sources)
        rows = list(tracked(stimuli, "movies", len(sources), progress))
        write_stimuli(folder / STIMULI_FILE, rows)
        (folder / TEXTS_FOLDER).mkdir(exist_ok=True)
        for language, content in texts.items():
            write_atomic(folder / TEXTS_FOLDER / f"{language}.toml", content)
        write_settings(study)
        _set_secrets(folder, password)
        made = load_study(folder)
        _remove_others(folder, made)
        journal.remove()
    return made


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
    """Check that the folder is missing, empty, or left by an interrupted run."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise BadInputError(f"{folder} already exists and is a link or not a folder")
    if not folder.exists():
        return
    names = {path.name for path in folder.iterdir()} - {".lock"}
    if JOURNAL in names:
        # Other files may be keys or answers from serving the folder; they must not be lost.
        strange = names - {JOURNAL, MEDIA_FOLDER, TEXTS_FOLDER, STIMULI_FILE, STUDY_FILE,
                           SECRET_FILE}  # fmt: skip
        strange = {name for name in strange if not name.endswith(".part")}
        if strange:
            raise BadInputError(
                f"{folder} was left unfinished but contains {min(strange)}; choose another folder"
            )
    elif STUDY_FILE in names:
        raise BadInputError(
            f"there is a study in {folder} already: physion experiment serve {folder}; "
            "choose another folder for a new one"
        )
    elif names - {MEDIA_FOLDER} or any((folder / MEDIA_FOLDER).glob("*")):
        raise BadInputError(
            f"{folder} is not empty (it contains {min(names)}); choose a new folder"
        )


def _set_secrets(folder: Path, password: str) -> None:
    if (folder / SECRET_FILE).exists():
        set_password(folder, password)
    else:
        Secrets.create(folder, password)


def _remove_others(folder: Path, study: Study) -> None:
    """Delete media of an earlier run with other stimuli, which the study does not use."""
    remove_leftovers(folder)
    used = {name for s in study.stimuli for name in (s.movie, s.map, s.full)}
    for path in (folder / MEDIA_FOLDER).iterdir():
        if f"{MEDIA_FOLDER}/{path.name}" not in used:
            path.unlink()


class _Journal:
    """Record of the stimuli already written: one JSON line each, with a key of its source files."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._path = folder, folder / JOURNAL
        self._known: dict[str, Stimulus] = {}
        if self._path.is_file() and not self._path.is_symlink():
            for line in self._path.read_text(encoding="utf-8", errors="replace").splitlines():
                self._read(line)

    def take(self, sources: Sequence[StimulusSource]) -> Iterator[Stimulus]:
        """Yield the stimulus of each source, writing its media unless they exist."""
        with self._path.open("a", encoding="utf-8") as file:
            # The last line may be incomplete after a crash; start a new one.
            file.write("\n")
            for source in sources:
                key = _key(source)
                stimulus = self._known.get(key)
                if stimulus is None or not self._holds(stimulus):
                    stimulus = import_stimulus(source, self._folder)
                    row = dataclasses.asdict(stimulus)
                    file.write(json.dumps({"key": key, "row": row}) + "\n")
                    file.flush()
                yield stimulus

    def remove(self) -> None:
        """Delete the journal."""
        self._path.unlink()

    def _read(self, line: str) -> None:
        """Parse one line; ignore it if it is damaged."""
        try:
            entry = json.loads(line)
            self._known[entry["key"]] = Stimulus(**entry["row"])
        except (ValueError, TypeError, KeyError):
            return

    def _holds(self, stimulus: Stimulus) -> bool:
        """Return whether all media files of a stimulus exist."""
        files = [self._folder / n for n in (stimulus.movie, stimulus.map, stimulus.full) if n]
        return all(path.is_file() and not path.is_symlink() for path in files)


def _key(source: StimulusSource) -> str:
    """Return a key of all that a stimulus is made from, with size and time of its files."""
    values: dict[str, Any] = dataclasses.asdict(source)
    stats = [path.stat() for path in source.files.values()]
    values["stats"] = [(status.st_size, status.st_mtime_ns) for status in stats]
    return json.dumps(values, default=str, sort_keys=True)
