"""C-SWM and RPIN (small) on movies that they were not trained on, after up to a minute of training,
compared with no training and with trivial predictors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from physion.clips.batch import Batch
from physion.models.build import build_model
from physion.models.cswm import ranking
from physion.trials.dataset import Dataset
from support.small_movies import early_windows, make_movies, read_whole, windows

pytestmark = pytest.mark.slow

SEEDS = (0, 1, 2)
TRIALS = {"training": 24, "testing": 10}
"""Of each of two scenarios."""


@pytest.fixture(scope="module")
def movies(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_movies(tmp_path_factory.mktemp("movies") / "data", TRIALS, ("collide", "drop"))


@pytest.fixture(scope="module")
def clips(movies: Dataset) -> dict[tuple[str, str], Batch]:
    """Return all clips of each model and split, read once."""
    specs = {name: build_model(name).spec for name in ("cswm", "rpin")}
    return {
        (name, split): read_whole(movies, split, spec)
        for name, spec in specs.items()
        for split in TRIALS
    }


def train(model: Any, clips: Batch, steps: int, batch: int, rate: float, seed: int) -> None:
    """Train on random windows; the rate falls to 0 as half a cosine."""
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(model.parameters(), rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    latest = clips.frames.shape[1] - model.window
    model.train()
    for _ in range(steps):
        rows = rng.integers(len(clips), size=batch)
        optimizer.zero_grad()
        model.loss(windows(clips, model.window, latest, rows, rng))["loss"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    model.eval()


@torch.no_grad()
def loss_of(model: Any, batch: Batch) -> float:
    return float(model.loss(batch)["loss"])


@pytest.mark.parametrize("seed", SEEDS)
def test_slots_tell_the_next_state_from_the_present_and_from_others(
    clips: dict[tuple[str, str], Batch], seed: int
) -> None:
    """The candidates are 100 states: five of each of 20 clips."""
    model: Any = build_model("cswm", seed=seed)
    held_out = early_windows(model, clips["cswm", "testing"])
    model.eval()
    before = loss_of(model, held_out)
    with torch.no_grad():
        untrained, _ = model.next_state_ranks(held_out)
    train(model, clips["cswm", "training"], steps=1000, batch=16, rate=2e-3, seed=seed)
    with torch.no_grad():
        ranks, copied = model.next_state_ranks(held_out)
    assert loss_of(model, held_out) < before
    best = max(ranking(copied).reciprocal, ranking(untrained).reciprocal)
    own = ranking(ranks).reciprocal
    print(f"cswm, seed {seed}: reciprocal rank {own:.3f}, untrained or copied at best {best:.3f}")
    assert len(ranks) == 60 and own > best + 0.02


@pytest.mark.parametrize("seed", SEEDS)
def test_boxes_are_nearer_than_at_constant_velocity(
    clips: dict[tuple[str, str], Batch], seed: int
) -> None:
    """The untrained network, whose loss is larger, predicts that nothing moves."""
    model: Any = build_model("rpin", seed=seed)
    held_out = early_windows(model, clips["rpin", "testing"])
    model.eval()
    before = loss_of(model, held_out)
    with torch.no_grad():
        untrained, _ = (float(value.nanmean()) for value in model.center_errors(held_out))
    train(model, clips["rpin", "training"], steps=150, batch=8, rate=1e-3, seed=seed)
    with torch.no_grad():
        errors, constant = (float(value.nanmean()) for value in model.center_errors(held_out))
        assert loss_of(model, held_out) < min(before, float(model.baseline(held_out)))
    print(
        f"rpin, seed {seed}: {errors / constant:.3f} of the error at constant velocity, "
        f"{errors / untrained:.3f} of that without training"
    )
    assert errors < 0.6 * constant and errors < 0.95 * untrained
