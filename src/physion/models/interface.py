"""Model interface: the specification of a model's inputs, and its optional capabilities.

A model implements one or more of the methods `encode` (features of clips), `simulate` (future
features), `loss` (training) and `predict_contact` (P(contact) without a readout). This module does
not import torch, so that simulators run without it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError, MissingExtraError, UnknownNameError
from physion.registry import Registry
from physion.scenes.scene import OBSERVED_FRAMES

if TYPE_CHECKING:
    from torch import Tensor

C = TypeVar("C")

_EXTRA_LIBRARIES = ("torch", "torchvision", "timm", "safetensors", "lightning_fabric")
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


@dataclass(frozen=True, slots=True)
class Spec:
    """Specification of the clips that a model receives.

    - ``image_size``: pixels per side; clips are scaled to it.
    - ``mean``, ``std``: of the red, green and blue channel in 0..1. The model itself normalises
      its uint8 frames with them.
    - ``stride``: movie frames between clip frames (6 at 30 frames/s: 5 clip frames/s).
    - ``context``: clip frames in the observed part; ``total``: clip frames of the whole clip.
    - ``modalities``: content of a clip: ``rgb``, or ``state`` for simulators.

    The defaults are those of the released frozen-encoder models: movie frames 0, 6, ..., 36 of
    the 45 observed ones, and 0, 6, ..., 144 of the whole movie.
    """

    image_size: int = 224
    mean: tuple[float, float, float] = IMAGENET_MEAN
    std: tuple[float, float, float] = IMAGENET_STD
    stride: int = 6
    context: int = 7
    total: int = 25
    modalities: tuple[str, ...] = ("rgb",)

    def __post_init__(self) -> None:
        if min(self.image_size, self.stride, self.context) < 1 or self.total <= self.context:
            raise BadInputError(
                f"spec: image size {self.image_size}, stride {self.stride} and context "
                f"{self.context} must be at least 1, and total {self.total} above the context"
            )
        if self.observed_indices()[-1] >= OBSERVED_FRAMES:
            raise BadInputError(
                f"spec: {self.context} context frames at stride {self.stride} end at movie frame "
                f"{self.observed_indices()[-1]}, past the {OBSERVED_FRAMES} observed frames"
            )

    def observed_indices(self) -> tuple[int, ...]:
        """Return the movie frames of the context; all are observed."""
        return tuple(range(0, self.context * self.stride, self.stride))

    def all_indices(self) -> tuple[int, ...]:
        """Return the movie frames of the whole clip."""
        return tuple(range(0, self.total * self.stride, self.stride))


@dataclass(frozen=True)
class Clip:
    """Frames of one trial, as a model receives them.

    - ``frames`` (T, H, W, 3): uint8, sRGB, at the model's stride and size.
    - ``indices`` (T,): movie frame of each. ``observed``: whether all are in the observed part.
    """

    trial: str
    frames: NDArray[np.uint8]
    indices: tuple[int, ...]
    observed: bool

    def __post_init__(self) -> None:
        if self.frames.ndim != 4 or self.frames.shape[3] != 3 or self.frames.dtype != np.uint8:
            raise BadInputError(
                f"clip of {self.trial!r}: frames must be uint8 (T, H, W, 3), "
                f"not {self.frames.dtype} {self.frames.shape}"
            )
        if len(self.frames) != len(self.indices):
            raise BadInputError(
                f"clip of {self.trial!r}: {len(self.frames)} frames for {len(self.indices)} indices"
            )
        if self.observed and self.indices and max(self.indices) >= OBSERVED_FRAMES:
            raise BadInputError(
                f"clip of {self.trial!r}: movie frame {max(self.indices)} is past the "
                f"{OBSERVED_FRAMES} observed frames"
            )


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of a model, which is written to every row of its predictions.

    ``init`` names the initial weights: ``imagenet``, ``local:<sha256>``, ``random``, or ``none``
    for a model without weights. The other fields are columns of the official result files.
    """

    model: str
    init: str
    encoder_type: str = ""
    dynamics_type: str = ""
    encoder_pretraining_task: str = ""
    encoder_pretraining_dataset: str = ""
    encoder_pretraining_seed: str = ""
    encoder_training_task: str = ""
    dynamics_training_task: str = ""
    versions: str = ""


class Model(Protocol):
    """Common interface of all models."""

    @property
    def spec(self) -> Spec:
        """Specification of the clips that the model receives."""
        ...

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        ...


@runtime_checkable
class Encodes(Protocol):
    """Model that computes features of clips."""

    def encode(self, frames: Tensor) -> Tensor:
        """Return features (batch, time, features), float32, of clips.

        ``frames`` is (batch, time, height, width, 3), uint8, sRGB, of ``spec.image_size``. The
        time of the features may be shorter for a model that combines several frames.
        """
        ...

    def encoder_digest(self) -> str:
        """Return the hexadecimal SHA-256 of all that determines the features, as cache key."""
        ...


@runtime_checkable
class Simulates(Protocol):
    """Model that predicts future features."""

    def simulate(self, context: Tensor, steps: int) -> Tensor:
        """Return (batch, steps, features) that follow ``context`` (batch, context, features)."""
        ...


@runtime_checkable
class Learns(Protocol):
    """Model with dynamics that train on features without labels; also a torch ``Module``."""

    def adapt(self, features: Tensor) -> None:
        """Set statistics from all training features (trials, time, features) before training."""
        ...

    def loss(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Return the scalar loss of ``batch["features"]`` (batch, time, features), float32."""
        ...


@runtime_checkable
class PredictsContact(Protocol):
    """Model that returns P(contact) without a readout."""

    def predict_contact(self, scene: Any, trajectory: Any) -> float:
        """Return P(agent touches patient) in 0..1, from a `Scene` and its `Trajectory`.

        Frames after the observed part must not be used.
        """
        ...


ModelFactory = Callable[..., Model]
"""Function that builds a model from the fields of its config."""

models: Registry[ModelFactory] = Registry(
    "model",
    {
        "frozen-encoder": "physion.models.frozen_encoder:frozen_encoder",
        "pVGG-mlp": "physion.models.frozen_encoder:pvgg_mlp",
        "pVGG-lstm": "physion.models.frozen_encoder:pvgg_lstm",
        "pDeIT-mlp": "physion.models.frozen_encoder:pdeit_mlp",
        "pDeIT-lstm": "physion.models.frozen_encoder:pdeit_lstm",
        "noisy-simulation": "physion.models.noisy_simulation:noisy_simulation",
    },
)
"""All models by name; other packages add theirs with the entry point group physion.models."""


def build_model(name: str, **options: Any) -> Model:
    """Build the model called ``name``; ``options`` override the defaults of its config.

    Raises `UnknownNameError` with the closest names for an unknown model or option, and
    `MissingExtraError` for a model whose libraries are not installed.
    """
    try:
        factory = models.get(name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in _EXTRA_LIBRARIES:
            raise MissingExtraError(f"model {name!r}", "models") from error
        raise
    return factory(**options)


def make_config(kind: type[C], model: str, options: Mapping[str, Any]) -> C:
    """Build a config of the dataclass ``kind``; raise `UnknownNameError` for an unknown option."""
    known = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    for option in options:
        if option not in known:
            raise UnknownNameError(f"option of model {model}", option, known)
    return kind(**options)
