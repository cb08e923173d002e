"""Frozen image encoder with dynamics on its features: pVGG, pDeIT, and any other timm network."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

from physion.models.batch import Batch
from physion.models.encoders.encoder_model import EncoderModel, Label
from physion.models.encoders.settings import EncoderConfig
from physion.models.interface import Diet
from physion.models.settings import TrainingSettings


class FrozenEncoder(EncoderModel):
    """Frozen encoder with dynamics. The encoder is no parameter and is loaded at first use."""

    diet: Diet = "features"

    def __init__(self, config: EncoderConfig, label: Label, training: TrainingSettings) -> None:
        super().__init__(config, label, training)
        # A tuple hides the encoder from torch, which would otherwise train and save it.
        self._encoder: tuple[nn.Module, ...] = ()

    def network(self) -> nn.Module:
        """Return the encoder on the device of the model."""
        if not self._encoder:
            self._encoder = (self.initial_encoder(),)
        return self._encoder[0].to(self.center.device)

    def prepare(self, sample: Batch) -> None:
        """Set mean and scale from the features of training clips."""
        self.set_scale(sample.features)

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the mean squared error of the next feature over all windows of a batch.

        The unit is the squared scale of `set_scale`.
        """
        windows, target = self.windows(self.standardise(batch.features))
        return {"loss": functional.mse_loss(self.step(windows), target)}

    def baseline(self, batch: Batch) -> Tensor:
        """Return the loss of predicting the last feature again."""
        windows, target = self.windows(self.standardise(batch.features))
        return functional.mse_loss(windows[:, -1], target)
