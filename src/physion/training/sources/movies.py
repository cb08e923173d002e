"""Pictures of clips from the movies of a dataset. This module needs av."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError, UnknownNameError
from physion.trials.dataset import Dataset, indexed_file
from physion.trials.decoder import MovieProperties
from physion.trials.indexed_file import IndexedFile
from physion.trials.video import read_chosen


@dataclass(frozen=True, slots=True)
class MovieFile:
    """Movie of a trial, with its properties according to the index."""

    file: IndexedFile
    properties: MovieProperties


class MovieReader:
    """Reader of ``rgb`` from movies, at ``size`` pixels per side."""

    def __init__(self, files: Mapping[str, MovieFile | None], size: int) -> None:
        self._files, self._size = files, size

    def read(self, trial: str, frames: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Return ``rgb`` (T, H, W, 3) of ``frames``."""
        movie = self._movie(trial)
        movie.file.check()
        path, size = movie.file.path, (self._size, self._size)
        return {"rgb": read_chosen(path, frames.tolist(), size=size, expected=movie.properties)}

    def identity(self, trial: str) -> str:
        """Return the SHA-256 of the trial's movie."""
        return f"movie {self._movie(trial).file.sha256}"

    def _movie(self, trial: str) -> MovieFile:
        if trial not in self._files:
            raise UnknownNameError("trial", trial, self._files)
        movie = self._files[trial]
        if movie is None:
            raise BadInputError(
                f"trial {trial!r} has no movie in the colours that were asked for; render it from "
                "its motion (rendered=True)"
            )
        return movie


def movie_files(
    dataset: Dataset, *, observed: bool, look: str | None = None
) -> dict[str, MovieFile | None]:
    """Return the movies of a dataset by trial; None where there is none in the look.

    Parameters
    ----------
    dataset
        The dataset.
    observed
        Whether the movies of the observed part are meant, and not those of the whole trials.
    look
        Colours: ``redyellow`` or ``free``, by default each trial's own.
    """
    kind = "observed_movie" if observed else "movie"
    files: dict[str, MovieFile | None] = {}
    for row in dataset.index.to_dict("records"):
        own = look is None or look == row["look"]
        column = kind if own else f"{look}_{kind}"
        file = indexed_file(dataset.folder, row, column, verify=dataset.verify)
        known = None if file is None else MovieFile(file, _properties(row, observed))
        files[row["trial"]] = known
    return files


def _properties(row: Mapping[Any, Any], observed: bool) -> MovieProperties:
    return MovieProperties(
        frames=int(row["observed_frames" if observed else "frames"]),
        width=int(row["width"]),
        height=int(row["height"]),
        rate=float(row["frames"] / row["playback_seconds"]),
    )
