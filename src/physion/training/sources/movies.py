"""Pictures of clips from the movies of a dataset. This module needs av."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.errors import BadInputError, UnknownNameError
from physion.trials.dataset import Dataset
from physion.trials.decoder import MovieProperties
from physion.trials.layout import TrialPaths
from physion.trials.video import read_chosen


@dataclass(frozen=True, slots=True)
class MovieFile:
    """Movie of a trial, with its SHA-256 and properties according to the index."""

    trial: str
    path: Path
    sha256: str
    properties: MovieProperties

    def check(self) -> None:
        """Raise `BadInputError` unless the file has its SHA-256; read it once in a process."""
        try:
            known = self.path.stat()
            _check_once(self, known.st_size, known.st_mtime_ns)
        except OSError as error:
            raise BadInputError(
                f"trial {self.trial!r}: movie {self.path} is missing or cannot be read: "
                f"{error.strerror}"
            ) from error


@cache
def _check_once(file: MovieFile, size: int, modified: int) -> None:
    """Check a file of this size and time of modification; errors are not remembered."""
    if hashlib.sha256(file.path.read_bytes()).hexdigest() != file.sha256:
        raise BadInputError(
            f"trial {file.trial!r}: movie {file.path} was changed since it was made: it does not "
            "have the SHA-256 of the index; make the trial again"
        )


class MovieReader:
    """Reader of ``rgb`` from movies, at ``size`` pixels per side.

    With ``verify``, the SHA-256 of each file is checked once in a process, before its first use.
    """

    def __init__(self, files: Mapping[str, MovieFile | None], size: int, *, verify: bool) -> None:
        self._files, self._size, self._verify = files, size, verify

    def read(self, trial: str, frames: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Return ``rgb`` (T, H, W, 3) of ``frames``."""
        file = self._file(trial)
        if self._verify:
            file.check()
        size = (self._size, self._size)
        return {"rgb": read_chosen(file.path, frames.tolist(), size=size, expected=file.properties)}

    def identity(self, trial: str) -> str:
        """Return the SHA-256 of the trial's movie."""
        return f"movie {self._file(trial).sha256}"

    def _file(self, trial: str) -> MovieFile:
        if trial not in self._files:
            raise UnknownNameError("trial", trial, self._files)
        file = self._files[trial]
        if file is None:
            raise BadInputError(
                f"trial {trial!r} has no movie in the colours that were asked for; render it from "
                "its motion (rendered=True)"
            )
        return file


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
        sha256 = row.get(f"{column}_sha256")
        if pd.isna(sha256):
            files[row["trial"]] = None
            continue
        paths = TrialPaths(dataset.folder, row["split"], row["scenario"], row["trial"])
        path = getattr(paths, column)
        files[row["trial"]] = MovieFile(row["trial"], path, sha256, _properties(row, observed))
    return files


def _properties(row: Mapping[Any, Any], observed: bool) -> MovieProperties:
    return MovieProperties(
        frames=int(row["observed_frames" if observed else "frames"]),
        width=int(row["width"]),
        height=int(row["height"]),
        rate=float(row["frames"] / row["playback_seconds"]),
    )
