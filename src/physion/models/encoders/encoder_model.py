"""What all models with an image encoder and dynamics have: frames, rollout, name, digests.

Tensors (B clips, T frames, D features of one frame, c = ``spec.context``):

- pictures (B, T, H, W, 3): uint8, sRGB, H = W = ``image_size``.
- features (B, T, D): float32, unbounded; D is 4096 for VGG, 768 for DeiT base.
- context (B, c, D): features of the observed frames, the input of the dynamics.
- next feature (B, D): their output.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import timm
import torch
from torch import Tensor, nn

from physion.models.batch import Batch, Provenance, Rollout, Spec
from physion.models.encoders.dynamics import make_dynamics
from physion.models.encoders.settings import EncoderConfig
from physion.models.settings import TrainingSettings
from physion.models.torch_model import digest_of
from physion.models.vision.pictures import normalized_pictures
from physion.models.weights import (
    GRID,
    RANDOM,
    EncoderWeights,
    create_encoder,
    feature_size,
    input_statistics,
)

_VERSION = 2
"""To be raised with every change that alters what the dynamics compute."""


@dataclass(frozen=True, slots=True)
class Label:
    """Family and size of a model, which stand in its name; empty for any other encoder."""

    family: str = ""
    size: str = ""


class EncoderModel(nn.Module):
    """Image encoder with dynamics on its features; subclasses say how it is trained.

    Parameters
    ----------
    config
        Settings of encoder and dynamics.
    label
        Family and size.
    training
        Optimiser and schedule.
    """

    reader = "logistic"
    samples, seed = 1, 0
    suffix = ""
    """End of the names of models of this class."""
    encoder_task = ""
    """What trained the encoder after its initial weights."""

    def __init__(self, config: EncoderConfig, label: Label, training: TrainingSettings) -> None:
        super().__init__()
        self.config, self.label, self.settings = config, label, training
        self.trained = False
        self.init = ""  # of a training; by default the origin of the encoder's weights
        self._weights = EncoderWeights(config.weights, config.seed)
        mean, std = input_statistics(config.encoder, self._weights)
        self.spec = Spec(
            image_size=config.image_size,
            mean=mean,
            std=std,
            stride=config.stride,
            context=config.context,
            future=config.future,
        )
        self.window = config.context + 1
        self.knobs: Mapping[str, tuple[float, ...]] = {}
        self.feature_size = feature_size(config.encoder, config.image_size, config.pooling)
        self.dynamics = make_dynamics(
            config.dynamics,
            self.feature_size,
            context=config.context,
            hidden=config.hidden,
            residual=config.residual,
            seed=config.seed,
        )
        self.center = nn.Buffer(torch.zeros(self.feature_size))
        self.scale = nn.Buffer(torch.ones(()))

    def network(self) -> nn.Module:
        """Return the encoder on the device of the model."""
        raise NotImplementedError

    @torch.no_grad()
    def encode(self, batch: Batch) -> Tensor:
        """Return features (B, T, D) of the pictures of a batch, on their device."""
        return self.features_of(self.network(), batch)

    def features_of(self, network: nn.Module, batch: Batch) -> Tensor:
        """Return features (B, T, D) that ``network`` gives of the pictures of a batch."""
        pictures = normalized_pictures(batch, self.spec, self.name())
        features: Tensor = network(pictures.flatten(0, 1))
        return features.float().view(*pictures.shape[:2], -1)

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: float) -> Rollout:
        """Roll the dynamics out from ``context.features`` (B, c, D).

        The dynamics are deterministic: all samples are equal, and ``seed`` has no effect. Unlike
        in the released code, the features from which a rollout starts stay as they are.
        """
        window, imagined = context.features, []
        for _ in range(self.spec.future):
            following = self.step(self.standardise(window)) * self.scale + self.center
            imagined.append(following)
            window = torch.cat([window[:, 1:], following[:, None]], dim=1)
        features = torch.stack(imagined, dim=1)[:, None]
        return Rollout(features=features.expand(-1, samples, -1, -1))

    def set_scale(self, features: Tensor) -> None:
        """Store the mean (D,) and one common scale of features (B, T, D) of training clips.

        The dynamics standardise their inputs and outputs by them. A common scale keeps the
        relative weights of the features in the loss.
        """
        if not self.config.standardised:
            return
        flat = features.flatten(0, 1).double()
        self.center.copy_(flat.mean(0))
        deviation = float((flat - flat.mean(0)).pow(2).mean().sqrt())
        self.scale.fill_(deviation if deviation > 0 else 1.0)

    def standardise(self, features: Tensor) -> Tensor:
        """Return features in the unit of `set_scale`."""
        return (features - self.center) / self.scale

    def windows(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return all windows (N, c, D) of standardised features (B, T, D), and what follows."""
        count = self.config.context
        windows = features.unfold(1, count + 1, 1).transpose(2, 3).flatten(0, 1)
        return windows[:, :count], windows[:, count]

    def step(self, window: Tensor) -> Tensor:
        """Return the next feature (N, D) after standardised features (N, c, D), standardised."""
        out: Tensor = self.dynamics(window)
        return window[:, -1] + out if self.config.residual else out

    def digest(self) -> str:
        """Return the SHA-256 of the encoder, the settings and all weights."""
        settings = [_VERSION, self.encoder_digest(), dataclasses.asdict(self.config)]
        return digest_of(settings, self.state_dict().items())

    def built_as(self) -> dict[str, Any]:
        """Return what the weights were made for: name, version, settings, initial encoder."""
        return {
            "model": self.name(),
            "version": _VERSION,
            "settings": dataclasses.asdict(self.config),
            "encoder": self._weights.identity(),
        }

    def encoder_digest(self) -> str:
        """Return the key of stored features, which does not depend on the dynamics."""
        parts: list[Any] = [self.config.encoder, self.config.image_size, self._weights.identity()]
        parts += [self.spec.mean, self.spec.std, f"timm{timm.__version__}", self.config.pooling]
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def name(self) -> str:
        """Return the name for tables, such as ``pVGG-mlp-paper``.

        A model whose encoder has random weights is called ``random-<encoder>``, and one with
        another encoder or other named weights than its family has is called by its encoder.
        """
        config, label = self.config, self.label
        random = config.weights == RANDOM
        start = f"random-{config.encoder}" if random else label.family or config.encoder
        package = self._weights.package
        parts = [start, "grid" * (config.pooling == GRID), config.dynamics, label.size, self.suffix]
        pretraining = f" ({package.dataset})" if package is not None else ""
        return "-".join(part for part in parts if part) + pretraining

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        config = self.config
        task, dataset = self._weights.pretraining()
        return Provenance(
            model=self.name(),
            init=self.init or self._weights.init(),
            encoder_type=config.encoder,
            dynamics_type=config.dynamics.upper() + " residual" * config.residual,
            encoder_pretraining_task=task,
            encoder_pretraining_dataset=dataset,
            encoder_pretraining_seed=str(config.seed) if config.weights == RANDOM else "",
            encoder_training_task=self.encoder_task,
            dynamics_training_task="L2 on latent",
            versions=f"torch {torch.__version__}, timm {timm.__version__}",
        )

    def initial_encoder(self) -> nn.Module:
        """Return the encoder with its initial weights, frozen, on the device of the model."""
        config = self.config
        encoder = create_encoder(config.encoder, config.image_size, self._weights, config.pooling)
        return encoder.to(self.center.device)
