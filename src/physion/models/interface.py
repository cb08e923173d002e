"""Model interface: what a model may offer, as protocols.

A model offers a capability by having its method; it needs no base class. The harness owns data,
optimiser, schedule, device and disk: it gives a torch ``Module`` tensors on its device, any other
model numpy arrays. This module does not import torch, so that simulators run without it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import Batch, Motion, Provenance, Rollout, Spec
from physion.core.errors import BadInputError

if TYPE_CHECKING:
    from torch import Tensor


# Settings of a training, which belong to the model that is trained.


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """Optimiser, schedule and length of a training.

    - ``steps``: steps of the optimiser. ``batch``: clips a step; ``accumulate``: batches whose
      gradients are averaged for a step.
    - ``optimizer``: ``adam`` or ``adamw``, with ``learning_rate``, ``betas`` and ``weight_decay``.
    - ``schedule``: of the learning rate after ``warmup`` steps of linear rise: ``constant``,
      ``cosine`` (to 0 at the last step), or ``plateau`` (times ``plateau_factor`` after
      more than ``plateau_patience`` validations in a row without improvement, as in torch).
    - ``clip``: largest norm of the gradient; 0 does not clip.
    - ``precision``: of Fabric: ``32-true``, ``16-mixed`` or ``bf16-mixed``.
    - ``validate_every``: steps between validations on held-out trials; ``held_out``: their
      fraction. ``log_every``, ``checkpoint_every``: intervals in steps.
    """

    steps: int = 1000
    batch: int = 32
    accumulate: int = 1
    optimizer: Literal["adam", "adamw"] = "adam"
    learning_rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 0.0
    schedule: Literal["constant", "cosine", "plateau"] = "constant"
    warmup: int = 0
    plateau_factor: float = 0.8
    plateau_patience: int = 3
    clip: float = 0.0
    precision: str = "32-true"
    held_out: float = 0.1
    validate_every: int = 100
    log_every: int = 10
    checkpoint_every: int = 100

    def __post_init__(self) -> None:
        counts = ("steps", "batch", "accumulate", "validate_every", "log_every", "checkpoint_every")
        for name in counts:
            value = getattr(self, name)
            if value < 1:
                raise BadInputError(f"training: {name} must be at least 1, not {value}")
        if not 0 < self.learning_rate < math.inf:
            raise BadInputError(
                f"training: learning_rate must be positive, not {self.learning_rate}"
            )
        if min(self.warmup, self.clip, self.weight_decay) < 0 or not 0 <= self.held_out < 1:
            raise BadInputError(
                "training: warmup, clip and weight_decay must not be negative, and held_out must "
                "be at least 0 and below 1"
            )
        for name, known in (
            ("optimizer", ("adam", "adamw")),
            ("schedule", ("constant", "cosine", "plateau")),
        ):
            if getattr(self, name) not in known:
                raise BadInputError(
                    f"training: {name} must be one of {', '.join(known)}, "
                    f"not {getattr(self, name)!r}"
                )


Diet = Literal["clips", "features", "states"]


@runtime_checkable
class Model(Protocol):
    """What every model has."""

    @property
    def spec(self) -> Spec:
        """What the model asks for."""
        ...

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        ...

    def digest(self) -> str:
        """Return the hexadecimal SHA-256 of code version, settings and weights as they are now."""
        ...


@runtime_checkable
class Encodes(Protocol):
    """Model that computes features of clips."""

    def encode(self, batch: Batch) -> Any:
        """Return features (B, T', D), float32, of the frames of ``batch``.

        T' is T, or less for a model that combines frames. With ``spec.framewise`` it is T, and any
        number of frames may be given.
        """
        ...


@runtime_checkable
class EncodesApart(Encodes, Protocol):
    """Model whose features do not depend on all of its weights, such as those of its dynamics."""

    def encoder_digest(self) -> str:
        """Return the hexadecimal SHA-256 of all that determines the features of `encode`."""
        ...


@runtime_checkable
class Imagines(Protocol):
    """Model that imagines the future of a clip.

    If the model also encodes, ``context.features`` holds the features of the context.
    """

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: float) -> Rollout:
        """Return ``samples`` futures of every clip.

        ``seed`` and the names of the trials determine all random numbers. ``knobs`` are the
        settings that a reader fits, such as a level of noise.
        """
        ...


@runtime_checkable
class Learns(Protocol):
    """Model that is trained without labels; also a torch ``Module``.

    - ``diet``: what it is trained on: ``clips`` (what `Spec` asks for), ``features`` (of its own
      `Encodes.encode`), or ``states`` (whole motions).
    - ``window``: frames of a training clip, at ``spec.stride``, from a random start.
    - ``settings``: optimiser and schedule.
    """

    diet: Diet
    window: int
    settings: TrainingSettings

    def prepare(self, sample: Batch) -> None:
        """Set statistics, such as the mean of the features, from a sample of training clips.

        They must be weights or buffers: a model that is loaded or resumed is not prepared again.
        """
        ...

    def loss(self, batch: Batch) -> Mapping[str, Tensor]:
        """Return the scalar ``loss`` of a batch, and parts of it to be logged."""
        ...


@runtime_checkable
class ChoosesWindows(Protocol):
    """Model that is trained on states, and on some windows of a trial more often than on others."""

    def start_probabilities(self, motion: Motion) -> NDArray[np.float64]:
        """Return how often a window starts at each frame from 0 on; the sum is 1.

        A window that starts at the last of them ends within the trial, if it is long enough.
        """
        ...


@runtime_checkable
class HasBaseline(Protocol):
    """Model that can say how well a predictor that has learnt nothing does."""

    def baseline(self, batch: Batch) -> Tensor:
        """Return the scalar loss of the trivial predictor, in the unit of `Learns.loss`."""
        ...


@runtime_checkable
class Calibrates(Protocol):
    """Model that sets some of its buffers after training, such as a threshold on its rollouts.

    ``calibration_trials``: largest number of training trials that it is given.
    """

    calibration_trials: int

    def calibrate(self, whole: Batch) -> None:
        """Set buffers from whole training trials; they are stored with the weights."""
        ...


@runtime_checkable
class Trained(Protocol):
    """Model that may come with weights that were trained before.

    ``trained``: they were, and the harness does not train it again before it predicts.
    """

    trained: bool


@runtime_checkable
class Predicts(Protocol):
    """Model that gives P(contact) itself, without a readout.

    ``answers``: protocol under which it answers: ``observed``, ``observed+simulated``, or ``full``
    for a model that is shown the outcome.
    """

    answers: str

    def predict(self, batch: Batch) -> Any:
        """Return P(agent touches patient) (B,) in 0..1 from the context of every clip."""
        ...


@runtime_checkable
class Fits(Protocol):
    """Model that is fitted on the readout trials of a scenario, in place of a readout."""

    answers: str

    def fit(self, batch: Batch, labels: NDArray[np.bool_], seed: int) -> Predicts:
        """Return a predictor fitted on clips and their outcomes (B,); the model stays as it is."""
        ...


@runtime_checkable
class SeesOutcomes(Protocol):
    """Model that is given the outcomes, to compare others with; it answers under *full*."""

    def with_outcomes(self, outcomes: Mapping[str, bool]) -> Model:
        """Return the model with the outcomes of all trials by name."""
        ...


@runtime_checkable
class HasReader(Protocol):
    """Model that names the reader which turns its rollouts or features into P(contact).

    - ``reader``: name in `physion.readout.decisions.readers`.
    - ``samples``: futures of a trial, and ``seed`` of their random numbers.
    - ``knobs``: values that the reader chooses from, by name.
    """

    reader: str
    samples: int
    seed: int
    knobs: Mapping[str, tuple[float, ...]]


@runtime_checkable
class ImaginesInProcesses(Protocol):
    """Network whose outcomes are imagined by all processes, to each of which it is pickled.

    - ``trials_together``: trials that a process imagines at a time; 0 if all are to be imagined by
      the main process, as on a GPU.
    """

    @property
    def trials_together(self) -> int: ...


def features_digest(model: Model) -> str:
    """Return the digest under which the features of a model are stored."""
    return model.encoder_digest() if isinstance(model, EncodesApart) else model.digest()
