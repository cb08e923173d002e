"""What dynamics learn of features of EfficientNet-Lite0 (ImageNet): squares that move.

Rendered trials: `benchmarks/models/vision_models.py learn`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from physion.clips.batch import Batch
from physion.models.build import build_model
from physion.training.train import train_model
from support.squares_source import SquaresSource

pytestmark = pytest.mark.slow

NAMES = ("pEffNetLite0-mlp", "pEffNetLite0-lstm")
OPTIONS: dict[str, Any] = {"image_size": 64, "context": 3, "future": 4, "hidden": 256}
TRAINED, TESTED = 400, 100


def encoded(source: SquaresSource) -> Batch:
    """Return whole clips with their features."""
    model: Any = build_model(NAMES[0], **OPTIONS)
    clips = source.whole(source.trials).to("cpu")
    rows = np.array_split(np.arange(len(clips)), 10)
    features = torch.cat([model.encode(clips.select(part)) for part in rows])
    return dataclasses.replace(clips, features=features)


@pytest.fixture(scope="module")
def source() -> SquaresSource:
    return SquaresSource(build_model(NAMES[0], **OPTIONS).spec, TRAINED)


@pytest.fixture(scope="module")
def training(source: SquaresSource) -> NDArray[np.float32]:
    return np.asarray(encoded(source).features)


@pytest.fixture(scope="module")
def testing(source: SquaresSource) -> Batch:
    return encoded(SquaresSource(source.spec, TESTED, seed=99))


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("name", NAMES)
def test_the_next_feature_is_nearer_than_the_last_one(
    source: SquaresSource, training: NDArray[np.float32], testing: Batch, name: str, seed: int
) -> None:
    """Untrained dynamics repeat the last feature."""

    def features(trials: Sequence[str]) -> NDArray[np.float32]:
        assert list(trials) == list(source.trials)
        return training

    model: Any = build_model(name, **OPTIONS, seed=seed)
    trained = train_model(
        model,
        source,
        source.trials,
        settings=dataclasses.replace(model.training_settings, steps=300),
        seed=seed,
        name="all",
        folder=None,
        features=features,
        accelerator="cpu",
    )
    with torch.no_grad():
        error, last = float(model.loss(testing)["loss"]), float(model.baseline(testing))
    print(f"{model.name()}, seed {seed}: {error / last:.3f} of the error of the last feature")
    assert error < 0.95 * last
    assert trained.validation < trained.baseline
