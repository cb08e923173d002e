"""Imagined outcomes of trials, made in processes, and stored.

Outcomes are small: for every trial, value of the knobs and sample, whether agent and patient touch
or how close they come. They are kept as one JSON file for a trial and value of the knobs, under a
digest of everything that decides them.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.atomic import write_atomic
from physion.compute.executor import Executor
from physion.compute.progress import Progress
from physion.errors import BadInputError, PhysionError
from physion.models.batch import Batch
from physion.models.from_file import LoadedFiles
from physion.readout.features.model_outputs import CONTACT, GAP, Arrays, imagine_clips
from physion.training.sources.source import ObservedSource

Cell = tuple[list[bool] | None, list[float] | None]
"""Contacts and gaps of the samples of one trial."""

Knobs = tuple[tuple[str, float], ...]
"""Values of the knobs of a model, sorted by name."""

_VERSION = 1
"""To be raised with every change of the stored files."""


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Imagined outcomes of n trials, S samples each.

    ``contact`` (n, S) bool where the model reports contacts, and ``gap`` (n, S) float64 in metres
    where it reports distances; 0 or less is a touch.
    """

    contact: NDArray[np.bool_] | None
    gap: NDArray[np.float64] | None

    @property
    def samples(self) -> int:
        """Number of samples S."""
        return int(self.touches().shape[1])

    def touches(self) -> NDArray[np.bool_]:
        """Return for every trial and sample (n, S) whether agent and patient touch."""
        if self.contact is not None:
            return self.contact
        assert self.gap is not None, "checked when they were made"
        return self.gap <= 0

    def fractions(self) -> NDArray[np.float64]:
        """Return the fractions (n,) of samples with a contact."""
        return np.array([float(np.mean(row)) for row in self.touches()], np.float64)


@dataclass(frozen=True, eq=False)
class _Request:
    """Trials at one value of the knobs: what a worker process needs.

    ``files`` comes before ``model``, whose class may stand in one of them.
    """

    files: LoadedFiles
    model: Any
    context: Batch
    samples: int
    seed: int
    knobs: Knobs


class RolloutStore:
    """Maker and store of imagined outcomes.

    Parameters
    ----------
    folder
        Where outcomes are kept; None keeps nothing.
    executor
        Runs the model, some trials and one value of the knobs a task. A network that is not
        `ImaginesInProcesses` uses `FeatureStore.imagined` instead.
    """

    def __init__(self, folder: Path | None, executor: Executor) -> None:
        self._folder, self._executor = folder, executor
        self.problems: dict[str, str] = {}
        """Reasons of trials that could not be imagined, by name."""

    def outcomes(
        self,
        model: Any,
        source: ObservedSource,
        trials: Sequence[str],
        *,
        samples: int,
        seed: int,
        knobs: Mapping[str, Sequence[float]],
        together: int = 1,
        progress: Progress | None = None,
    ) -> dict[Knobs, dict[str, Cell]]:
        """Return contacts and gaps of every trial at all values of the knobs.

        The model is given ``together`` trials at a time. Trials that fail are left out; `problems`
        names the reasons.
        """
        digest = model.digest()
        found: dict[Knobs, dict[str, Any]] = {value: {} for value in all_knobs(knobs)}
        missing: dict[Knobs, dict[str, Path | None]] = {value: {} for value in found}
        for trial in dict.fromkeys(trials):
            try:
                key = source.key(trial, "context")
            except BadInputError as error:
                self.problems[trial] = str(error)
                continue
            for value in found:
                path = self._path([digest, key, trial, samples, seed, value])
                stored = _read(path, samples)
                if stored is None:
                    missing[value][trial] = path
                else:
                    found[value][trial] = stored
        total = sum(len(cells) for cells in missing.values())
        results = self._imagine(model, source, missing, samples, seed, together)
        for done, (trial, value, outcome) in enumerate(results, start=1):
            if isinstance(outcome, str):
                self.problems[trial] = outcome
            else:
                _write(missing[value][trial], outcome)
                found[value][trial] = outcome
            if progress is not None:
                progress("rollouts", done, total)
        return found

    def _imagine(
        self,
        model: Any,
        source: ObservedSource,
        missing: Mapping[Knobs, Mapping[str, Path | None]],
        samples: int,
        seed: int,
        together: int,
    ) -> Iterator[tuple[str, Knobs, Cell | str]]:
        """Yield trial, value of the knobs, and the outcomes or why there are none."""
        read: dict[tuple[str, ...], list[tuple[tuple[str, ...], Batch | str]]] = {}
        requests: dict[str, _Request] = {}
        for value, paths in missing.items():
            trials = list(paths)
            for row in range(0, len(trials), together):
                group = tuple(trials[row : row + together])
                if group not in read:
                    read[group] = list(_contexts(source, group))
                for part, context in read[group]:
                    if isinstance(context, str):
                        yield from ((trial, value, context) for trial in part)
                        continue
                    name = " ".join([part[0], *(f"{knob}={level:g}" for knob, level in value)])
                    requests[name] = _Request(LoadedFiles(), model, context, samples, seed, value)
        for outcome in self._executor.map(_run, requests):
            request = requests[outcome.key]
            for row, trial in enumerate(request.context.trials):
                made = outcome.error if outcome.error else outcome.value[row]
                yield trial, request.knobs, made

    def _path(self, parts: Sequence[Any]) -> Path | None:
        if self._folder is None:
            return None
        text = json.dumps([_VERSION, *parts])
        name = hashlib.sha256(text.encode()).hexdigest()
        return self._folder / name[:2] / f"{name}.json"


def all_knobs(knobs: Mapping[str, Sequence[float]]) -> list[Knobs]:
    """Return every combination of the values of ``knobs``; one empty one without knobs."""
    names = sorted(knobs)
    values = [[float(value) for value in knobs[name]] for name in names]
    return [tuple(zip(names, chosen, strict=True)) for chosen in itertools.product(*values)]


def stack_outcomes(
    imagined: Mapping[Knobs, Mapping[str, Any]], trials: Sequence[str]
) -> dict[Knobs, Outcomes]:
    """Return the outcomes of ``trials``, in order, for every value of the knobs."""
    stacked = {}
    shape = (len(trials), -1) if trials else (0, 1)
    for value, by_trial in imagined.items():
        contacts = [by_trial[trial][0] for trial in trials]
        gaps = [by_trial[trial][1] for trial in trials]
        stacked[value] = Outcomes(
            None
            if any(c is None for c in contacts)
            else np.array(contacts, np.bool_).reshape(shape),
            None if any(g is None for g in gaps) else np.array(gaps, np.float64).reshape(shape),
        )
    return stacked


def _contexts(
    source: ObservedSource, trials: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], Batch | str]]:
    """Yield the context of trials, or why a trial has none, with their names.

    If one trial has none the others are read one by one.
    """
    try:
        yield trials, source.context(trials)
    except BadInputError as error:
        if len(trials) == 1:
            yield trials, str(error)
        else:
            for trial in trials:
                yield from _contexts(source, (trial,))


def _run(request: _Request) -> list[Cell | str]:
    """Return contacts and gaps of every trial, or why it has none.

    If trials cannot be imagined together they are imagined one by one.
    """
    context = request.context
    try:
        arrays = imagine_clips(
            request.model, context, request.samples, request.seed, dict(request.knobs)
        )
    except PhysionError as error:
        if len(context) == 1:
            return [" ".join(str(error).split())]
        alone = [
            dataclasses.replace(request, context=context.select([i])) for i in range(len(context))
        ]
        return [cell for one in alone for cell in _run(one)]
    return [_cell(request.model, row) for row in arrays]


def _cell(model: Any, arrays: Arrays) -> Cell:
    if CONTACT not in arrays and GAP not in arrays:
        name = model.provenance().model
        raise BadInputError(f"model {name!r}: imagine gave neither gap nor contact")
    contact, gap = arrays.get(CONTACT), arrays.get(GAP)
    return (
        None if contact is None else [bool(value) for value in contact],
        None if gap is None else [float(value) for value in gap],
    )


def _read(path: Path | None, samples: int) -> Cell | None:
    """Return stored outcomes; None if there are none, or the file is damaged."""
    if path is None or not path.is_file():
        return None
    try:
        content = json.loads(path.read_bytes())
        checksum, values = content["sha256"], content["outcomes"]
        contact, gap = values["contact"], values["gap"]
    except (ValueError, KeyError, TypeError):
        return None
    if checksum != _checksum(values) or samples not in (len(contact or ()), len(gap or ())):
        return None
    return contact, gap


def _write(path: Path | None, outcome: Cell) -> None:
    if path is None:
        return
    values = {"contact": outcome[0], "gap": outcome[1]}
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"outcomes": values, "sha256": _checksum(values)}
    write_atomic(path, json.dumps(content).encode())


def _checksum(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
