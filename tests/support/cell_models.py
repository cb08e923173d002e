"""Tiny models for plans of trainings: one with a seed and all readouts, and some that go wrong."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor

from physion.clips.batch import Batch, Rollout
from physion.models.interface import TrainingSettings
from support.trained_models import NextBrightness

SIX = TrainingSettings(
    steps=6, batch=4, learning_rate=1e-2, log_every=2, checkpoint_every=2, validate_every=3
)


class Imagining(NextBrightness):
    """Network that encodes and imagines; ``seed`` draws its initial weights."""

    samples, arguments = 1, {}
    decision = "logistic"

    def __init__(self, seed: int = 0, hidden: int = 4) -> None:
        super().__init__(settings=SIX, hidden=hidden)
        self.seed = seed
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for weight in self.net.parameters():
                weight.copy_(torch.randn(weight.shape, generator=generator) / 10)

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: Any) -> Rollout:
        last = context.features[:, -1]
        steps = torch.arange(1, self.spec.future + 1, device=last.device)[None, :, None]
        slope = self.net(context.features[:, :3, 0])[:, None]
        future = last[:, None] + steps * slope
        return Rollout(features=future[:, None].expand(-1, samples, -1, -1).contiguous())


class FailsOnDrop(Imagining):
    """Network whose training fails if it sees a trial of Drop."""

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        if any(trial.startswith("drop") for trial in batch.trials):
            raise ValueError("no drop, please")
        return super().loss(batch)


class Slow(Imagining):
    """Network that takes its time, so that a process can be killed in the middle."""

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        time.sleep(0.05)
        return super().loss(batch)


class NothingToTrain:
    """Model that only encodes, without torch."""

    spec = Imagining().spec

    def provenance(self) -> Any:
        from physion.clips.batch import Provenance

        return Provenance("nothing to train", "none")

    def digest(self) -> str:
        return "0" * 64

    def encode(self, batch: Batch) -> Any:
        assert batch.rgb is not None
        return batch.rgb.mean(axis=(2, 3)).astype("float32") / 100
