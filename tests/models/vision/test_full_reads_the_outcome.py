"""Under *full* a trained model's features tell the outcome that the later frames show, and nothing
if these are those of another trial, or if the labels are.

The printed accuracies (`pytest -s`) are those of the trained model, of the same network with its
initial weights, and of the centroids of the red and yellow blobs. Left out is RPIN, whose boxes
come from the motion of a trial, which is not exchanged.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from physion.readout.evaluate import evaluate
from physion.readout.leak_checks import with_exchanged_futures, with_permuted_labels
from physion.readout.logistic import ReadoutConfig
from physion.readout.settings import EvaluationConfig
from physion.trials.dataset import Dataset
from support.moving_dots import make_dots

pytestmark = pytest.mark.slow

TRAINING: dict[str, dict[str, Any]] = {
    "cswm": {"steps": 40}, "svg": {"steps": 30}, "op3": {"steps": 20, "learning_rate": 3e-3},
}  # fmt: skip
"""Settings of the training by model."""
OPTIONS: dict[str, dict[str, Any]] = {"op3": {"slots": 3}}
"""Options by model; with fewer slots OP3 is quicker."""
COUNTS = {"training": 16, "readout": 24, "testing": 100}
CHANCE = 0.15
"""Three standard errors of the accuracy of guessing 100 trials."""


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_dots(tmp_path_factory.mktemp("dots") / "data", COUNTS, ("drop",))


@pytest.fixture(scope="module")
def exchanged(dots: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return with_exchanged_futures(dots, tmp_path_factory.mktemp("exchanged") / "data")


@pytest.fixture(scope="module")
def centroids(dots: Dataset, tmp_path_factory: pytest.TempPathFactory) -> float:
    return accuracy_of_full(dots, "blob-centroids", tmp_path_factory.mktemp("centroids"))


def accuracy_of_full(
    dataset: Dataset, name: str, folder: Path, *, weights: str = "", **training: Any
) -> float:
    """Return the accuracy of a model, which is trained if it has settings of a ``training``."""
    config = EvaluationConfig(
        readouts=("full",), accelerator="cpu", readout=ReadoutConfig(grid=(1e-2, 1.0)),
        batch=8, warmup=0, untrained=not training, **training,
    )  # fmt: skip
    options = {**OPTIONS.get(name, {}), **({"weights": weights} if weights else {})}
    table = evaluate(dataset, name, folder, options=options, config=config).predictions
    return float((table["Predicted Outcome"] == table["Actual Outcome"]).mean())


@pytest.mark.parametrize("name", list(TRAINING))
def test_full_falls_to_chance_with_exchanged_futures(
    name: str, dots: Dataset, exchanged: Dataset, centroids: float, tmp_path: Path
) -> None:
    trained = accuracy_of_full(dots, name, tmp_path / "trained", **TRAINING[name])
    (weights,) = (tmp_path / "trained" / "training").iterdir()
    fallen = accuracy_of_full(exchanged, name, tmp_path / "exchanged", weights=str(weights))
    permuted = with_permuted_labels(dots)
    guessed = accuracy_of_full(permuted, name, tmp_path / "permuted", weights=str(weights))
    untrained = accuracy_of_full(dots, name, tmp_path / "untrained")
    print(
        f"{name}: {trained:.3f}, with exchanged futures {fallen:.3f}, with permuted labels "
        f"{guessed:.3f}; untrained {untrained:.3f}, centroids {centroids:.3f}"
    )
    assert trained > 0.5 + CHANCE and centroids > 0.5 + CHANCE
    assert abs(fallen - 0.5) < CHANCE and abs(guessed - 0.5) < CHANCE
