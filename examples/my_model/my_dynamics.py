"""A model of your own that is trained: it imagines the next feature from the last two."""

import torch
from my_encoder import MyEncoder
from torch import Tensor, nn

from physion.models import Batch, Rollout
from physion.models.interface import TrainingSettings


class MyDynamics(MyEncoder):
    """`MyEncoder` with a linear layer that predicts how its features change."""

    learns_from = "features"  # trained on what `encode` gives; "clips" would be trained on pictures
    window = 3  # frames of a training clip
    training_settings = TrainingSettings(steps=200, batch=16, learning_rate=1e-3)

    def __init__(self, channels: int = 32) -> None:
        super().__init__(channels)
        self.change = nn.Linear(2 * 16 * channels, 16 * channels)

    def prepare(self, sample: Batch) -> None:
        """Set statistics from a sample of training clips; there are none."""

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the mean squared error of the third feature of clips (B, 3, D)."""
        first, second, third = batch.features.unbind(1)
        return {"loss": (self.following(first, second) - third).pow(2).mean()}

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Return imagined features (B, samples, future, D); all samples are equal."""
        seen = list(context.features.unbind(1))
        for _ in range(context.future):
            seen.append(self.following(*seen[-2:]))
        future = torch.stack(seen[self.spec.context :], dim=1)
        return Rollout(features=future[:, None].repeat(1, samples, 1, 1))

    def following(self, before: Tensor, last: Tensor) -> Tensor:
        return last + self.change(torch.cat([before, last], dim=1))
