"""An encoder of your own: features of single pictures, which a readout turns into P(contact)."""

import torch
from torch import Tensor, nn

from physion.models import Batch, Spec
from physion.models.torch_model import TorchModel


class MyEncoder(TorchModel):
    """Random convolutions on pictures of 64 x 64 pixels; put your own network here."""

    spec = Spec(image_size=64)  # every sixth frame: 8 observed ones, and the later ones for *full*
    init = "random"  # where the weights come from, for the table of predictions

    def __init__(self, channels: int = 32) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.network = nn.Sequential(
            nn.Conv2d(3, channels, 5, stride=2),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 5, stride=2),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d(4),
            nn.Flatten(),
        )

    def encode(self, batch: Batch) -> Tensor:
        """Return features (B, T, D) of the pictures (B, T, 64, 64, 3) of a batch."""
        pictures = batch.rgb.flatten(0, 1).permute(0, 3, 1, 2).float() / 255
        mean, std = (pictures.new_tensor(v).view(3, 1, 1) for v in (self.spec.mean, self.spec.std))
        return self.network((pictures - mean) / std).unflatten(0, batch.rgb.shape[:2])
