"""A small generated dataset: movies of `tiny_study` with maps, in free and in marked colours."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from physion.trials.dataset import Dataset
from physion.trials.files import TrialPaths
from physion.trials.index import COLUMNS, as_table, write_index
from physion.trials.video import encode_movie
from support.experiment.tiny_study import FULL, OBSERVED, draw, draw_map


def make_tiny_dataset(
    folder: Path,
    *,
    test: int = 6,
    familiarization: int = 4,
    scenarios: tuple[str, ...] = ("collide",),
    size: int = 64,
    contacts: str = "alternating",
    rate: int = 30,
    free: bool = True,
) -> Dataset:
    """Write a dataset with the given numbers of trials per split and scenario.

    Parameters
    ----------
    folder
        Folder of the dataset.
    test, familiarization
        Trials per scenario in the splits testing and familiarization.
    scenarios
        Names of the scenarios.
    size
        Width and height of the movies in pixels.
    contacts
        ``alternating``: every second trial has contact; ``all``: every trial.
    rate
        Frames per second.
    free
        Also write movies in free colours. The default look is ``redyellow``, as in generated
        testing trials.
    """
    rows, number = [], 0
    for scenario in scenarios:
        for split, count in (("testing", test), ("familiarization", familiarization)):
            for index in range(count):
                contact = contacts == "all" or index % 2 == 0
                name = f"{scenario}_{split}_{index:04d}"
                paths = TrialPaths(folder, split, scenario, name)
                rows.append(_make(paths, number, contact, size, rate, free))
                number += 1
    write_index(folder, as_table(rows))
    return Dataset(folder)


def _make(
    paths: TrialPaths, number: int, contact: bool, size: int, rate: int, free: bool
) -> dict[str, Any]:
    row: dict[str, Any] = {
        column: {"string": "none", "bool": False, "int64": 0, "float64": 0.0}.get(kind)
        for column, kind in COLUMNS.items()
    }
    row |= {"trial": paths.trial, "scenario": paths.scenario, "split": paths.split}
    row |= {"contact": contact, "look": "redyellow", "frames": FULL, "observed_frames": OBSERVED}
    row |= dict.fromkeys(
        f"free_{name}{what}"
        for name in ("movie", "observed_movie")
        for what in ("", "_bytes", "_sha256")
    )
    frames = draw(number, contact, size)
    marked = frames.copy()
    # Make the blue agent red, which is enough to distinguish the looks.
    marked[frames[..., 2] > 180] = (200, 30, 30)
    files = {
        "movie": encode_movie(marked, rate=rate),
        "observed_movie": encode_movie(marked[:OBSERVED], rate=rate),
        "map": draw_map(number, size),
    }
    if free:
        files["free_movie"] = encode_movie(frames, rate=rate)
        files["free_observed_movie"] = encode_movie(frames[:OBSERVED], rate=rate)
    for name, path in paths.all(free=True).items():
        if name in files:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(files[name])
            row[name] = path.relative_to(paths.folder).as_posix()
            row[f"{name}_bytes"] = len(files[name])
            row[f"{name}_sha256"] = hashlib.sha256(files[name]).hexdigest()
    return row


def is_marked(frame: np.ndarray) -> bool:
    """Return whether an image (H, W, 3) has the red and yellow look."""
    red, _, blue = (frame[..., channel].astype(int) for channel in range(3))
    # Apart from the white digits, only the red or the blue disk is this far from grey.
    return bool((red - blue > 80).sum() > (blue - red > 80).sum())
