"""Names and paths of the files of a trial and of a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

INDEX = "index.parquet"
"""File with one row per trial, written last."""
SETTINGS = "dataset.json"
"""File with the settings that the trials of a folder are made with, written first."""
CHOICES = "choices"
"""Folder with the sampled scenes chosen for the trials of each split and scenario."""
FAILURES = "failures"
"""Folder with one text file per trial that could not be made."""

SAFE_NAME = r"[A-Za-z0-9][A-Za-z0-9._+-]{0,199}"
"""Regular expression of names, which become file names: no separators, no special names."""


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
        """Movie of the observed frames alone (MP4)."""
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
        """Movie of the observed frames alone in free colours (MP4)."""
        return self._named("_free_observed.mp4")

    def all(self, movies: bool = True, free: bool = False) -> dict[str, Path]:
        """Return the paths by column of the index, the trial file last.

        ``movies``: include movies and map. ``free``: include also the movies in free colours.
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
        """Return whether all these files exist."""
        return all(path.is_file() for path in self.all(movies, free).values())

    def _named(self, ending: str) -> Path:
        return self.folder / self.split / self.scenario / (self.trial + ending)


def find_trials(folder: Path) -> list[TrialPaths]:
    """Return the paths of every trial that has a trial file under ``folder``, sorted by name."""
    files = sorted(path.relative_to(folder).parts for path in folder.glob("*/*/*.h5"))
    return [
        TrialPaths(folder, split, scenario, name.removesuffix(".h5"))
        for split, scenario, name in files
    ]
