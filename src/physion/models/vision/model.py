"""Options and base class of the vision models that are trained from pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch

from physion.errors import BadInputError
from physion.models.batch import Batch, Provenance, Spec
from physion.models.checkpoints.trained import RANDOM
from physion.models.interface import Diet
from physion.models.settings import TrainingSettings
from physion.models.torch_model import TorchModel, digest_of

Size = Literal["small", "paper", "released"]


@dataclass(frozen=True, slots=True)
class VisionOptions:
    """What a user chooses of a vision model.

    - ``size``: ``small`` (for a CPU) or ``paper``, or ``released``, with the settings of the
      published code where they differ from the paper.
    - ``weights``: ``random``, to be trained; ``shipped``, those that come with the package; or the
      path of a ``model.safetensors`` that ``physion train`` wrote, or of its folder.
    - ``seed``: of the initial weights.
    """

    size: Size = "small"
    weights: str = RANDOM
    seed: int = 0

    def __post_init__(self) -> None:
        if self.size not in ("small", "paper", "released"):
            raise BadInputError(
                f"a vision model has the sizes small, paper and released, not {self.size!r}"
            )


class VisionModel(TorchModel):
    """Model that learns from clips, and whose features a logistic regression reads.

    Parameters
    ----------
    name
        Name of the family, such as ``cswm``; the size is added to it.
    version
        To be raised with every change of what equal weights compute, or of the training.
    config
        Dataclass with all settings of the model.
    training
        Optimiser and schedule, which are no part of the digest.
    options
        What the user chose.
    spec
        What the model asks for.
    """

    diet: Diet = "clips"
    reader = "logistic"
    samples, seed = 1, 0

    def __init__(
        self,
        name: str,
        version: int,
        config: Any,
        training: TrainingSettings,
        options: VisionOptions,
        spec: Spec,
    ) -> None:
        super().__init__()
        self.name = f"{name}-{options.size}"
        self.version, self.options, self.spec = version, options, spec
        self.settings = training
        self.trained = False
        self.knobs: Mapping[str, tuple[float, ...]] = {}
        self._config = {k: v for k, v in dataclasses.asdict(config).items() if k != "training"}

    def prepare(self, sample: Batch) -> None:
        """Do nothing: these models have no statistics to set before a training."""

    def built_as(self) -> dict[str, Any]:
        """Return what the weights were made for: name, with the size, and version."""
        return {"model": self.name, "version": self.version}

    def digest(self) -> str:
        """Return the SHA-256 of code version, settings and weights."""
        parts = [self.name, self.version, self._config, repr(self.spec), torch.__version__]
        return digest_of(parts, self.state_dict().items())

    def origin(self, encoder: str, dynamics: str, task: str) -> Provenance:
        """Return the provenance of a model with these parts, trained together on one task."""
        return Provenance(
            model=self.name,
            init=self.init,
            encoder_type=encoder,
            dynamics_type=dynamics,
            encoder_training_task=task,
            dynamics_training_task=task,
            versions=f"torch {torch.__version__}",
        )
