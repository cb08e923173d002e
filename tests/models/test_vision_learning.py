"""What vision models learn in seconds from small pictures of squares and balls."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from physion.clips.batch import Batch
from physion.models.build import build_model
from physion.models.cswm import ranking
from physion.models.interface import TrainingSettings
from physion.models.op3 import Op3, Op3Settings
from physion.models.svg import Svg, SvgSettings
from physion.models.vision import future_error
from physion.readout.evaluate import evaluate
from physion.readout.logistic import LogisticSettings
from physion.readout.settings import EvaluationSettings
from physion.training.train import train_model
from physion.training.windows import ClipWindows, validation_requests
from physion.trials.dataset import Dataset
from support.late_motions import make_late_motions
from support.leak_checks import with_exchanged_futures, with_permuted_labels
from support.moving_dots import make_dots
from support.moving_squares import BACKGROUND
from support.small_movies import early_windows, make_movies, read_whole, windows
from support.squares_source import SquaresSource

pytestmark = pytest.mark.slow

SETTINGS = TrainingSettings(
    batch=8, learning_rate=3e-3, schedule="cosine", warmup=20, clip=1.0, held_out=0.1,
    validate_every=1000, log_every=50,
)  # fmt: skip
TRAINED, TESTED = 400, 100


def svg_of(seed: int) -> Svg:
    model = Svg(
        SvgSettings(
            image_size=16, code=32, hidden=64, past=3, imagined=3, context=3, future=4, seed=seed,
            weights="random",
        )
    )  # fmt: skip
    model.training_settings = replace(SETTINGS, steps=600)
    return model


def op3_of(seed: int) -> Op3:
    model = Op3(
        Op3Settings(
            image_size=16, slots=3, width=12, layers=3, hidden=32, effect=16, seed_steps=2, past=3,
            imagined=3, context=3, future=4, seed=seed, weights="random",
        )
    )  # fmt: skip
    model.training_settings = replace(SETTINGS, steps=150)
    return model


def held_out_error(model: Any) -> tuple[float, float, float]:
    """Return errors of moving pixels on trials never seen: of the model, of the copy, and of a
    picture without squares."""
    source = SquaresSource(model.spec, TESTED, seed=99)
    windows = ClipWindows(source, source.trials, model.window)
    (request,) = validation_requests(windows, TESTED, 0)
    batch = windows.read(request).to("cpu")
    pictures = batch.rgb.permute(0, 1, 4, 2, 3).float() / 255
    empty = torch.full_like(pictures[:, -model.settings.imagined :], BACKGROUND / 255)
    without = future_error(empty, pictures, batch.valid).moving
    torch.manual_seed(0)
    with torch.no_grad():
        error = model.eval().loss(batch)["loss"]
        return float(error), float(model.baseline(batch)), float(without)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("build", [svg_of, op3_of], ids=["svg", "op3"])
def test_imagined_squares_are_better_than_a_copy_and_than_none(build: Any, seed: int) -> None:
    """A model that shows an empty scene is better than the copy too, but predicts no motion."""
    model = build(seed)
    untrained, copy, empty = held_out_error(model)
    source = SquaresSource(model.spec, TRAINED)
    trained = train_model(
        model, source, source.trials, seed=seed, name="all", folder=None, accelerator="cpu"
    )
    error, _, _ = held_out_error(model)
    print(
        f"{model.name}, seed {seed}: {error:.4f}, untrained {untrained:.4f}, copy {copy:.4f}, "
        f"empty {empty:.4f}"
    )
    assert error < 0.75 * untrained and error < 0.75 * copy and error < 0.9 * empty
    assert trained.validation < trained.baseline


# C-SWM and RPIN (small) on movies that they were not trained on, after up to a minute of training,
# compared with no training and with trivial predictors.

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
    model: Any = build_model("cswm", seed=seed, weights="random")
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
    model: Any = build_model("rpin", seed=seed, weights="random")
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


# Under *full* a trained model's features tell the outcome that the later frames show, and nothing
# if these are those of another trial, or if the labels are.
#
# The printed accuracies (`pytest -s`) are those of the trained model and of the centroids of the
# red and yellow blobs. For RPIN, whose boxes come from the motions of trials, these are exchanged
# too.

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
    permuted = with_permuted_labels(made.dataset)
    # The movies and weights are the same, and so are the features, which need not be made again.
    guessed = accuracy_of_full(permuted, name, tmp_path / "trained", weights=str(weights))
    print(
        f"{name}: {trained:.3f}, with exchanged futures {fallen:.3f}, with permuted labels "
        f"{guessed:.3f}; centroids {made.centroids:.3f}"
    )
    assert trained > 0.5 + CHANCE and made.centroids > 0.5 + CHANCE
    assert abs(fallen - 0.5) < CHANCE and abs(guessed - 0.5) < CHANCE
