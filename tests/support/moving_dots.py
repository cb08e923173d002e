"""A real dataset of tiny movies, made in a second: a dot flies to the wall above or below a gap."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.trials.dataset import Dataset
from physion.trials.files import TrialPaths
from physion.trials.index import COLUMNS, as_table, write_index
from physion.trials.video import encode_movie

FRAMES, SIZE, OBSERVED = 151, 64, 45


def draw(contact: bool, rng: np.random.Generator) -> NDArray[np.uint8]:
    """A red dot that starts left of the middle and ends at the top (contact) or the bottom."""
    frames = np.full((FRAMES, SIZE, SIZE, 3), 110, np.uint8)
    start, height = rng.uniform(8, 14), rng.uniform(28, 36)
    end = rng.uniform(8, 18) if contact else rng.uniform(46, 56)
    rows, columns = np.mgrid[0:SIZE, 0:SIZE]
    for frame in range(FRAMES):
        share = frame / (FRAMES - 1)
        # It turns only after the observed part, so that nobody can know.
        late = max(0.0, (frame - OBSERVED) / (FRAMES - 1 - OBSERVED))
        x, y = start + 40 * share, height + (end - height) * late
        frames[frame, (rows - y) ** 2 + (columns - x) ** 2 < 36] = (220, 30, 30)
    return frames


def make_dots(folder: Path, counts: dict[str, int], scenarios: tuple[str, ...]) -> Dataset:
    """A dataset with ``counts[split]`` trials of each scenario, half of them with contact."""
    rows = []
    for scenario in scenarios:
        for split, count in counts.items():
            for number in range(count):
                rows.append(_make(folder, scenario, split, number))  # noqa: PERF401
    write_index(folder, as_table(rows))
    return Dataset(folder)


def _make(folder: Path, scenario: str, split: str, number: int) -> dict[str, Any]:
    name = f"{scenario}_{split}_{number:04d}"
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    contact = number % 2 == 0
    frames = draw(contact, np.random.default_rng(seed))
    paths = TrialPaths(folder, split, scenario, name)
    row: dict[str, Any] = {
        column: {"string": "none", "bool": False, "int64": 0, "float64": 0.0}.get(kind)
        for column, kind in COLUMNS.items()
    }
    row |= {"trial": name, "dataset": "dots", "scenario": scenario, "split": split}
    row |= {"index": number, "contact": contact, "frames": FRAMES, "observed_frames": OBSERVED}
    row |= {
        "observed_contact": False,
        "width": SIZE,
        "height": SIZE,
        "playback_seconds": FRAMES / 30,
    }
    row |= {"digest": hashlib.sha256(frames.tobytes()).hexdigest()}
    for column, path, shown in (
        ("movie", paths.movie, frames),
        ("observed_movie", paths.observed_movie, frames[:OBSERVED]),
    ):
        content = encode_movie(shown)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        row[column] = path.relative_to(folder).as_posix()
        row[f"{column}_bytes"] = len(content)
        row[f"{column}_sha256"] = hashlib.sha256(content).hexdigest()
    return row
