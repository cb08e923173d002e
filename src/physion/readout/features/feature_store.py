"""Features of trials, computed by a model and stored in one file per trial.

A file is named by a hash of the digest of the model, asked when the file is written, and of the key
of the clip, so that features of other weights, other movies or another `Spec` are never read.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.compute.progress import Progress, tracked
from physion.errors import BadInputError
from physion.models.batch import Batch
from physion.models.interface import Model, features_digest
from physion.models.raised import OutOfMemoryError
from physion.readout.features.feature_file import (
    ArraysInMemory,
    FeatureArrays,
    open_features,
    write_features,
)
from physion.readout.features.model_outputs import CONTACT, GAP, Arrays, encode_clips, imagine_clips
from physion.readout.features.stored_features import FEATURES, StoredFeatures
from physion.readout.model_calls import MEMORY_ADVICE, model_name
from physion.readout.rollouts import Outcomes
from physion.training.sources.source import ObservedSource, Part

_VERSION = "1"
"""To be increased with every change that can alter the features of a clip and model."""
_WRITE_TRIALS, _WRITE_BYTES = 32, 2**26
"""Trials, or bytes, after which features are written. The digest is asked before each writing,
which for a large network takes as long as encoding some clips."""
IMAGINED = "imagined"


@dataclass(frozen=True)
class _Work:
    """What is computed of trials: name for progress, digest of the model, and function."""

    what: str
    digest: Callable[[], str]
    compute: Callable[[tuple[str, ...]], list[Arrays]]
    model: str
    part: str
    settings: str = ""


class FeatureStore:
    """Store of the features that models compute of trials.

    Parameters
    ----------
    folder
        Folder of the files; None keeps features in memory.
    batch
        Clips that a model receives at a time, the *encoder batch*.
    """

    def __init__(self, folder: Path | None, *, batch: int = 4) -> None:
        if batch < 1:
            raise BadInputError(f"the encoder batch must be at least 1, not {batch}")
        self._folder, self._batch = folder, batch

    def encoded(
        self,
        model: Model,
        source: ObservedSource,
        trials: Sequence[str],
        part: Part,
        progress: Progress | None = None,
    ) -> StoredFeatures:
        """Return the features that ``model.encode`` gives for a part of the clips of ``trials``.

        Parameters
        ----------
        model
            Model that encodes; see `physion.models.interface.Encodes`.
        source
            Source of the clips. Parts other than ``context`` need a `WholeSource`.
        trials
            Names, in the order of the result; a name may occur more than once.
        part
            Frames of the clip that are encoded.
        progress
            Learns how many encoder batches are done.

        Raises
        ------
        BadInputError
            If features have a wrong shape or type or are not finite, if the model raises an
            exception, or if its digest changes meanwhile.
        OutOfMemoryError
            If memory is used up; a smaller encoder batch needs less.
        """
        read = getattr(source, part, None)
        if read is None:
            raise BadInputError(f"a source of the observed part has no part {part!r} of a clip")

        def compute(group: tuple[str, ...]) -> list[Arrays]:
            batch = _read(read, group)
            return encode_clips(model, batch)

        work = _Work("features", lambda: features_digest(model), compute, model_name(model), part)
        rows = self._rows(work, source, trials, progress)
        return StoredFeatures(trials, [rows[trial] for trial in trials])

    def imagined(
        self,
        model: Model,
        source: ObservedSource,
        context: StoredFeatures | None,
        trials: Sequence[str],
        *,
        samples: int,
        seed: int,
        knobs: Mapping[str, float],
        progress: Progress | None = None,
    ) -> tuple[StoredFeatures | None, Outcomes]:
        """Return what ``model.imagine`` gives for the context of ``trials``.

        Parameters
        ----------
        model
            Model that imagines; see `physion.models.interface.Imagines`.
        source
            Source of the context.
        context
            Features of the context of at least ``trials``, for a model that also encodes.
        trials
            Names, in the order of the result.
        samples, seed, knobs
            Number of futures S, seed and settings for ``model.imagine``.
        progress
            As `encoded`.

        Returns
        -------
        tuple
            Features (n, S * future, D), the futures of a trial one after the other, or None; and
            the outcomes.

        Raises
        ------
        BadInputError, OutOfMemoryError
            As `encoded`.
        """
        place = {trial: row for row, trial in enumerate(context.trials if context else ())}

        def compute(group: tuple[str, ...]) -> list[Arrays]:
            batch = _read(source.context, group)
            if context is not None:
                features = context.select([place[trial] for trial in group]).array()
                batch = dataclasses.replace(batch, features=features)
            return imagine_clips(model, batch, samples, seed, knobs)

        values = {name: float(knobs[name]) for name in sorted(knobs)}
        settings = {"samples": samples, "seed": seed, "knobs": values}
        work = _Work(
            "imagined", model.digest, compute, model_name(model), IMAGINED, json.dumps(settings)
        )
        by_trial = self._rows(work, source, trials, progress)
        rows = [by_trial[trial] for trial in trials]
        names = set(rows[0].shapes) if rows else set()
        gap, contact = (_stack(rows, name) if name in names else None for name in (GAP, CONTACT))
        features = StoredFeatures(trials, rows) if FEATURES in names else None
        return features, Outcomes(contact, gap)

    def _rows(
        self,
        work: _Work,
        source: ObservedSource,
        trials: Sequence[str],
        progress: Progress | None,
    ) -> dict[str, FeatureArrays]:
        """Return the arrays of every trial, read where they are stored, and computed elsewhere."""
        digest = _ask_digest(work)
        part: Any = "context" if work.part == IMAGINED else work.part
        identities = {
            trial: _identity(work, digest, source.key(trial, part), trial)
            for trial in dict.fromkeys(trials)
        }
        rows: dict[str, FeatureArrays] = {}
        for trial, identity in identities.items():
            stored = self._open(identity)
            if stored is not None:
                rows[trial] = stored
        missing = [trial for trial in identities if trial not in rows]
        for computed in self._compute(work, missing, progress):
            if _ask_digest(work) != digest:
                raise BadInputError(
                    f"model {work.model!r}: its digest changed while it computed {work.what}; "
                    "its methods must leave weights and settings as they are"
                )
            for trial, arrays in computed.items():
                rows[trial] = self._write(identities[trial], arrays)
        return rows

    def _compute(
        self, work: _Work, trials: Sequence[str], progress: Progress | None
    ) -> Iterator[dict[str, Arrays]]:
        """Yield the arrays of ``trials``, as many at a time as are written together."""
        groups = [tuple(trials[i : i + self._batch]) for i in range(0, len(trials), self._batch)]
        pending: dict[str, Arrays] = {}
        for group in tracked(groups, work.what, len(groups), progress if groups else None):
            pending |= zip(group, work.compute(group), strict=True)
            size = sum(value.nbytes for arrays in pending.values() for value in arrays.values())
            if len(pending) >= _WRITE_TRIALS or size >= _WRITE_BYTES:
                yield pending
                pending = {}
        if pending:
            yield pending

    def _path(self, identity: Mapping[str, str]) -> Path | None:
        if self._folder is None:
            return None
        name = hashlib.sha256(json.dumps(identity).encode()).hexdigest()
        folder = self._folder / identity["part"] / identity["digest"][:16]
        return folder / name[:2] / f"{name}.safetensors"

    def _open(self, identity: Mapping[str, str]) -> FeatureArrays | None:
        path = self._path(identity)
        return None if path is None else open_features(path, identity)

    def _write(self, identity: Mapping[str, str], arrays: Arrays) -> FeatureArrays:
        path = self._path(identity)
        if path is None:
            return ArraysInMemory(arrays)
        write_features(path, identity, arrays)
        stored = open_features(path, identity)
        if stored is None:
            raise BadInputError(f"features {path} differ from what was written; check the disk")
        return stored


def _read(read: Callable[[tuple[str, ...]], Batch], group: tuple[str, ...]) -> Batch:
    """Return the clips of a group of trials; `OutOfMemoryError` if memory is used up."""
    try:
        return read(group)
    except MemoryError as error:
        count = len(group)
        advice = MEMORY_ADVICE if count == 1 else f"lower --encoder-batch, now {count}"
        raise OutOfMemoryError(
            f"reading {count} clips at a time ran out of memory; {advice}"
        ) from error


def _identity(work: _Work, digest: str, key: str, trial: str) -> dict[str, str]:
    """Return all that the arrays of a trial depend on."""
    return {
        "version": _VERSION,
        "digest": digest,
        "key": key,
        "trial": trial,
        "part": work.part,
        "settings": work.settings,
    }


def _ask_digest(work: _Work) -> str:
    digest: object = work.digest()
    if not (isinstance(digest, str) and re.fullmatch("[0-9a-f]{64}", digest)):
        raise BadInputError(
            f"model {work.model!r}: digest gave {digest!r}, expected a SHA-256 of 64 hexadecimal "
            "digits"
        )
    return digest


def _stack(rows: Sequence[FeatureArrays], name: str) -> NDArray[Any]:
    """Return one array of all trials."""
    return np.stack([row.read(name).reshape(row.shapes[name]) for row in rows])
