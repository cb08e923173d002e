"""C-SWM and RPIN (small) on held-out movies after a minute of training, compared with no training
and with trivial predictors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch

from physion.models.batch import Batch
from physion.models.build import build_model
from physion.models.cswm.contrast import ranking
from physion.training.sources.open_source import whole_source
from physion.trials.dataset import Dataset
from support.small_movies import held_out, make_movies, train_quickly

pytestmark = pytest.mark.slow

SEEDS = (0, 1, 2)
TRIALS = {"training": 24, "testing": 10}
"""Of each of two scenarios."""


@pytest.fixture(scope="module")
def movies(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_movies(tmp_path_factory.mktemp("movies") / "data", TRIALS, ("collide", "drop"))


@torch.no_grad()
def loss_of(model: Any, batch: Batch) -> float:
    return float(model.loss(batch)["loss"])


def trained(name: str, dataset: Dataset, seed: int, steps: int) -> tuple[Any, Any, Batch]:
    """Return the trained model, the same untrained, and clips of the testing trials."""
    model, untrained = (build_model(name, seed=seed) for _ in range(2))
    source = whole_source(dataset, model.spec)
    settings = replace(model.settings, steps=steps, warmup=10)  # type: ignore[attr-defined]
    train_quickly(model, source, dataset.trials("training"), settings, seed)
    clips = held_out(model, source, dataset.trials("testing"))
    return model.eval(), untrained.eval(), clips  # type: ignore[attr-defined]


@pytest.mark.parametrize("seed", SEEDS)
def test_slots_tell_the_next_state_from_the_present_and_from_others(
    movies: Dataset, seed: int
) -> None:
    """The candidates are 100 states: five of each of 20 clips."""
    model, untrained, clips = trained("cswm", movies, seed, 200)
    with torch.no_grad():
        ranks, copied = model.next_state_ranks(clips)
        before, _ = untrained.next_state_ranks(clips)
        assert loss_of(model, clips) < float(model.baseline(clips))
    assert loss_of(model, clips) < loss_of(untrained, clips)
    best = max(ranking(copied).reciprocal, ranking(before).reciprocal)
    assert len(ranks) == 60 and ranking(ranks).reciprocal > best


@pytest.mark.parametrize("seed", SEEDS)
def test_boxes_are_nearer_than_at_constant_velocity(movies: Dataset, seed: int) -> None:
    model, untrained, clips = trained("rpin", movies, seed, 100)
    with torch.no_grad():
        errors, constant = model.center_errors(clips)
        still, _ = untrained.center_errors(clips)
        assert loss_of(model, clips) < float(model.baseline(clips))
    assert loss_of(model, clips) < loss_of(untrained, clips)
    assert mean_of(errors) < min(mean_of(constant), mean_of(still))


def mean_of(errors: Sequence[float] | torch.Tensor) -> float:
    """Return the mean over the steps that show an object."""
    return float(torch.as_tensor(errors).nanmean())
