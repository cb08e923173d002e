"""Files of a trial: their names and paths, their metadata, and how they are read and written.

A trial has one trial file, and movies and a map unless they were left out. The index of a dataset
(`physion.trials.index`) lists them with their SHA-256.
"""

from __future__ import annotations

import io
import stat
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from physion.core.errors import BadInputError
from physion.core.files import digest_of, file_sha256, read_plain, write_atomic

INDEX = "index.parquet"
"""File with one row per trial, written last."""
SETTINGS = "dataset.json"
"""File with the settings that the trials of a folder are made with, written first."""
FAILURES = "failures"
"""Folder with one text file per trial that could not be made."""
MOVIE_ALONE = "imported: movie alone"
"""Engine of a trial of which only the movie is known."""

SAFE_NAME = r"[A-Za-z0-9][A-Za-z0-9._+-]{0,199}"
"""Regular expression of names, which become file names: no separators, no special names."""


MAX_FILE_BYTES = 1 << 33
"""Largest file of a trial that is read: all passes of 600 frames of 512 pixels take 2 GB."""


FILES: Mapping[str, str] = {
    "trial_file": "scene, motion, contacts, label, first-frame ids (HDF5); contains the future",
    "movie": "all frames (MP4); contains the future",
    "observed_movie": "only the observed frames (MP4)",
    "map": "agent in red and patient in yellow in the first frame (PNG)",
    "free_movie": "all frames in free colours (MP4); contains the future",
    "free_observed_movie": "only the observed frames, in free colours (MP4)",
}
"""Files that a trial can have, by the names of their columns, with their content."""


@dataclass(frozen=True, slots=True)
class TrialPaths:
    """Paths of the files of a trial, in ``folder/split/scenario``.

    The trial file is written last: if it exists, the others exist too.
    """

    folder: Path
    split: str
    scenario: str
    trial: str

    @property
    def trial_file(self) -> Path:
        """File with scene, motion and labels (HDF5)."""
        return self._named(".h5")

    @property
    def movie(self) -> Path:
        """Movie of all frames (MP4)."""
        return self._named("_img.mp4")

    @property
    def observed_movie(self) -> Path:
        """Movie of only the observed frames (MP4)."""
        return self._named("_observed.mp4")

    @property
    def map(self) -> Path:
        """Map of the first frame: agent red, patient yellow, the rest transparent (PNG)."""
        return self._named("_map.png")

    @property
    def free_movie(self) -> Path:
        """Movie of all frames in free colours (MP4), if the trial's own look is another."""
        return self._named("_free_img.mp4")

    @property
    def free_observed_movie(self) -> Path:
        """Movie of only the observed frames, in free colours (MP4)."""
        return self._named("_free_observed.mp4")

    def all(self, movies: bool = True, free: bool = False, maps: bool = True) -> dict[str, Path]:
        """Return the paths by column of the index, the trial file last.

        ``movies``: include movies and map. ``free``: include also the movies in free colours.
        Without ``maps`` there is no map, as of trials that are stored without labels.
        """
        files = {}
        if movies:
            files = {
                "movie": self.movie,
                "observed_movie": self.observed_movie,
            }
        if movies and maps:
            files["map"] = self.map
        if movies and free:
            files["free_movie"] = self.free_movie
            files["free_observed_movie"] = self.free_observed_movie
        return {**files, "trial_file": self.trial_file}

    def complete(self, movies: bool = True, free: bool = False, maps: bool = True) -> bool:
        """Return whether all these files exist."""
        return all(path.is_file() for path in self.all(movies, free, maps).values())

    def _named(self, ending: str) -> Path:
        return self.folder / self.split / self.scenario / (self.trial + ending)


def find_trials(folder: Path) -> list[TrialPaths]:
    """Return the paths of every trial that has a trial file under ``folder``, sorted by name."""
    files = sorted(path.relative_to(folder).parts for path in folder.glob("*/*/*.h5"))
    return [
        TrialPaths(folder, split, scenario, name.removesuffix(".h5"))
        for split, scenario, name in files
    ]


@dataclass(frozen=True, slots=True)
class IndexedFile:
    """File of a trial with its SHA-256 according to the index.

    Without ``verify`` its content is not compared with the SHA-256.
    """

    trial: str
    path: Path
    sha256: str
    verify: bool = True

    def check(self) -> None:
        """Raise `BadInputError` unless the file has its SHA-256.

        A file of one size and time of change is read once in a process.
        """
        try:
            status = self.path.stat()
            if not stat.S_ISREG(status.st_mode):
                raise BadInputError(f"trial {self.trial!r}: {self.path} is not a regular file")
            if self.verify:
                _check_once(self, status.st_size, status.st_mtime_ns)
        except OSError as error:
            raise BadInputError(
                f"trial {self.trial!r}: {self.path} is missing or cannot be read: {error.strerror}"
            ) from error

    def read(self) -> bytes:
        """Return the content; raise `BadInputError` as `check` does."""
        try:
            content = read_plain(self.path, MAX_FILE_BYTES, follow_links=True)
        except BadInputError as error:
            raise BadInputError(f"trial {self.trial!r}: {error}") from error
        if self.verify and digest_of(content) != self.sha256:
            raise self._changed()
        return content

    def _changed(self) -> BadInputError:
        return BadInputError(
            f"trial {self.trial!r}: {self.path} was changed since it was made: it does not have "
            "the SHA-256 of the index; make the trial again, or check the dataset with physion "
            "verify"
        )


@cache
def _check_once(file: IndexedFile, size: int, modified: int) -> None:
    """Check a file of this size and time of change; errors are not remembered."""
    if file_sha256(file.path) != file.sha256:
        raise file._changed()


# Encoding of pictures as PNG, and writing of the files of a trial.


def encode_png(picture: NDArray[np.uint8], compress_level: int = 6) -> bytes:
    """Return the bytes of a PNG file of ``picture`` (H, W, 3 or 4), sRGB and alpha, 0..255.

    ``compress_level`` is zlib's, from 0 (fast) to 9 (small).
    """
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="png", compress_level=compress_level)
    return buffer.getvalue()


def same_picture(one: bytes, other: bytes) -> bool:
    """Return whether two PNG files hold the same pixels, however they are compressed."""
    try:
        left, right = (np.asarray(Image.open(io.BytesIO(data))) for data in (one, other))
    except (OSError, SyntaxError, ValueError, zlib.error):
        return False
    return np.array_equal(left, right)


def write_files(paths: TrialPaths, files: Mapping[str, bytes]) -> None:
    """Write the files of a trial, by names as in `TrialPaths.all`, the trial file last."""
    paths.trial_file.parent.mkdir(parents=True, exist_ok=True)
    for name, path in paths.all(free=True).items():
        if name in files:
            write_atomic(path, files[name])


# Metadata of a trial: names, settings and versions.

MAX_SIDE = 4096
"""Largest width or height in pixels of pictures and movies."""
MAX_FRAMES = 10_000
"""Largest number of frames of a trial."""
MAX_RATE = 1000
"""Most frames per second of a movie."""


@dataclass(frozen=True)
class Metadata:
    """Origin and settings of a trial; nothing in it depends on the time of its making.

    - ``trial``, ``dataset``, ``scenario``, ``split``: names; a trial's name is unique in the
      dataset.
    - ``index``: position in the split of the scenario, from 0.
    - ``preset``: name of the scenario's parameter set; None for an imported scene.
    - ``seed``: entropy of the trial's `SeedSequence` in hexadecimal; None for an imported scene.
    - ``look``: colours of the trial's movies, one of `physion.scenes.looks.LOOKS`.
    - ``width``, ``height``: size of the pictures in pixels.
    - ``frames``, ``observed_frames``: number of frames of the whole trial, and of the part shown
      before the prediction.
    - ``frame_time``: seconds of physics per frame.
    - ``playback_rate``: frames per second of the movies.
    - ``completed``: True if everything came to rest before the time limit.
    - ``engine``, ``renderer``, ``package``: names with versions.
    - ``digest``: SHA-256 of the trajectory; of the movie where only that is known (`MOVIE_ALONE`).
    - ``scene_digest``: SHA-256 of everything that determines the motion (`Scene.physics_digest`);
      of the movie where only that is known.
    - ``attempt``: number of scenes sampled for this trial and rejected before; None for an imported
      scene.
    - ``movies``, ``free_movies``: whether there are movies and a map, and further movies in free
      colours.
    - ``recorded_contact``: outcome that an imported scene was recorded with, else None.
    """

    trial: str
    dataset: str
    scenario: str
    split: str
    index: int
    preset: str | None
    seed: str | None
    look: str
    width: int
    height: int
    frames: int
    observed_frames: int
    frame_time: float
    playback_rate: int
    completed: bool
    engine: str
    renderer: str
    package: str
    digest: str
    scene_digest: str
    attempt: int | None = None
    movies: bool = True
    free_movies: bool = False
    recorded_contact: bool | None = None

    @property
    def physics_seconds(self) -> float:
        """Duration in the simulated world, in seconds."""
        return (self.frames - 1) * self.frame_time

    @property
    def playback_seconds(self) -> float:
        """Duration of the movie, in seconds."""
        return self.frames / self.playback_rate

    @property
    def imported(self) -> bool:
        """Whether the motion comes from another simulator."""
        return self.engine.startswith("imported")

    def check(self, where: str) -> None:
        """Raise `BadInputError` for numbers that no trial has; ``where`` names the file."""
        bounds = {
            "width": MAX_SIDE,
            "height": MAX_SIDE,
            "frames": MAX_FRAMES,
            "observed_frames": self.frames,
            "playback_rate": MAX_RATE,
        }
        for name, most in bounds.items():
            if not 1 <= getattr(self, name) <= most:
                raise BadInputError(
                    f"{where}: metadata: {name} must be 1 to {most}, not {getattr(self, name)}"
                )
        if not (self.index >= 0 and self.frame_time > 0):
            raise BadInputError(
                f"{where}: metadata: index must not be negative and frame_time positive, not "
                f"{self.index} and {self.frame_time}"
            )
