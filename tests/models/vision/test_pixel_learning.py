"""What SVG and OP3 learn in seconds: squares that move, in small pictures.

Rendered trials, and the sizes that users train: `benchmarks/models/vision_models.py learn`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from physion.models.interface import TrainingSettings
from physion.models.op3 import Op3, Op3Settings
from physion.models.svg import Svg, SvgSettings
from physion.models.vision import future_error
from physion.training.train import train_model
from physion.training.windows import ClipWindows, validation_requests
from support.moving_squares import BACKGROUND
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
