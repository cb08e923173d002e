"""Anchor `outcome`: answers with the outcome itself, as a perfect simulator would."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.models.anchors.observed_motion import motions, require_motion, touched
from physion.models.anchors.settings_digest import settings_digest
from physion.models.batch import Batch, Motion, Provenance, Spec
from physion.models.build import make_config
from physion.scenes.scene import OBSERVED_FRAMES
from physion.stimulus_names import canonical_name
from physion.version import __version__

NAME, VERSION = "outcome", 1


@dataclass(frozen=True, slots=True)
class OutcomeConfig:
    """Settings of `Outcome`.

    - ``outcomes``: whether agent and patient touch, by name of the stimulus, for instance as the
      official files record it. Names are those of `physion.stimulus_names.canonical_name`.
    """

    outcomes: Mapping[str, bool] | None = None


class Outcome:
    """Model that answers 1 if agent and patient touch, else 0.

    The outcome is the known one of a stimulus (`OutcomeConfig`, `with_outcomes`), else that of its
    whole motion. Accuracy is 1 by construction; its likeness to people is that of a perfect
    simulator. The protocol is ``full``: it sees everything. The evaluator gives it the outcomes of
    the dataset (`physion.models.interface.SeesOutcomes`), which only an anchor may have: its
    predictions say something about outcomes and people, and nothing about a model.
    """

    answers = "full"

    def __init__(self, config: OutcomeConfig) -> None:
        self.config = config
        self.outcomes = read_outcomes(config.outcomes or {})
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0)

    def with_outcomes(self, outcomes: Mapping[str, bool]) -> Outcome:
        """Return the model with more outcomes by stimulus; those that it has take precedence."""
        return Outcome(OutcomeConfig(read_outcomes(outcomes) | self.outcomes))

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return 1 or 0 (B,) for every trial.

        Raises `BadInputError` for a trial whose outcome is not known, and whose motion is absent
        or ends with the observed part.
        """
        answers = np.zeros(len(batch))
        for row, trial in enumerate(batch.trials):
            known = self.outcomes.get(canonical_name(trial))
            answers[row] = _simulated(motions(batch, NAME)[row], trial) if known is None else known
        return answers

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        versions = f"physion {__version__}"
        return Provenance(NAME, "none", versions=versions, inputs="outcomes")

    def digest(self) -> str:
        """Return the SHA-256 of code version and known outcomes."""
        return settings_digest(NAME, VERSION, self.outcomes)


def read_outcomes(outcomes: Mapping[str, bool]) -> dict[str, bool]:
    """Return outcomes by canonical name.

    Raises `BadInputError` for a value that is not a bool, and for two values of one stimulus.
    """
    known: dict[str, bool] = {}
    for stimulus, outcome in outcomes.items():
        if not isinstance(outcome, bool | np.bool_):
            raise BadInputError(f"outcome of {stimulus!r} must be true or false, not {outcome!r}")
        name = canonical_name(stimulus)
        if known.setdefault(name, bool(outcome)) != bool(outcome):
            raise BadInputError(f"outcomes: {name!r} is there twice, with and without contact")
    return known


def outcome(**options: Any) -> Outcome:
    """Build a model that answers with the outcome itself, as a perfect simulator would.

    ``options`` are the fields of `OutcomeConfig`.
    """
    return Outcome(make_config(OutcomeConfig, NAME, options))


def _simulated(motion: Motion, trial: str) -> bool:
    """Return whether agent and patient touch in a whole motion."""
    require_motion(motion, trial)
    if len(motion.trajectory) <= OBSERVED_FRAMES:
        raise BadInputError(
            f"trial {trial!r}: {NAME} needs the whole motion, not its "
            f"{len(motion.trajectory)} observed frames; give its outcome or use the protocol full"
        )
    return touched(motion)
