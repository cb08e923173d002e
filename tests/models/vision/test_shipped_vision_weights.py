"""Trained weights of vision models in the package, on movies that they never saw."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from physion.core.names import SCENARIOS
from physion.models.build import build_model
from physion.models.cswm import ranking
from physion.models.vision import empty_scene_error
from physion.trials.dataset import Dataset
from support.small_movies import early_windows, make_movies, read_whole

NAMES = ("svg", "op3", "cswm", "rpin")
TESTED = {"testing": 3}
"""Trials of every scenario."""


@pytest.fixture(scope="module")
def movies(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("movies") / "data"
    return make_movies(folder, TESTED, SCENARIOS, name="never-seen")


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_predictions_of_new_movies_beat_those_without_training(name: str, movies: Dataset) -> None:
    """Better than the same network with random weights, and than every trivial predictor."""
    trained, *trivial = scores(name, movies, "shipped")
    untrained, *_ = scores(name, movies, "random")
    print(f"{name}: {trained:.4f}, untrained {untrained:.4f}, trivial {trivial}")
    assert trained < 0.95 * min(untrained, *trivial)


@torch.no_grad()
def scores(name: str, movies: Dataset, weights: str) -> list[float]:
    """Return what is to be small, of the model and of the trivial predictors.

    C-SWM: 1 less the mean reciprocal rank of the next state; of a copy of the present one. RPIN:
    the distance of centres; at constant velocity. SVG and OP3: the error of moving pixels; of the
    last observed picture, and of the median of the observed ones, which shows an empty scene.
    """
    model: Any = build_model(name, weights=weights)
    batch = early_windows(model, read_whole(movies, "testing", model.spec))
    model.eval()
    torch.manual_seed(0)
    if name == "cswm":
        ranks, copied = model.next_state_ranks(batch)
        return [1 - ranking(ranks).reciprocal, 1 - ranking(copied).reciprocal]
    if name == "rpin":
        own, constant = model.center_errors(batch)
        return [float(own.nanmean()), float(constant.nanmean())]
    pictures = batch.rgb.permute(0, 1, 4, 2, 3).float() / 255
    empty = empty_scene_error(pictures, model.settings.imagined, batch.valid).moving
    return [float(model.loss(batch)["loss"]), float(model.baseline(batch)), float(empty)]
