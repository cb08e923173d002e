"""A dataset of small movies, and windows of its clips in memory, to train vision models quickly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from physion.clips.batch import Batch, Spec
from physion.clips.clips import whole_source
from physion.compute.local import LocalExecutor
from physion.trials.dataset import Dataset
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_dataset
from support.moving_squares import with_arrays

LAST_FRAME = 144


def make_movies(
    folder: Path, counts: dict[str, int], scenarios: tuple[str, ...], name: str = "small-movies"
) -> Dataset:
    """Return trials with movies of 64 x 64 pixels, ``counts[split]`` of every scenario."""
    tasks = plan_dataset(name, scenarios, counts)
    settings = GenerateSettings(width=64, height=64, look="redyellow", jitters=0)
    assert not make_trials(folder, tasks, settings, executor=LocalExecutor(workers=2)).failed
    return Dataset(folder)


def read_whole(dataset: Dataset, split: str, spec: Spec) -> Batch:
    """Return all trials of a split from frame 0 to `LAST_FRAME`, as tensors."""
    trials = dataset.trials(split)
    frames = LAST_FRAME // spec.stride + 1
    return whole_source(dataset, spec).window(trials, [0] * len(trials), frames).to("cpu")


def windows(clips: Batch, length: int, latest: int, rows: Any, rng: np.random.Generator) -> Batch:
    """Return ``length`` frames of clips with these rows, from random ones up to ``latest``."""
    starts = rng.integers(latest + 1, size=len(rows))
    chosen = np.asarray(rows)[:, None], starts[:, None] + np.arange(length)
    arrays = {name: value[chosen] for name, value in clips.arrays().items()}
    return with_arrays(clips, trials=tuple(clips.trials[row] for row in rows), **arrays)


def early_windows(model: Any, clips: Batch) -> Batch:
    """Return a window of every clip; it starts early, since later most objects rest."""
    latest = 40 // model.spec.stride
    return windows(clips, model.window, latest, range(len(clips)), np.random.default_rng(0))
