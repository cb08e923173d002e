"""Under *full* a trained model's features tell the outcome that the later frames show, and nothing
if these are those of another trial, or if the labels are.

The printed accuracies (`pytest -s`) are those of the trained model and of the centroids of the red
and yellow blobs. For RPIN, whose boxes come from the motions of trials, these are exchanged too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from physion.readout.evaluate import evaluate
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings
from physion.trials.dataset import Dataset
from support.late_motions import make_late_motions
from support.leak_checks import with_exchanged_futures, with_permuted_labels
from support.moving_dots import make_dots

pytestmark = pytest.mark.slow

TRAINING: dict[str, dict[str, Any]] = {
    "cswm": {"steps": 40}, "svg": {"steps": 30}, "op3": {"steps": 20, "learning_rate": 3e-3},
    "rpin": {"steps": 20},
}  # fmt: skip
"""Settings of the training by model."""
OPTIONS: dict[str, dict[str, Any]] = {"op3": {"slots": 3}}
"""Options by model; with fewer slots OP3 is quicker."""
COUNTS = {"training": 16, "readout": 24, "testing": 100}
CHANCE = 0.15
"""Three standard errors of the accuracy of guessing 100 trials."""


@dataclass(frozen=True)
class Cases:
    """A dataset, its copy with exchanged futures, and the accuracy of the blobs' centroids."""

    dataset: Dataset
    exchanged: Dataset
    centroids: float


def cases_of(dataset: Dataset, folder: Path, *, motions: bool) -> Cases:
    exchanged = with_exchanged_futures(dataset, folder / "exchanged", motions=motions)
    centroids = accuracy_of_full(dataset, "blob-centroids", folder / "centroids")
    return Cases(dataset, exchanged, centroids)


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Cases:
    folder = tmp_path_factory.mktemp("dots")
    return cases_of(make_dots(folder / "data", COUNTS, ("drop",)), folder, motions=False)


@pytest.fixture(scope="module")
def late_motions(tmp_path_factory: pytest.TempPathFactory) -> Cases:
    folder = tmp_path_factory.mktemp("late motions")
    return cases_of(make_late_motions(folder / "data", COUNTS), folder, motions=True)


def accuracy_of_full(
    dataset: Dataset, name: str, folder: Path, *, weights: str = "", **training: Any
) -> float:
    """Return the accuracy of a model, which is trained if it has settings of a ``training``."""
    config = EvaluationSettings(
        readouts=("full",), accelerator="cpu", logistic=LogisticSettings(grid=(1e-2, 1.0)),
        untrained=not training,
    )  # fmt: skip
    options: dict[str, Any] = {**OPTIONS.get(name, {}), "batch": 8, "warmup": 0, **training}
    if name in TRAINING:
        options["weights"] = weights or "random"
    table = evaluate(name, dataset, folder, options=options, settings=config).predictions
    return float(((table["p_contact"] > 0.5) == table["outcome"]).mean())


@pytest.mark.parametrize("name", list(TRAINING))
def test_full_falls_to_chance_with_exchanged_futures(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    made: Cases = request.getfixturevalue("late_motions" if name == "rpin" else "dots")
    trained = accuracy_of_full(made.dataset, name, tmp_path / "trained", **TRAINING[name])
    (weights,) = (tmp_path / "trained" / "training").iterdir()
    fallen = accuracy_of_full(made.exchanged, name, tmp_path / "exchanged", weights=str(weights))
    # The movies and weights are the same, and so are the features, which need not be made again.
    permuted = with_permuted_labels(made.dataset)
    guessed = accuracy_of_full(permuted, name, tmp_path / "trained", weights=str(weights))
    print(
        f"{name}: {trained:.3f}, with exchanged futures {fallen:.3f}, with permuted labels "
        f"{guessed:.3f}; centroids {made.centroids:.3f}"
    )
    assert trained > 0.5 + CHANCE and made.centroids > 0.5 + CHANCE
    assert abs(fallen - 0.5) < CHANCE and abs(guessed - 0.5) < CHANCE
