"""Learning rates: warm-up, cosine, and the rule of torch for validations that stall."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from torch.optim.lr_scheduler import ReduceLROnPlateau

from physion.models.interface import TrainingSettings
from physion.training.loop import Plateau, learning_rate


def test_the_rate_rises_linearly_and_is_constant_afterwards() -> None:
    settings = TrainingSettings(steps=20, learning_rate=0.5, warmup=4)
    rates = [learning_rate(settings, step) for step in range(7)]
    assert rates == pytest.approx([0.125, 0.25, 0.375, 0.5, 0.5, 0.5, 0.5])
    assert learning_rate(settings, 10, factor=0.5) == pytest.approx(0.25)


def test_the_cosine_goes_from_the_base_rate_to_zero() -> None:
    settings = TrainingSettings(steps=14, learning_rate=2.0, warmup=4, schedule="cosine")
    rates = [learning_rate(settings, step) for step in range(4, 15)]
    assert rates[0] == 2.0 and rates[5] == pytest.approx(1.0) and rates[10] == pytest.approx(0.0)
    assert (np.diff(rates) < 0).all()


@pytest.mark.parametrize("patience", [0, 1, 3])
def test_the_plateau_follows_torch(patience: int) -> None:
    settings = TrainingSettings(
        schedule="plateau", plateau_patience=patience, plateau_factor=0.8, learning_rate=1.0
    )
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([weight], lr=1.0)
    reference = ReduceLROnPlateau(optimizer, factor=0.8, patience=patience)
    losses = np.random.default_rng(patience).integers(1, 30, 60) / 10
    losses[10:14] = losses[9] * (1 - 0.5e-4)  # improvements that are too small to count
    plateau, rates = Plateau(), []
    for loss in losses:
        reference.step(float(loss))
        plateau.update(float(loss), settings)
        # As it is stored in a checkpoint.
        plateau = Plateau.of(json.loads(json.dumps(plateau.state())))
        assert learning_rate(settings, 5, plateau.factor) == pytest.approx(
            optimizer.param_groups[0]["lr"]
        )
        rates.append(plateau.factor)
    assert len(set(rates)) > 3
