"""Baselines that look at no trial: `chance`, `outcome`, `majority-of-people`."""

from __future__ import annotations

import csv
import dataclasses
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import Batch, Motion, Provenance, Spec
from physion.core.errors import BadInputError
from physion.core.names import canonical_name
from physion.models.baselines.motion import (
    Baseline,
    motions,
    require_motion,
    settings_digest,
    touched,
)
from physion.models.interface import ModelSettings
from physion.scenes.scene import OBSERVED_FRAMES

# Baseline `chance`: the base rate of the fitted trials, whatever the trial.


@dataclass(frozen=True, kw_only=True)
class BaseRateSettings(ModelSettings):
    """`BaseRate` has no settings."""


class BaseRate(Baseline):
    """Model that gives every trial of a scenario the same probability.

    P(contact) is (k + 1) / (n + 2) with k contacts among the n fitted trials (Laplace's rule of
    succession), so that its yes or no is the more frequent outcome.
    """

    name = "chance"
    answers = "observed"

    def __init__(self, settings: BaseRateSettings) -> None:
        super().__init__(settings)
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0, context_at="end")

    def fit(self, batch: Batch, labels: NDArray[np.bool_], seed: int) -> FittedBaseRate:
        """Return the model with the base rate of the outcomes (B,); trials and seed are unused."""
        return FittedBaseRate((int(np.count_nonzero(labels)) + 1) / (len(labels) + 2))

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return dataclasses.replace(super().provenance(), inputs="base rate")


@dataclass(frozen=True, slots=True)
class FittedBaseRate:
    """`BaseRate` of some trials, in 0..1."""

    base_rate: float
    answers: str = "observed"

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return the base rate for every trial (B,)."""
        return np.full(len(batch), self.base_rate)


# Baseline `outcome`: answers with the outcome itself, as a perfect simulator would.


@dataclass(frozen=True, kw_only=True)
class OutcomeSettings(ModelSettings):
    """Settings of `Outcome`.

    - ``outcomes``: whether agent and patient touch, by name of the stimulus, for instance as the
      official files record it. Names as given by `physion.core.names.canonical_name`.
    """

    outcomes: dict[str, bool] | None = None


class Outcome(Baseline):
    """Model that answers 1 if agent and patient touch, else 0.

    The outcome is the known one of a stimulus (`OutcomeSettings`, `with_outcomes`), else the
    outcome of its whole motion. Accuracy is 1 by construction; its likeness to people is what a
    perfect simulator has. The protocol is ``full``: it sees everything. The evaluator gives it the
    outcomes of the dataset, which only a baseline may have: its predictions say something about
    outcomes and people, and nothing about a model.
    """

    name = "outcome"
    answers = "full"

    def __init__(self, settings: OutcomeSettings) -> None:
        super().__init__(settings)
        self.outcomes = read_outcomes(settings.outcomes or {})
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0)

    def with_outcomes(self, outcomes: Mapping[str, bool]) -> Outcome:
        """Return the model with more outcomes by stimulus; those that it has take precedence."""
        return Outcome(OutcomeSettings(outcomes=read_outcomes(outcomes) | self.outcomes))

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return 1 or 0 (B,) for every trial.

        Raises `BadInputError` for a trial whose outcome is not known, and whose motion is absent
        or ends with the observed part.
        """
        answers = np.zeros(len(batch))
        for row, trial in enumerate(batch.trials):
            known = self.outcomes.get(canonical_name(trial))
            answers[row] = (
                _simulated(motions(batch, self.name)[row], trial) if known is None else known
            )
        return answers

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return dataclasses.replace(super().provenance(), inputs="outcomes")

    def digest(self) -> str:
        """Return the SHA-256 of code version and known outcomes."""
        return settings_digest(self.name, self.version, self.outcomes)


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


def _simulated(motion: Motion, trial: str) -> bool:
    """Return whether agent and patient touch in a whole motion."""
    require_motion(motion, trial)
    if len(motion.trajectory) <= OBSERVED_FRAMES:
        raise BadInputError(
            f"trial {trial!r}: {Outcome.name} needs the whole motion, not its "
            f"{len(motion.trajectory)} observed frames; give its outcome or use the protocol full"
        )
    return touched(motion)


# Table of the fraction of people who answered yes, by stimulus.
#
# `physion.analysis.tables` reads the same files for the comparison with people; models cannot
# import it, because the analysis must run on tables only.

FILES = re.compile(r"human_accuracy-[a-zA-Z]+(-redyellow)?_pilot-.*\.csv$")
"""Names of the official files."""
LABELS_FILE = "stimulus_names_and_labels.csv"
"""The official file of outcomes; it may lie in these places, relative to the answers' folder."""
LABELS_PLACES = (".", "..", "../stimuli")
BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


def read_people(path: Path) -> dict[str, float]:
    """Read the fraction who answered yes, by canonical name of the stimulus.

    - A CSV file with the columns ``stimulus`` and ``p_yes``.
    - An official CSV file with the columns ``stim_ID`` and ``correct``, or a folder of such files
      called ``human_accuracy-<scenario>_pilot-*.csv``. The fraction of correct answers becomes the
      fraction of yes by the outcome, from `LABELS_FILE` in or next to the folder. Stimuli whose
      names contain ``-redyellow``, an earlier look of Dominoes, are left out as in the paper.

    Raises `BadInputError` for a path without such a table, a missing column, a value outside 0..1,
    a stimulus that occurs twice, and one without an outcome.
    """
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if FILES.match(file.name)]
        if not files:
            raise BadInputError(f"{path} holds no human_accuracy-<scenario>_pilot-*.csv")
    else:
        files = [path]
    outcomes = _read_outcomes(path if path.is_dir() else path.parent)
    people: dict[str, float] = {}
    for file in files:
        _add_file(file, outcomes, people)
    return people


def as_fraction(text: object, where: str) -> float:
    """Return a number in 0..1; raise `BadInputError` for anything else."""
    try:
        value = float(text)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        value = math.nan
    if not 0 <= value <= 1:
        raise BadInputError(f"{where}: {text!r} is not a fraction from 0 to 1")
    return value


def _add_file(file: Path, outcomes: dict[str, bool], people: dict[str, float]) -> None:
    """Add the rows of one table to ``people``."""
    official = "stim_ID" in _header(file)
    name, value = ("stim_ID", "correct") if official else ("stimulus", "p_yes")
    for line, row in _rows(file, (name, value)):
        if official and "-redyellow" in file.name + row[name]:
            continue
        stimulus, where = canonical_name(row[name]), f"{file}, line {line}"
        if stimulus in people:
            raise BadInputError(f"{where}: stimulus {stimulus!r} occurs twice")
        fraction = as_fraction(row[value], where)
        if official and stimulus not in outcomes:
            raise BadInputError(
                f"{where}: the outcome of {stimulus!r} says what correct answers were, but is not "
                f"known; put the official {LABELS_FILE} next to the folder"
            )
        people[stimulus] = 1 - fraction if official and not outcomes[stimulus] else fraction


def _read_outcomes(folder: Path) -> dict[str, bool]:
    """Return the outcomes of `LABELS_FILE` in or next to a folder, empty if there is none."""
    paths = [folder / place / LABELS_FILE for place in LABELS_PLACES]
    file = next((path for path in paths if path.is_file()), None)
    outcomes: dict[str, bool] = {}
    for line, row in [] if file is None else _rows(file, ("stim_ID", "label")):
        outcome = BOOLEANS.get(row["label"].strip().lower())
        if outcome is None:
            raise BadInputError(f"{file}, line {line}: label {row['label']!r} is not true or false")
        outcomes[canonical_name(row["stim_ID"])] = outcome
    return outcomes


def _header(file: Path) -> tuple[str, ...]:
    """Return the names of the columns of a CSV file."""
    try:
        with file.open(encoding="utf-8-sig", newline="") as lines:
            return tuple(next(csv.reader(lines), ()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadInputError(f"{file}: people's answers cannot be read: {error}") from error


def _rows(file: Path, columns: tuple[str, ...]) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line number and values of every row of a CSV file that has all ``columns``."""
    header = _header(file)
    missing = [name for name in columns if name not in header]
    if missing:
        raise BadInputError(
            f"{file} lacks the column {missing[0]!r}; people's answers have the columns stimulus "
            "and p_yes, or the official ones stim_ID and correct"
        )
    with file.open(encoding="utf-8-sig", newline="") as lines:
        try:
            for number, row in enumerate(csv.DictReader(lines), start=2):
                if any(row[name] is None for name in columns):
                    raise BadInputError(f"{file}, line {number}: fewer values than columns")
                yield number, row
        except (UnicodeDecodeError, csv.Error) as error:
            raise BadInputError(f"{file}: people's answers cannot be read: {error}") from error


# Baseline `majority-of-people`: answers a stimulus as people did.


@dataclass(frozen=True, kw_only=True)
class MajorityOfPeopleSettings(ModelSettings):
    """Settings of `MajorityOfPeople`.

    - ``humans``: people's answers: a mapping from stimulus to the fraction who answered yes, or a
      file or folder that `read_people` reads.
    """

    humans: dict[str, float] | str | None = None


class MajorityOfPeople(Baseline):
    """Model whose P(contact) is the fraction of people who answered yes.

    Its yes or no is the answer of the majority: no model that gives one answer to a stimulus can
    agree with single people more often. It answers under ``observed``, because that is what people
    saw.
    """

    name = "majority-of-people"
    answers = "observed"
    settings: MajorityOfPeopleSettings

    def __init__(self, settings: MajorityOfPeopleSettings) -> None:
        super().__init__(settings)
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=0)
        self.fractions = _fractions(settings.humans)

    def predict(self, batch: Batch) -> NDArray[np.float64]:
        """Return the fraction of people (B,) who answered yes.

        Raises `BadInputError` if people did not answer one of the stimuli.
        """
        fractions = [self.fractions.get(canonical_name(trial)) for trial in batch.trials]
        unknown = [t for t, p in zip(batch.trials, fractions, strict=True) if p is None]
        if unknown:
            given = "no answers at all" if self.settings.humans is None else "no answers of people"
            raise BadInputError(
                f"{self.name} has {given} to {len(unknown)} of "
                f"{len(batch)} stimuli, the first of them {unknown[0]!r}; "
                "give the option humans a table of the same stimuli"
            )
        return np.array(fractions, np.float64)

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return dataclasses.replace(super().provenance(), inputs="answers of people")

    def digest(self) -> str:
        """Return the SHA-256 of code version and answers."""
        return settings_digest(self.name, self.version, self.fractions)


def _fractions(humans: Mapping[str, float] | str | None) -> dict[str, float]:
    """Return the fractions of yes by canonical name from the option ``humans``."""
    if humans is None:
        return {}
    if isinstance(humans, str):
        return read_people(Path(humans))
    fractions: dict[str, float] = {}
    for stimulus, fraction in humans.items():
        name = canonical_name(stimulus)
        if name in fractions:
            raise BadInputError(
                f"{MajorityOfPeople.name}: stimulus {name!r} occurs twice in humans"
            )
        fractions[name] = as_fraction(fraction, f"{MajorityOfPeople.name}, stimulus {stimulus!r}")
    return fractions
