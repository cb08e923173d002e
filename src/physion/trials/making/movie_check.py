"""Comparison of a few frames of a trial's movies with the rendered state.

It finds a movie that is whole and listed, but belongs to another trial.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physion.trials.layout import TrialPaths
from physion.trials.trial_file import Trial
from physion.trials.video import read_chosen

CELL = 8
"""Side in pixels of the cells whose mean colours are compared."""
SCALE = 2
"""The state is rendered with so many times fewer pixels a side, which takes less time and tells
trials apart as well."""
LARGEST_DIFFERENCE = 40.0
"""Largest difference of a cell's mean colour between movie and rendered state, of 255. Compression
and the smaller pictures change cells by up to 22 (72 trials of all scenarios, 64, 128 and 256
pixels); the movie of another trial of the same scenario differs by 57 or more somewhere (144
pairs)."""


def foreign_movies(paths: TrialPaths, trial: Trial) -> list[str]:
    """Return one line for each movie of the trial that does not show its state.

    Compared are the first frame, the last one of the observed part, and the last one.
    """
    meta = trial.metadata
    if not meta.movies or not np.isfinite(trial.trajectory.positions).all():
        return []
    observed = [0, meta.observed_frames - 1]
    files = paths.all(meta.movies, meta.free_movies)
    faults = []
    for look, prefix in ((meta.look, ""), *((("free", "free_"),) if meta.free_movies else ())):
        rendered = _rendered(trial, look, [*observed, meta.frames - 1])
        faults += _differing(files[f"{prefix}movie"], rendered)
        shown = {frame: rendered[frame] for frame in observed}
        faults += _differing(files[f"{prefix}observed_movie"], shown)
    return faults


def _rendered(trial: Trial, look: str, frames: list[int]) -> dict[int, NDArray[np.float32]]:
    """Return the mean colours (rows, columns, 3) of the cells of rendered frames."""
    meta = trial.metadata
    renderer = trial.renderer(max(meta.width // SCALE, 1), max(meta.height // SCALE, 1), look)
    found = {}
    for frame in frames:
        color = renderer.render(frame).color
        assert color is not None, "colour was asked for"
        found[frame] = _cells(color, CELL // SCALE)
    return found


def _differing(path: Path, rendered: Mapping[int, NDArray[np.float32]]) -> list[str]:
    pictures = read_chosen(path, list(rendered))
    for picture, (frame, wanted) in zip(pictures, rendered.items(), strict=True):
        found = _cells(picture, CELL)
        if found.shape != wanted.shape:
            return [f"{path} has pictures of another size than its trial"]
        if np.abs(found - wanted).max() > LARGEST_DIFFERENCE:
            return [f"{path} does not show its trial: frame {frame} differs from the stored state"]
    return []


def _cells(picture: NDArray[np.uint8], side: int) -> NDArray[np.float32]:
    """Return the mean colours of cells of ``side`` pixels; a rest at the edges is left out."""
    rows, columns = (max(length // side, 1) for length in picture.shape[:2])
    whole = picture[: rows * side, : columns * side]
    height, width = whole.shape[0] // rows, whole.shape[1] // columns
    strips = whole.reshape(rows, height, -1).sum(axis=1, dtype=np.float32)
    sums = strips.reshape(rows, columns, width, 3).sum(axis=2)
    return np.asarray(sums / (height * width), np.float32)
