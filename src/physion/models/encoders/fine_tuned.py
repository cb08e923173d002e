"""Image encoder that is trained together with the dynamics, without labels.

The paper says that it also trained encoders on the squared error of the next feature, not how. That
loss alone is 0 for an encoder that gives the same features for every picture. Here

    L = |f(z_1, ..., z_c) - sg(z_c+1)|^2 / D + w |z - z0|^2 / D,

averaged over windows and frames, with

- z = E(x), the standardised features (D,) of picture x, and z0 = E0(x), those that the encoder gave
  with its initial weights; over the training clips z0 has mean 0 and variance 1;
- f: the dynamics; w = ``distillation``;
- sg: no gradient passes, so that the encoder cannot lower the first term by moving its target, as
  in BYOL (Grill et al. 2020) and SimSiam (Chen and He 2021).

A stopped gradient alone does not exclude equal features. The second term, the distillation of
learning without forgetting (Li and Hoiem 2016), does: they would cost w. Even without sg, features
s z0 of which a fraction e <= 1 of the variance cannot be predicted cost s^2 e + w (1 - s)^2, the
least at s = w / (w + e): with w = 1 no feature is below half its size there. The term also keeps
features and their predictions in one space, so that a rollout can start from encoded frames.

Batch normalisation keeps its stored statistics and dropout is off, so that a feature depends on its
picture alone, in training too.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from physion.models.batch import Batch
from physion.models.encoders.encoder_model import EncoderModel, Label
from physion.models.encoders.settings import EncoderConfig
from physion.models.interface import Diet
from physion.models.settings import TrainingSettings
from physion.models.torch_model import digest_of


class FineTunedEncoder(EncoderModel):
    """Encoder that is trained with the dynamics; its weights are saved with theirs."""

    diet: Diet = "clips"
    suffix = "fine-tuned"
    encoder_task = "L2 on latent, distillation of the initial encoder"

    def __init__(self, config: EncoderConfig, label: Label, training: TrainingSettings) -> None:
        super().__init__(config, label, training)
        self.encoder = self.initial_encoder().requires_grad_(True)
        # A tuple hides the encoder with the initial weights from torch. It is made when needed.
        self._initial: tuple[nn.Module, ...] = ()

    def network(self) -> nn.Module:
        """Return the encoder."""
        return self.encoder

    def train(self, mode: bool = True) -> FineTunedEncoder:
        """Set the dynamics to training mode; the encoder stays in evaluation mode."""
        super().train(mode)
        self.encoder.eval()
        return self

    def prepare(self, sample: Batch) -> None:
        """Set mean and scale from the initial features of training clips, one after the other."""
        clips = [self._initial_features(sample.select([row])) for row in range(len(sample))]
        self.set_scale(torch.cat(clips))

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss of the module, its two terms, and the variance of the features.

        ``variance`` is 1 for the initial weights; it falls to 0 if features become equal.
        """
        features = self.standardise(self.features_of(self.encoder, batch))
        windows, target = self.windows(features)
        prediction = functional.mse_loss(self.step(windows), target.detach())
        change = functional.mse_loss(features, self.standardise(self._initial_features(batch)))
        flat = features.detach().flatten(0, 1)
        return {
            "loss": prediction + self.config.distillation * change,
            "prediction": prediction,
            "change": change,
            "variance": flat.var(0, correction=0).mean(),
        }

    def baseline(self, batch: Batch) -> Tensor:
        """Return the loss of the initial encoder with the last feature as prediction."""
        windows, target = self.windows(self.standardise(self._initial_features(batch)))
        return functional.mse_loss(windows[:, -1], target)

    def encoder_digest(self) -> str:
        """Return the key of stored features: that of the frozen encoder, and the weights now."""
        return digest_of(super().encoder_digest(), self.encoder.state_dict().items())

    @torch.no_grad()
    def _initial_features(self, batch: Batch) -> Tensor:
        if not self._initial:
            self._initial = (self.initial_encoder(),)
        return self.features_of(self._initial[0].to(self.center.device), batch)
