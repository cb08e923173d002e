"""A folder of trials, opened for reading."""

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
    """What may be seen by who predicts: the observed movies of a dataset and nothing else.

    The future is not hidden here but absent: only files that end with the observed part are
    opened.
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
        """Observed frames 0, ``stride``, ... (T, H, W, 3) in sRGB; see `video.read_frames`."""
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
    """A folder of trials with its index.

    Opening it reads the index alone (`BadInputError` where there is none); trials and movies are
    read when asked for. Methods that take a trial's name raise `UnknownNameError` for a wrong
    one.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self.index: pd.DataFrame = read_index(self.folder)
        """One row a trial; columns as in `physion.trials.index.COLUMNS`."""

    def __len__(self) -> int:
        return len(self.index)

    def trials(self, split: str | None = None, scenario: str | None = None) -> list[str]:
        """Names of the trials of a split and a scenario, or of all, in the order of the index."""
        table = self.index
        if split is not None:
            table = table[table["split"] == split]
        if scenario is not None:
            table = table[table["scenario"] == scenario]
        return [str(name) for name in table["trial"]]

    @cached_property
    def observed(self) -> ObservedDataset:
        """The same trials as seen by who must predict."""
        return ObservedDataset(self.folder, self.index)

    def paths(self, trial: str) -> TrialPaths:
        """Where the files of a trial are."""
        if trial not in self._rows:
            raise UnknownNameError("trial", trial, self._rows)
        row = self.index.iloc[self._rows[trial]]
        return TrialPaths(self.folder, row["split"], row["scenario"], trial)

    def trial(self, trial: str) -> Trial:
        """The trial file, opened and checked."""
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
        """Frames of the full movie (T, H, W, 3) in sRGB; see `video.read_frames`."""
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
        """Frames of the observed movie alone (T, H, W, 3) in sRGB."""
        return self.observed.frames(trial, count=count, stride=stride, size=size)

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {str(name): row for row, name in enumerate(self.index["trial"])}
