"""What a model is: something that sees clips, or goes on simulating scenes, and can be asked.

No model has to do everything. What it offers, it offers by having the method: `encode` (it sees),
`simulate` (it imagines what comes), `loss` (it learns), `predict_contact` (it answers by itself).
This module needs no torch, so that models that simulate scenes run without it.
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
    """What a model wants to see.

    - ``image_size``: pixels a side; clips are scaled to it.
    - ``mean``, ``std``: of the red, green and blue channel in 0..1, which the model itself takes
      away from the uint8 frames it is given.
    - ``stride``: movie frames from one clip frame to the next (6 of 30 a second: 5 a second).
    - ``context``: clip frames inside the observed part; ``total``: clip frames in all.
    - ``modalities``: what a clip must hold; so far ``rgb``, or ``state`` for simulators.

    The defaults are those of the released frozen-encoder models: movie frames 0, 6, ..., 36 of
    the 45 observed ones, and 0, 6, ..., 144 in all.
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
        """Movie frames of the context, all of them observed."""
        return tuple(range(0, self.context * self.stride, self.stride))

    def all_indices(self) -> tuple[int, ...]:
        """Movie frames of the whole clip."""
        return tuple(range(0, self.total * self.stride, self.stride))


@dataclass(frozen=True)
class Clip:
    """What a model sees of one trial.

    - ``frames`` (T, H, W, 3): uint8, sRGB, at the model's stride and size.
    - ``indices``: the movie frame of each; ``observed``: none of them lies in the future.
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
    """Where a model's numbers come from; goes into every row of its predictions.

    ``init`` says what the weights were before training here: ``imagenet``, ``local:<sha256>``,
    ``random``, or ``none`` for a model without weights. The other fields are the columns of the
    official result files.
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
    """Every model: what it wants to see, and where it comes from."""

    @property
    def spec(self) -> Spec:
        """What the model wants to see."""
        ...

    def provenance(self) -> Provenance:
        """Name, weights and versions, for the tables."""
        ...


@runtime_checkable
class Encodes(Protocol):
    """A model that sees."""

    def encode(self, frames: Tensor) -> Tensor:
        """Features of clips.

        ``frames`` (batch, time, height, width, 3): uint8, sRGB, of ``spec.image_size``.
        Returns (batch, time, features): float32. Time may be shorter for a model that sees
        several frames at once.
        """
        ...

    def encoder_digest(self) -> str:
        """Hexadecimal SHA-256 of all that decides the features: the key of their cache."""
        ...


@runtime_checkable
class Simulates(Protocol):
    """A model that imagines what comes next, in its own features."""

    def simulate(self, context: Tensor, steps: int) -> Tensor:
        """``context`` (batch, spec.context, features) goes on for (batch, steps, features)."""
        ...


@runtime_checkable
class Learns(Protocol):
    """A model whose dynamics train on clips, without any label; a torch ``Module`` as well."""

    def adapt(self, features: Tensor) -> None:
        """Look once at all training features (trials, time, features) before training starts."""
        ...

    def loss(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Scalar loss of ``batch["features"]`` (batch, time, features), float32."""
        ...


@runtime_checkable
class PredictsContact(Protocol):
    """A model that answers without a readout."""

    def predict_contact(self, scene: Any, trajectory: Any) -> float:
        """P(agent touches patient) in 0..1, from a `Scene` and its `Trajectory`.

        Nothing of the trajectory after the last observed frame may be used.
        """
        ...


ModelFactory = Callable[..., Model]
"""Called with the fields of the model's config as keywords."""

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
"""All models by name. Another package adds one by an entry point in the group physion.models."""


def build_model(name: str, **options: Any) -> Model:
    """The model called ``name``, with ``options`` in place of the defaults of its config.

    Unknown names and options get the closest ones; a model whose libraries are not installed
    raises `MissingExtraError`.
    """
    try:
        factory = models.get(name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in _EXTRA_LIBRARIES:
            raise MissingExtraError(f"model {name!r}", "models") from error
        raise
    return factory(**options)


def make_config(kind: type[C], model: str, options: Mapping[str, Any]) -> C:
    """A config of the dataclass ``kind``; an unknown option gets the three closest names."""
    known = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    for option in options:
        if option not in known:
            raise UnknownNameError(f"option of model {model}", option, known)
    return kind(**options)
