"""Pictures of clips from the movies of a dataset, and reading ahead."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from physion.compute.local import available_cores
from physion.core.errors import BadInputError, UnknownNameError
from physion.trials.dataset import Dataset
from physion.trials.files import IndexedFile
from physion.trials.video import MovieProperties, read_chosen


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

    - ``dataset``: the dataset.
    - ``observed``: whether movies of the observed part are meant, and not of the whole trials.
    - ``look``: colours: ``redyellow`` or ``free``, by default each trial's own.
    """
    kind = "observed_movie" if observed else "movie"
    own = dataset.files(kind)
    # Trials have movies in free colours besides their own, but no others.
    other = dataset.files(f"free_{kind}") if look == "free" else {}
    files: dict[str, MovieFile | None] = {}
    for row in dataset.index.to_dict("records"):
        of_look = own if look is None or look == row["look"] else other
        file = of_look.get(row["trial"])
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


# Reading of batches ahead, in threads.
#
# Decoding of movies and the kernels of the renderer release Python's global lock, so that threads
# read while a model trains.

Request = TypeVar("Request")
Read = TypeVar("Read")


def background(
    requests: Iterable[Request],
    read: Callable[[Request], Read],
    *,
    ahead: int = 2,
    threads: int | None = None,
) -> Iterator[Read]:
    """Yield ``read(request)`` of every request, in order, read ahead in threads.

    An error of ``read`` or of ``requests`` is raised where its result would come. When the iterator
    ends, fails or is closed, all its threads have ended.

    Parameters
    ----------
    requests
        Arguments of ``read``. They are taken in the calling thread, when there is room for them.
    read
        Function that reads, such as a method of a source. It is called in several threads at once.
    ahead
        Results that are read or being read before they are asked for; they are held in memory.
    threads
        Number of threads; by default one for each core, at most ``ahead``.
    """
    if ahead < 1 or (threads is not None and threads < 1):
        raise BadInputError(f"reading ahead needs 1 result and 1 thread, not {ahead} and {threads}")
    return _read_ahead(iter(requests), read, ahead, min(threads or available_cores(), ahead))


def _read_ahead(
    requests: Iterator[Request], read: Callable[[Request], Read], ahead: int, workers: int
) -> Iterator[Read]:
    waiting: deque[Future[Read]] = deque()
    failure: Exception | None = None
    exhausted = False
    pool = ThreadPoolExecutor(workers, thread_name_prefix="batches")
    try:
        while True:
            while not exhausted and len(waiting) < ahead:
                try:
                    request = next(requests)
                except StopIteration:
                    exhausted = True
                except Exception as error:
                    failure, exhausted = error, True
                else:
                    waiting.append(pool.submit(read, request))
            if not waiting:
                break
            yield waiting.popleft().result()
        if failure is not None:
            raise failure
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
