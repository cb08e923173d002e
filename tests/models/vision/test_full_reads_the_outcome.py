"""Under *full* a trained model's features tell the outcome that the later frames show, and nothing
if these are those of another trial.

The printed accuracies (`pytest -s`) are those of the trained model, of the same network with its
initial weights, and of the centroids of the red and yellow blobs. Left out are RPIN, whose boxes
come from the motion of a trial, which is not exchanged, and OP3, whose features take longer.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from physion.readout.evaluate import evaluate
from physion.readout.leak_checks import with_exchanged_futures
from physion.readout.logistic import ReadoutConfig
from physion.readout.settings import EvaluationConfig
from physion.trials.dataset import Dataset
from support.moving_dots import make_dots

pytestmark = pytest.mark.slow

STEPS = {"cswm": 40, "svg": 30}
COUNTS = {"training": 16, "readout": 24, "testing": 40}
CHANCE = 0.24
"""Three standard errors of the accuracy of guessing 40 trials."""


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_dots(tmp_path_factory.mktemp("dots") / "data", COUNTS, ("drop",))


@pytest.fixture(scope="module")
def exchanged(dots: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return with_exchanged_futures(dots, tmp_path_factory.mktemp("exchanged") / "data")


def accuracy_of_full(dataset: Dataset, name: str, folder: Path, weights: str, steps: int) -> float:
    """Return the accuracy of a model, which is trained if it has ``steps``."""
    config = EvaluationConfig(
        readouts=("full",), accelerator="cpu", readout=ReadoutConfig(grid=(1e-2, 1.0)),
        steps=steps or None, batch=8, warmup=0, untrained=not steps,
    )  # fmt: skip
    options: dict[str, Any] = {"weights": weights} if weights else {}
    table = evaluate(dataset, name, folder, options=options, config=config).predictions
    return float((table["Predicted Outcome"] == table["Actual Outcome"]).mean())


@pytest.mark.parametrize("name", list(STEPS))
def test_full_falls_to_chance_with_exchanged_futures(
    name: str, dots: Dataset, exchanged: Dataset, tmp_path: Path
) -> None:
    trained = accuracy_of_full(dots, name, tmp_path / "trained", "", STEPS[name])
    (weights,) = (tmp_path / "trained" / "training").iterdir()
    fallen = accuracy_of_full(exchanged, name, tmp_path / "exchanged", str(weights), 0)
    untrained = accuracy_of_full(dots, name, tmp_path / "untrained", "", 0)
    centroids = accuracy_of_full(dots, "blob-centroids", tmp_path / "centroids", "", 0)
    print(
        f"{name}: {trained:.3f}, with exchanged futures {fallen:.3f}; untrained {untrained:.3f}, "
        f"centroids {centroids:.3f}"
    )
    assert trained > 0.5 + CHANCE and centroids > 0.5 + CHANCE
    assert abs(fallen - 0.5) < CHANCE
