"""Trained weights of vision models in the package: files, cards, and movies they never saw."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import pytest
import torch

from physion.models.build import build_model
from physion.models.checkpoints.trained import shipped_digests
from physion.models.cswm.contrast import ranking
from physion.stimulus_names import SCENARIOS
from physion.trials.dataset import Dataset
from support.small_movies import early_windows, make_movies, read_whole

NAMES = tuple(
    name for name in ("svg", "op3", "cswm", "rpin") if f"{name}-small" in shipped_digests()
)
TESTED = {"testing": 3}
"""Trials of every scenario."""
LARGEST = 4_000_000
"""Bytes of a file."""


@pytest.mark.parametrize("name", NAMES)
def test_weights_have_a_card_and_load(name: str) -> None:
    folder = files("physion.models.checkpoints").joinpath("shipped")
    assert len(folder.joinpath(f"{name}-small.safetensors").read_bytes()) < LARGEST
    card = folder.joinpath(f"{name}-small.md").read_text()
    for heading in ("Data", "Training", "Losses", "Hardware", "Trials", "Scores"):
        assert f"\n## {heading}\n" in card
    model: Any = build_model(name, weights="shipped")
    assert model.init == f"shipped:{shipped_digests()[f'{name}-small'][:12]}"
    assert model.trained and model.digest() != build_model(name).digest()
    assert all(weight.dtype == torch.float32 for weight in model.parameters())


@pytest.fixture(scope="module")
def movies(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("movies") / "data"
    return make_movies(folder, TESTED, SCENARIOS, name="never-seen")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_predictions_of_new_movies_beat_those_without_training(name: str, movies: Dataset) -> None:
    """Better than the same network with random weights, and than the trivial predictor."""
    trained, trivial = scores(name, movies, "shipped")
    untrained, _ = scores(name, movies, "random")
    assert trained < min(untrained, trivial)


@torch.no_grad()
def scores(name: str, movies: Dataset, weights: str) -> tuple[float, float]:
    """Return what is to be small, of the model and of the trivial predictor.

    C-SWM: 1 less the mean reciprocal rank of the next state; of a copy of the present one. RPIN:
    the distance of centres; at constant velocity. SVG and OP3: the error of moving pixels; of the
    last observed picture.
    """
    model: Any = build_model(name, weights=weights)
    batch = early_windows(model, read_whole(movies, "testing", model.spec))
    model.eval()
    torch.manual_seed(0)
    if name == "cswm":
        ranks, copied = model.next_state_ranks(batch)
        return 1 - ranking(ranks).reciprocal, 1 - ranking(copied).reciprocal
    if name == "rpin":
        own, constant = model.center_errors(batch)
        return float(own.nanmean()), float(constant.nanmean())
    return float(model.loss(batch)["loss"]), float(model.baseline(batch))
