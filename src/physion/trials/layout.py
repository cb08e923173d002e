"""Which files a trial has, and where they lie in the folder of its dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

INDEX = "index.parquet"
"""One row a trial; written last."""
SETTINGS = "dataset.json"
"""How the trials of a folder were made; written first."""
CHOICES = "choices"
"""Folder with the draws that were chosen for the trials of each split and scenario."""
FAILURES = "failures"
"""Folder with one text file for each trial that could not be made."""

SAFE_NAME = r"[A-Za-z0-9][A-Za-z0-9._+-]{0,199}"
"""Names become file names, so nothing in them may mean something to a file system."""


@dataclass(frozen=True, slots=True)
class TrialPaths:
    """The files of a trial, in ``folder/split/scenario``.

    The trial file is written last, so that where it is, the others are.
    """

    folder: Path
    split: str
    scenario: str
    trial: str

    @property
    def trial_file(self) -> Path:
        """Scene, motion, labels (HDF5)."""
        return self._named(".h5")

    @property
    def movie(self) -> Path:
        """All frames (MP4)."""
        return self._named("_img.mp4")

    @property
    def observed_movie(self) -> Path:
        """The observed frames alone (MP4)."""
        return self._named("_observed.mp4")

    @property
    def map(self) -> Path:
        """Agent red, patient yellow, the rest transparent (PNG)."""
        return self._named("_map.png")

    @property
    def free_movie(self) -> Path:
        """All frames in free colours (MP4), where the trial's own look is another."""
        return self._named("_free_img.mp4")

    @property
    def free_observed_movie(self) -> Path:
        """The observed frames alone in free colours (MP4)."""
        return self._named("_free_observed.mp4")

    def all(self, movies: bool = True, free: bool = False) -> dict[str, Path]:
        """The files by the name of their columns in the index, the trial file last.

        Without ``movies`` the trial file alone; with ``free`` also the movies in free colours.
        """
        files = {}
        if movies:
            files = {
                "movie": self.movie,
                "observed_movie": self.observed_movie,
                "map": self.map,
            }
        if movies and free:
            files["free_movie"] = self.free_movie
            files["free_observed_movie"] = self.free_observed_movie
        return {**files, "trial_file": self.trial_file}

    def complete(self, movies: bool = True, free: bool = False) -> bool:
        """All of them are there."""
        return all(path.is_file() for path in self.all(movies, free).values())

    def _named(self, ending: str) -> Path:
        return self.folder / self.split / self.scenario / (self.trial + ending)


def find_trials(folder: Path) -> list[TrialPaths]:
    """Every trial file under ``folder``, in the order of their names."""
    files = sorted(path.relative_to(folder).parts for path in folder.glob("*/*/*.h5"))
    return [
        TrialPaths(folder, split, scenario, name.removesuffix(".h5"))
        for split, scenario, name in files
    ]
