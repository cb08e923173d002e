"""What a model is: the base class `Model`, and the two questions that may be asked of any model.

A model offers a capability by having its method. The base class documents all of them and holds
the defaults of the optional ones; a class that is not derived from it works as well. Whoever uses
models therefore asks with `can` and `ask`, never with ``isinstance``:

- ``can(model, "encode")``: has the model this method itself?
- ``ask(model, "samples")``: its attribute or method, or the default of the base class.

The harness owns data, optimiser, schedule, device and disk: it gives a torch ``Module`` tensors on
its device, any other model numpy arrays. This module does not import torch, so that simulators run
without it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal

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


# Settings of a model: all that a user can set.


@dataclass(frozen=True, kw_only=True)
class ModelSettings:
    """Base of the settings of the models of this package; their fields are the options.

    A model of one's own may have any dataclass as its settings, or plain arguments
    (`physion.models.build`).

    - ``model``: name under which the model is built; no option.
    """

    model: str = ""

    @classmethod
    def defaults(cls, model: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the defaults of a model by its name, where they differ from the fields' own.

        ``options`` are what the user gave, such as the size.
        """
        return {}


Sizes = Mapping[str, Mapping[str, Any]]
"""By size, the settings that differ from the defaults of the fields."""


def settings_of_size(model: str, sizes: Sizes, size: str) -> Mapping[str, Any]:
    """Return the settings of a size; raise `BadInputError` if the model has no such size."""
    if size not in sizes:
        raise BadInputError(f"model {model} has the sizes {', '.join(sizes)}, not {size!r}")
    return sizes[size]


RANDOM, SHIPPED = "random", "shipped"
"""Weights that are not the path of a file: initial ones, to be trained, and weights of the
package."""


@dataclass(frozen=True, kw_only=True)
class SizedSettings(ModelSettings):
    """Settings of a model that exists in several sizes, and whose weights may be shipped.

    - ``size``: sets the defaults of the other options: ``small`` (for a CPU), ``paper``, or for
      some models ``released``, with the settings of the published code where they differ.
    - ``weights``: ``shipped``, those that come with the package, the default where there are some;
      ``random``, to be trained; or the path of a ``model.safetensors`` that ``physion train``
      wrote, or of its folder.
    - ``seed``: of the initial weights, and of imagined futures.
    """

    size: str = "small"
    weights: str = SHIPPED
    seed: int = 0

    sizes: ClassVar[Sizes] = MappingProxyType({"small": {}})
    any_weights: ClassVar[frozenset[str]] = frozenset({"model", "weights", "seed", "samples"})
    """Settings that do not change what weights are for."""

    @classmethod
    def defaults(cls, model: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the settings of a size; weights are shipped for the small one."""
        size = options.get("size", "small")
        weights = SHIPPED if size == "small" else RANDOM
        return {"weights": weights, **settings_of_size(model, cls.sizes, size)}

    def check_shipped(self) -> None:
        """Raise `BadInputError` if shipped weights are wanted that are for other settings."""
        if self.weights != SHIPPED or self.size != "small":
            return
        own = type(self)(**{"model": self.model, **self.defaults(self.model, {})})
        for part in fields(self):
            value, expected = getattr(self, part.name), getattr(own, part.name)
            if part.name not in self.any_weights and value != expected:
                raise BadInputError(
                    f"the shipped weights of {self.model} are for {part.name}={expected}, not "
                    f"{value}; leave it out, or give weights=random and train the model"
                )

    def at_least(self, least: int, *names: str) -> None:
        """Raise `BadInputError` for a setting that is below ``least``."""
        for name in names:
            if getattr(self, name) < least:
                value = getattr(self, name)
                raise BadInputError(f"{self.model}: {name} must be at least {least}, not {value}")


LearnsFrom = Literal["clips", "features", "states"]


class Model:
    """Base class of models; each defines ``spec``, `provenance`, `digest` and some of five methods.

    The five are `encode` (features of clips), `imagine` (futures), `predict` (P(contact)), `fit`
    (a predictor, fitted on labelled trials) and `loss` (training of a torch ``Module``, without
    labels unless it ``learns_outcomes``). All other attributes and methods are optional.

    Attributes
    ----------
    spec
        What the model asks for.
    settings
        All that a user can set, a dataclass; None for a model without options.
    samples, seed
        Futures of a trial, and the seed of their random numbers; None: the seed of the evaluation.
    arguments
        Values among which the decision chooses, by the name of an argument of `imagine`, such as a
        level of noise.
    answers
        The readout whose row the model makes by `predict` or `fit`: ``observed``,
        ``observed+simulated``, or ``full`` if it is shown the outcome. A model with `encode` sets
        ``full`` if its features always include the outcome, so that they are no other row.
    benchmark
        Rules by which its features were made (`physion.readout.benchmark`); empty: any.
    tokens
        Tokens in the features of a time step, D / tokens numbers each, one after the other, for the
        decision *attentive*.
    trained
        Whether the weights are pretrained, so that training is skipped.
    learns_from
        What a model with a `loss` is trained on: ``clips`` (what `Spec` asks for), ``features`` (of
        its own `encode`), or ``states`` (whole motions).
    learns_outcomes
        Whether the model is trained on the context of trials with their outcomes
        (``Batch.contact``), and not on windows without labels.
    window
        Frames of a training clip, at ``spec.stride``, from a random start; 0: context and future
        of the `Spec`, or twice the context where the future depends on the movie.
    training_settings
        Optimiser and schedule of its training.
    calibration_trials
        Largest number of training trials that `calibrate` is given.
    look
        Colours that trials must have, ``redyellow`` or ``free``; empty: any. Where it is set, an
        evaluation warns of movies of another rate, size or shape.
    """

    spec: Spec
    settings: Any = None
    samples: int = 1
    seed: int | None = None
    arguments: Mapping[str, tuple[float, ...]] = MappingProxyType({})
    answers: str = ""
    benchmark: str = ""
    tokens: int = 1
    trained: bool = False
    learns_from: LearnsFrom = "clips"
    learns_outcomes: bool = False
    window: int = 0
    training_settings: TrainingSettings = TrainingSettings()
    calibration_trials: int = 0
    look: str = ""

    def provenance(self) -> Provenance:
        """Return name, weights and versions for the table of predictions."""
        raise NotImplementedError

    def digest(self) -> str:
        """Return the hexadecimal SHA-256 of code version, settings and weights as they are now."""
        raise NotImplementedError

    # The capabilities: a model has at least one of them.

    def encode(self, batch: Batch) -> Any:
        """Return features (B, T', D), float32, of the frames of ``batch``.

        T' is T, or less for a model that combines frames. With ``spec.framewise`` it is T, and any
        number of frames may be given.
        """
        raise NotImplementedError

    def imagine(self, context: Batch, samples: int, seed: int, **arguments: float) -> Rollout:
        """Return ``samples`` futures of every clip, of ``context.future`` steps.

        ``seed`` and the names of the trials determine all random numbers. ``arguments`` are
        values that a decision fits. If the model encodes, ``context.features`` holds the
        features of the context.
        """
        raise NotImplementedError

    def predict(self, batch: Batch) -> Any:
        """Return P(agent touches patient) (B,) in 0..1 from the context of every clip."""
        raise NotImplementedError

    def fit(self, batch: Batch, labels: NDArray[np.bool_], seed: int) -> Any:
        """Return an object with `predict`, fitted on clips and their outcomes (B,).

        It takes the place of a decision; the model stays as it is.
        """
        raise NotImplementedError

    def loss(self, batch: Batch) -> Mapping[str, Tensor]:
        """Return the scalar ``loss`` of a batch, and parts of it to be logged."""
        raise NotImplementedError

    def surprise(self, batch: Batch) -> Any:
        """Return how little the model expected each frame of whole clips from those before (B, T).

        Without this method `physion.readout.surprise` compares what the model encodes with what it
        imagined, or takes its loss.
        """
        raise NotImplementedError

    # What else a model may say.

    @property
    def decision(self) -> str:
        """Name in `physion.readout.decisions` of what turns features or rollouts into P(contact).

        Empty: ``logistic`` for a model that encodes, ``gap`` for others.
        """
        return ""

    @property
    def trials_together(self) -> int:
        """Trials that a process imagines at a time, of a network that is sent to all processes.

        0: the main process imagines all, as on a GPU. Models that are not networks always imagine
        in all processes.
        """
        return 0

    def prepare(self, sample: Batch) -> None:
        """Set statistics, such as the mean of the features, from a sample of training clips.

        They must be weights or buffers: a model that is loaded or resumed is not prepared again.
        """

    def notes(self, batch: Batch) -> Sequence[str]:
        """Return what a user must know of the prediction for each clip, such as what is not seen.

        It is called after `predict` or `imagine` with the same clips, and stands in the column
        ``note`` of predictions; "" for nothing.
        """
        return [""] * len(batch)

    def baseline(self, batch: Batch) -> Tensor:
        """Return the scalar loss of a trivial predictor, in the unit of `loss`."""
        raise NotImplementedError

    def calibrate(self, whole: Batch) -> None:
        """Set buffers, such as a threshold on rollouts, from whole training trials.

        It is called after the training; the buffers are stored with the weights.
        """

    def start_probabilities(self, motion: Motion) -> NDArray[np.float64]:
        """Return how often a training window starts at each frame from 0 on; the sum is 1.

        A window that starts at the last of them ends within the trial, if it is long enough.
        Without this method all windows are equally frequent.
        """
        raise NotImplementedError

    def encoder_digest(self) -> str:
        """Return the hexadecimal SHA-256 of all that determines the features of `encode`.

        It differs from `digest` where some weights, such as the dynamics, do not matter.
        """
        return self.digest()

    def readout_digest(self) -> str:
        """Return the hexadecimal SHA-256 of all that determines features, for readouts that ship.

        Unlike `digest` and `encoder_digest` it has no versions of libraries, under which features
        differ by rounding only. Imagined features must follow from it too, if readouts of them
        ship.
        """
        return self.digest()

    def check_trials(self, needed: Collection[str], known: Collection[str]) -> None:
        """Raise `BadInputError` if a model knows trials by name, and does not know these.

        ``needed``: by name of the trials that are tested or fit a readout the last frame that may
        be seen; ``known``: names of all trials of the dataset.
        """

    def built_as(self) -> dict[str, Any]:
        """Return JSON values that weights belong to, such as name and version of the model.

        They are stored with the weights of a training and compared when these are loaded.
        """
        return {}


def can(model: object, method: str) -> bool:
    """Return whether a model has a method itself, not only the default of `Model`."""
    found = getattr(model, method, None)
    return callable(found) and getattr(found, "__func__", found) is not getattr(Model, method)


def ask(model: object, name: str) -> Any:
    """Return an optional attribute or method of a model, or the default that `Model` has."""
    if hasattr(model, name):
        return getattr(model, name)
    default = getattr(Model, name)
    return default.__get__(model) if hasattr(default, "__get__") else default
