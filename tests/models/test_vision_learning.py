"""What vision models learn in seconds from small pictures, and what their features then tell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from physion.clips.batch import Batch
from physion.models.build import build_model
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
from support.moving_squares import BACKGROUND, squares
from support.squares_source import SquaresSource

pytestmark = [pytest.mark.slow, pytest.mark.nightly]

SETTINGS = TrainingSettings(
    batch=8, learning_rate=3e-3, schedule="cosine", warmup=20, clip=1.0, held_out=0.1,
    validate_every=1000, log_every=50,
)  # fmt: skip
TRAINED, TESTED = 400, 100


def svg_of() -> Svg:
    model = Svg(
        SvgSettings(
            image_size=16, code=32, hidden=64, past=3, imagined=3, context=3, future=4,
            weights="random",
        )
    )  # fmt: skip
    model.training_settings = replace(SETTINGS, steps=600)
    return model


def op3_of() -> Op3:
    model = Op3(
        Op3Settings(
            image_size=16, slots=3, width=12, layers=3, hidden=32, effect=16, seed_steps=2, past=3,
            imagined=3, context=3, future=4, weights="random",
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


@pytest.mark.parametrize("build", [svg_of, op3_of], ids=["svg", "op3"])
def test_imagined_squares_are_better_than_a_copy_and_than_none(build: Any) -> None:
    """A model that shows an empty scene is better than the copy too, but predicts no motion."""
    model = build()
    untrained, copy, empty = held_out_error(model)
    source = SquaresSource(model.spec, TRAINED)
    trained = train_model(
        model, source, source.trials, seed=0, name="all", folder=None, accelerator="cpu"
    )
    error, _, _ = held_out_error(model)
    print(f"{model.name}: {error:.4f}, untrained {untrained:.4f}, copy {copy:.4f}, {empty:.4f}")
    assert error < 0.75 * untrained and error < 0.75 * copy and error < 0.9 * empty
    assert trained.validation < trained.baseline


def test_boxes_of_falling_squares_are_nearer_than_at_constant_velocity() -> None:
    """The untrained network, whose loss is larger, predicts that nothing moves."""
    model: Any = build_model("rpin", weights="random", image_size=32)

    def clips(count: int, seed: int) -> Batch:
        return squares(count, model.window, model.spec, seed, fall=0.3)

    def errors() -> tuple[float, float]:
        with torch.no_grad():
            own, constant = model.center_errors(clips(40, 10_000))
        return float(own.mean()), float(constant.mean())

    untrained, constant = errors()
    optimizer = torch.optim.Adam(model.parameters(), 2e-3)
    for step in range(60):
        optimizer.zero_grad()
        model.loss(clips(8, step))["loss"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    own, _ = errors()
    print(f"rpin: {own / constant:.3f} of the error at constant velocity, {own / untrained:.3f}")
    assert own < 0.6 * constant and own < 0.6 * untrained


# Under *full* the features of a model tell the outcome that the later frames show, and nothing if
# these are those of another trial, or if the labels are. Untrained networks do, so that none is
# trained here. For RPIN, whose boxes come from the motions of trials, these are exchanged too.

NAMES = ("cswm", "svg", "op3", "rpin")
OPTIONS: dict[str, dict[str, Any]] = {"op3": {"slots": 3}}
"""Options by model; with fewer slots OP3 is quicker."""
COUNTS = {"readout": 24, "testing": 48}
CHANCE = 0.217
"""Three standard errors of the accuracy of guessing 48 trials."""


@dataclass(frozen=True)
class Cases:
    """A dataset, and its copy with exchanged futures."""

    dataset: Dataset
    exchanged: Dataset


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> Cases:
    folder = tmp_path_factory.mktemp("dots")
    made = make_dots(folder / "data", COUNTS, ("drop",))
    return Cases(made, with_exchanged_futures(made, folder / "exchanged", motions=False))


@pytest.fixture(scope="module")
def late_motions(tmp_path_factory: pytest.TempPathFactory) -> Cases:
    folder = tmp_path_factory.mktemp("late motions")
    made = make_late_motions(folder / "data", COUNTS)
    return Cases(made, with_exchanged_futures(made, folder / "exchanged", motions=True))


def accuracy_of_full(dataset: Dataset, name: str, folder: Path) -> float:
    settings = EvaluationSettings(
        readouts=("full",), accelerator="cpu", logistic=LogisticSettings(grid=(1e-2, 1.0)),
        untrained=True,
    )  # fmt: skip
    options = {"weights": "random", **OPTIONS.get(name, {})}
    table = evaluate(name, dataset, folder, options=options, settings=settings).predictions
    return float(((table["p_contact"] > 0.5) == table["outcome"]).mean())


@pytest.mark.parametrize("name", NAMES)
def test_full_falls_to_chance_with_exchanged_futures(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    made: Cases = request.getfixturevalue("late_motions" if name == "rpin" else "dots")
    own = accuracy_of_full(made.dataset, name, tmp_path / "own")
    fallen = accuracy_of_full(made.exchanged, name, tmp_path / "exchanged")
    # The movies are the same, and so are the features, which need not be made again.
    guessed = accuracy_of_full(with_permuted_labels(made.dataset), name, tmp_path / "own")
    print(f"{name}: {own:.3f}, exchanged futures {fallen:.3f}, permuted labels {guessed:.3f}")
    assert own > 0.5 + CHANCE
    assert abs(fallen - 0.5) < CHANCE and abs(guessed - 0.5) < CHANCE
