"""Anchor `majority-of-people`: answers a stimulus as people did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.models.anchors.people_files import as_fraction, read_people
from physion.models.anchors.settings_digest import settings_digest
from physion.models.batch import Batch, Provenance, Spec
from physion.models.build import make_config
from physion.stimulus_names import canonical_name
from physion.version import __version__

NAME, VERSION = "majority-of-people", 1


@dataclass(frozen=True, slots=True)
class MajorityOfPeopleConfig:
    """Settings of `MajorityOfPeople`.

    - ``humans``: people's answers: a mapping from stimulus to the fraction who answered yes, or a
      file or folder that `people_files.read_people` reads.
    """

    humans: Mapping[str, float] | str | Path | None = None


class MajorityOfPeople:
    """Model whose P(contact) is the fraction of people who answered yes.

    Its yes or no is that of the majority: no model that gives one answer to a stimulus can agree
    with single people more often. It answers under ``observed``, because that is what people saw.
    """

    answers = "observed"

    def __init__(self, config: MajorityOfPeopleConfig) -> None:
        self.config = config
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0)
        self.fractions = _fractions(config.humans)

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return the fraction of people (B,) who answered yes.

        Raises `BadInputError` if people did not answer one of the stimuli.
        """
        fractions = [self.fractions.get(canonical_name(trial)) for trial in batch.trials]
        unknown = [t for t, p in zip(batch.trials, fractions, strict=True) if p is None]
        if unknown:
            given = "no answers at all" if self.config.humans is None else "no answers of people"
            raise BadInputError(
                f"{NAME} has {given} to {len(unknown)} of {len(batch)} stimuli, the first of them "
                f"{unknown[0]!r}; give the option humans a table of the same stimuli"
            )
        return np.array(fractions, np.float64)

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        versions = f"physion {__version__}"
        return Provenance(NAME, "none", versions=versions, inputs="answers of people")

    def digest(self) -> str:
        """Return the SHA-256 of code version and answers."""
        return settings_digest(NAME, VERSION, self.fractions)


def majority_of_people(**options: Any) -> MajorityOfPeople:
    """Build a model that answers a stimulus as people did.

    ``options`` are the fields of `MajorityOfPeopleConfig`.
    """
    return MajorityOfPeople(make_config(MajorityOfPeopleConfig, NAME, options))


def _fractions(humans: Mapping[str, float] | str | Path | None) -> dict[str, float]:
    """Return the fractions of yes by canonical name from the option ``humans``."""
    if humans is None:
        return {}
    if isinstance(humans, str | Path):
        return read_people(Path(humans))
    fractions: dict[str, float] = {}
    for stimulus, fraction in humans.items():
        name = canonical_name(stimulus)
        if name in fractions:
            raise BadInputError(f"{NAME}: stimulus {name!r} occurs twice in humans")
        fractions[name] = as_fraction(fraction, f"{NAME}, stimulus {stimulus!r}")
    return fractions
