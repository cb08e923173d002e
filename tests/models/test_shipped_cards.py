"""Trained weights of the package: each file has its size, digest and card, and loads."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import pytest
import torch

from physion.models.build import build_model
from physion.models.checkpoint import shipped_digests

NAMES = tuple(sorted(shipped_digests()))
PARTICLES, VISION = {"dpi", "gns", "gns-ransac"}, {"svg", "op3", "cswm", "rpin"}


def test_all_models_that_must_have_weights_do() -> None:
    assert set(NAMES) == {f"{name}-small" for name in PARTICLES | VISION}


@pytest.mark.parametrize("key", NAMES)
def test_weights_have_a_card_and_load(key: str) -> None:
    name = key.removesuffix("-small")
    folder = files("physion.data.weights")
    size = len(folder.joinpath(f"{key}.safetensors").read_bytes())
    assert size < (3_000_000 if name in PARTICLES else 4_000_000)
    card = folder.joinpath(f"{key}.md").read_text()
    for heading in ("Data", "Training", "Losses", "Hardware", "Trials", "Weights", "Scores"):
        assert f"\n## {heading}\n" in card
    assert f"SHA-256 of {key}.safetensors: {shipped_digests()[key]}\n" in card
    assert card.count("| seed | ") == 1 and card.count(f"| {key} | ") >= 1
    if name in PARTICLES:
        assert "**Official scenes, recorded outcomes**" in card
    model: Any = build_model(name)
    assert model.init == f"shipped:{shipped_digests()[key][:12]}"
    assert model.trained and model.digest() != build_model(name, weights="random").digest()
    # What `physion train` does by default makes these weights again.
    rows = (line.strip("| ").split(" | ") for line in card.splitlines())
    training = dict(row for row in rows if len(row) == 2)
    for option in ("steps", "batch", "schedule", "warmup", "validate_every"):
        assert str(getattr(model.training_settings, option)) == training[option]
    assert all(weight.dtype == torch.float32 for weight in model.parameters())
    if hasattr(model, "touch"):
        assert model.touch.isfinite().all()
