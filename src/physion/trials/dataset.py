"""Reading of a dataset: a folder of trials with its index."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.errors import BadInputError, UnknownNameError
from physion.trials.index import read_index
from physion.trials.layout import TrialPaths
from physion.trials.trial_file import Trial
from physion.trials.video import read_frames


class ObservedDataset:
    """Access to the observed movies of a dataset and to nothing else.

    For code that must not see the outcome of a trial: only files that end with the observed part
    are opened, so the future cannot be read by mistake.
    """

    def __init__(self, folder: Path, index: pd.DataFrame) -> None:
        self._movies = {
            trial: TrialPaths(folder, split, scenario, trial).observed_movie
            for trial, split, scenario in zip(
                index["trial"], index["split"], index["scenario"], strict=True
            )
        }
        self._lengths = dict(zip(index["trial"], index["observed_frames"], strict=True))

    @property
    def trials(self) -> list[str]:
        """Names of all trials, in the order of the index."""
        return list(self._movies)

    def frames(
        self,
        trial: str,
        *,
        count: int | None = None,
        stride: int = 1,
        size: tuple[int, int] | None = None,
    ) -> NDArray[np.uint8]:
        """Return observed frames 0, ``stride``, ... (T, H, W, 3), sRGB; see `video.read_frames`."""
        if trial not in self._movies:
            raise UnknownNameError("trial", trial, self._movies)
        path = self._movies[trial]
        frames = read_frames(path, count=count, stride=stride, size=size)
        if (len(frames) - 1) * stride >= self._lengths[trial]:
            raise BadInputError(
                f"{path} shows more than the {self._lengths[trial]} observed frames of its trial"
            )
        return frames


class Dataset:
    """Dataset in a folder.

    The index is read at once (`BadInputError` if there is none), trials and movies on request.
    Methods that take the name of a trial raise `UnknownNameError` for an unknown one.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self.index: pd.DataFrame = read_index(self.folder)
        """Index: one row per trial; columns as in `physion.trials.columns.INDEX_COLUMNS`."""

    def __len__(self) -> int:
        return len(self.index)

    def trials(self, split: str | None = None, scenario: str | None = None) -> list[str]:
        """Return the names of the trials of a split and a scenario, by default of all, in order."""
        table = self.index
        if split is not None:
            table = table[table["split"] == split]
        if scenario is not None:
            table = table[table["scenario"] == scenario]
        return [str(name) for name in table["trial"]]

    @cached_property
    def observed(self) -> ObservedDataset:
        """Access to the observed movies alone, for code that must not see the outcome."""
        return ObservedDataset(self.folder, self.index)

    def paths(self, trial: str) -> TrialPaths:
        """Return the paths of the files of a trial."""
        if trial not in self._rows:
            raise UnknownNameError("trial", trial, self._rows)
        row = self.index.iloc[self._rows[trial]]
        return TrialPaths(self.folder, row["split"], row["scenario"], trial)

    def trial(self, trial: str) -> Trial:
        """Open and check a trial file."""
        return Trial.open(self.paths(trial).trial_file)

    def frames(
        self,
        trial: str,
        *,
        start: int = 0,
        count: int | None = None,
        stride: int = 1,
        size: tuple[int, int] | None = None,
    ) -> NDArray[np.uint8]:
        """Return frames of the full movie (T, H, W, 3) in sRGB; see `video.read_frames`."""
        path = self.paths(trial).movie
        return read_frames(path, start=start, count=count, stride=stride, size=size)

    def observed_frames(
        self,
        trial: str,
        *,
        count: int | None = None,
        stride: int = 1,
        size: tuple[int, int] | None = None,
    ) -> NDArray[np.uint8]:
        """Return frames of the observed movie (T, H, W, 3) in sRGB; see `video.read_frames`."""
        return self.observed.frames(trial, count=count, stride=stride, size=size)

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {str(name): row for row, name in enumerate(self.index["trial"])}
