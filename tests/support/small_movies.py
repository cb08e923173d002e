"""A dataset of small movies, on which vision models are trained for a minute."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from physion.compute.local import LocalExecutor
from physion.models.batch import Batch
from physion.models.settings import TrainingSettings
from physion.seeds import generator
from physion.training.sources.source import WholeSource
from physion.training.train import train_model
from physion.trials.dataset import Dataset
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_dataset


def make_movies(folder: Path, counts: dict[str, int], scenarios: tuple[str, ...]) -> Dataset:
    """Return trials with movies of 64 x 64 pixels, ``counts[split]`` of every scenario."""
    tasks = plan_dataset("small movies", scenarios, counts)
    settings = GenerateSettings(width=64, height=64, look="redyellow", jitters=0)
    assert not make_trials(folder, tasks, settings, executor=LocalExecutor(workers=2)).failed
    return Dataset(folder)


def held_out(model: Any, source: WholeSource, trials: list[str]) -> Batch:
    """Return one training clip of every trial, from a random frame, as tensors.

    It starts in the first 40 frames, since later most objects rest.
    """
    rng = generator("held out")
    starts = [int(rng.integers(40)) for _ in trials]
    return source.window(trials, starts, model.window).to("cpu")


def train_quickly(
    model: Any, source: WholeSource, trials: list[str], settings: TrainingSettings, seed: int
) -> None:
    """Train a model in place."""
    train_model(
        model,
        source,
        trials,
        settings=settings,
        seed=seed,
        name="all",
        folder=None,
        accelerator="cpu",
    )
