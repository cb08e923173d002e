"""Features of trials, computed by a model and stored in one file per trial.

A file is named by a hash of the digest of the model, asked when the file is written, and of the key
of the clip, so that features of other weights, other movies or another `Spec` are never read.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import mmap
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import Batch, Rollout
from physion.clips.source import ObservedSource, Part
from physion.compute.tasks import Executor, Progress, tracked
from physion.core.errors import BadInputError, PhysionError
from physion.core.files import write_atomic
from physion.models.build import LoadedFiles, OutOfMemoryError
from physion.models.interface import Model, ask
from physion.readout.model_calls import (
    MEMORY_ADVICE,
    call_model,
    check_finite,
    model_name,
    to_array,
)

# Files of features: raw arrays that can be memory-mapped, and a checksum over every byte.
#
# A file is a safetensors file: the length of the header (8 bytes, little-endian), a JSON header,
# and the arrays one after the other. The header's ``__metadata__`` holds what the features depend
# on and ``sha256``, the SHA-256 of the header without this entry and of all arrays. A reader
# writes the header anew from what it says and compares the bytes, so that no bit of a file can
# change unnoticed.

_DTYPES: dict[str, np.dtype[Any]] = {
    "F32": np.dtype("<f4"),
    "F64": np.dtype("<f8"),
    "BOOL": np.dtype("?"),
}
_NAMES = {dtype: name for name, dtype in _DTYPES.items()}
_ALIGNMENT = 64
"""The arrays start at a multiple of this many bytes."""
_LENGTH = 8
"""Bytes of the length of the header."""
_CHECKSUM = "sha256"


class _DamagedError(Exception):
    """Error for bytes that are not those of a file of features."""


class FeatureArrays(Protocol):
    """Arrays of one trial, by name, in a file or in memory."""

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Shapes of the arrays."""
        ...

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return values ``start`` to ``stop`` of the flattened array ``name``."""
        ...


@dataclass(frozen=True, eq=False)
class ArraysInMemory:
    """Arrays of one trial that are not stored."""

    arrays: Mapping[str, NDArray[Any]]

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Shapes of the arrays."""
        return {name: value.shape for name, value in self.arrays.items()}

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return values ``start`` to ``stop`` of the flattened array ``name``."""
        return self.arrays[name].reshape(-1)[start:stop]


@dataclass(frozen=True)
class FeatureFile:
    """File of features whose checksum was verified when it was opened.

    - ``shapes``, ``offsets``: of the arrays, by name; offsets in bytes from the start.
    - ``stamp``: inode, size and time of change. A file that no longer has it is not read.
    """

    path: Path
    dtypes: Mapping[str, np.dtype[Any]]
    shapes: Mapping[str, tuple[int, ...]]
    offsets: Mapping[str, int]
    stamp: tuple[int, int, int]

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return values ``start`` to ``stop`` of the flattened array ``name``.

        The file is mapped for the time of the call only: Python keeps a file descriptor for every
        map, and thousands of trials are read at a time.

        Raises
        ------
        BadInputError
            If the file was deleted or changed since it was opened.
        """
        dtype, size = self.dtypes[name], math.prod(self.shapes[name])
        stop = size if stop is None else min(stop, size)
        if stop <= start:
            return np.zeros(0, dtype)
        try:
            with _mapped(self.path) as (memory, stamp):
                if stamp == self.stamp:
                    offset = self.offsets[name] + start * dtype.itemsize
                    return np.frombuffer(memory, dtype, stop - start, offset).copy()
        except OSError as error:
            raise BadInputError(
                f"features {self.path} cannot be read ({error.strerror}); run again"
            ) from None
        raise BadInputError(f"features {self.path} changed while they were in use; run again")


def write_features(
    path: Path, identity: Mapping[str, str], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Write a file of features such that no reader sees a part of it.

    Parameters
    ----------
    path
        File to write or replace; its folder is made.
    identity
        What the features depend on: digest of the model, key of the clip, ...
    arrays
        float32, float64 or bool.

    Raises
    ------
    BadInputError
        If the file cannot be written, for example because the disk is full.
    """
    values = [
        np.ascontiguousarray(value, _DTYPES[_NAMES[value.dtype]]) for value in arrays.values()
    ]
    shapes = {
        name: (_NAMES[value.dtype], value.shape) for name, value in zip(arrays, values, strict=True)
    }
    data = b"".join(value.tobytes() for value in values)
    checksum = _checksum(_header(identity, shapes, None), data)
    head = _header(identity, shapes, checksum)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, len(head).to_bytes(_LENGTH, "little") + head + data)
    except OSError as error:
        raise BadInputError(
            f"features cannot be stored in {path.parent} ({error.strerror}); free space there, or "
            "choose another folder"
        ) from error


def open_features(path: Path, identity: Mapping[str, str]) -> FeatureFile | None:
    """Return the file at ``path`` after its checksum was verified.

    Returns None if there is no such file, if a byte of it is damaged, or if its features depend on
    something else than ``identity``: they must be computed again.
    """
    try:
        with _mapped(path) as (memory, stamp):
            return _verify(path, memory, stamp, identity)
    except (OSError, _DamagedError):
        return None


def _verify(
    path: Path, memory: mmap.mmap, stamp: tuple[int, int, int], identity: Mapping[str, str]
) -> FeatureFile:
    length = int.from_bytes(memory[:_LENGTH], "little")
    if length > len(memory) - _LENGTH:
        raise _DamagedError("header")
    head, start = memory[_LENGTH : _LENGTH + length], _LENGTH + length
    stored, shapes = _parse(head)
    checksum = stored.pop(_CHECKSUM, None)
    if stored != dict(identity) or head != _header(stored, shapes, checksum):
        raise _DamagedError("header")
    offsets = {}
    for name, (dtype, shape) in shapes.items():
        offsets[name] = start
        start += math.prod(shape) * _DTYPES[dtype].itemsize
    if start != len(memory):
        raise _DamagedError("size")
    with memoryview(memory) as view, view[_LENGTH + length :] as data:
        if _checksum(_header(stored, shapes, None), data) != checksum:
            raise _DamagedError("checksum")
    dtypes = {name: _DTYPES[dtype] for name, (dtype, _) in shapes.items()}
    return FeatureFile(path, dtypes, {n: s for n, (_, s) in shapes.items()}, offsets, stamp)


def _parse(head: bytes) -> tuple[dict[str, Any], dict[str, tuple[str, tuple[int, ...]]]]:
    """Return the metadata, and the data type and shape of every array."""
    try:
        content = json.loads(head)
        metadata = content.pop("__metadata__")
        shapes = {name: (item["dtype"], tuple(item["shape"])) for name, item in content.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise _DamagedError("header") from None
    if not isinstance(metadata, dict):
        raise _DamagedError("metadata")
    for dtype, shape in shapes.values():
        if dtype not in _DTYPES or not all(type(size) is int and size >= 0 for size in shape):
            raise _DamagedError("shape")
    return metadata, shapes


def _header(
    identity: Mapping[str, str],
    shapes: Mapping[str, tuple[str, tuple[int, ...]]],
    checksum: str | None,
) -> bytes:
    """Return the JSON header, padded with spaces so that the arrays are aligned."""
    metadata = dict(identity) if checksum is None else {**identity, _CHECKSUM: checksum}
    content: dict[str, Any] = {"__metadata__": metadata}
    start = 0
    for name, (dtype, shape) in shapes.items():
        stop = start + math.prod(shape) * _DTYPES[dtype].itemsize
        content[name] = {"dtype": dtype, "shape": list(shape), "data_offsets": [start, stop]}
        start = stop
    text = json.dumps(content, separators=(",", ":")).encode()
    return text + b" " * (-(_LENGTH + len(text)) % _ALIGNMENT)


def _checksum(head: bytes, data: bytes | memoryview) -> str:
    digest = hashlib.sha256(head)
    digest.update(data)
    return digest.hexdigest()


@contextmanager
def _mapped(path: Path) -> Iterator[tuple[mmap.mmap, tuple[int, int, int]]]:
    """Map a file into memory for reading, and tell its stamp; an empty file is an `OSError`."""
    with path.open("rb") as file:
        status = os.fstat(file.fileno())
        if status.st_size == 0:
            raise OSError(0, "empty file", str(path))
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as memory:
            yield memory, (status.st_ino, status.st_size, status.st_mtime_ns)


# Features of trials that are read from their files piece by piece.

Floats = NDArray[np.float32]

FEATURES = "features"
"""Name of the array of features."""


class StoredFeatures:
    """Features (n, T', D) float32 of n trials, in files that are memory-mapped or in memory.

    Parameters
    ----------
    trials
        Names (n).
    rows
        For every trial the file or arrays with its features (T', D).

    Raises
    ------
    BadInputError
        If the shapes of two trials differ.
    """

    def __init__(self, trials: Sequence[str], rows: Sequence[FeatureArrays]) -> None:
        self.trials = tuple(trials)
        self._rows = tuple(rows)
        shapes = [row.shapes[FEATURES] for row in self._rows]
        for trial, shape in zip(self.trials, shapes, strict=True):
            if shape != shapes[0]:
                raise BadInputError(
                    f"features of trial {trial!r} are {shape}, those of {self.trials[0]!r} "
                    f"{shapes[0]}; a model must give equal shapes for all trials"
                )
        self._steps, self._size = shapes[0] if shapes else (0, 0)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of trials, of time steps, and of features of a step."""
        return len(self._rows), self._steps, self._size

    @property
    def width(self) -> int:
        """Number of features of a trial, all time steps together."""
        return self._steps * self._size

    def columns(self, start: int, stop: int) -> Floats:
        """Return columns ``start`` to ``stop`` of the features flattened in time, (n, columns)."""
        stop = min(stop, self.width)
        out = np.empty((len(self._rows), max(stop - start, 0)), np.float32)
        for values, row in zip(out, self._rows, strict=True):
            values[:] = row.read(FEATURES, start, stop)
        return out

    def frame(self, step: int) -> Floats:
        """Return the features (n, D) of one time step."""
        return self.columns(step * self._size, (step + 1) * self._size)

    def array(self) -> Floats:
        """Return all features (n, T', D), in memory."""
        return self.columns(0, self.width).reshape(self.shape)

    def select(self, rows: Sequence[int] | NDArray[Any]) -> StoredFeatures:
        """Return the trials with the given row numbers; their features are not read."""
        chosen = [int(row) for row in rows]
        selected = StoredFeatures(
            [self.trials[row] for row in chosen], [self._rows[row] for row in chosen]
        )
        # Without a trial the shape of one is still known.
        selected._steps, selected._size = self._steps, self._size
        return selected


# Features and outcomes that a model gives for a batch of clips, checked and split by trial.

GAP, CONTACT = "gap", "contact"
Arrays = Mapping[str, NDArray[Any]]
"""Arrays of one trial, by name."""


def encode_clips(model: Model, batch: Batch) -> list[Arrays]:
    """Return the features (T', D) of every clip of a batch."""
    clips, steps = batch.frames.shape[:2]
    value = call_model(model, "encode", batch)
    expected = steps if model.spec.framewise else None
    features = to_array(value, model, "encode gave features", (clips, expected, None), ("float32",))
    if features.shape[1] > steps:
        raise BadInputError(
            f"model {model_name(model)!r}: encode gave features of {features.shape[1]} time "
            f"steps for clips of {steps} frames"
        )
    check_finite(features, model, "encode gave features", batch.trials)
    return _split({FEATURES: features}, clips)


def imagine_clips(
    model: Model, batch: Batch, samples: int, seed: int, knobs: Mapping[str, float]
) -> list[Arrays]:
    """Return features (S * future, D), gap (S) and contact (S) of every clip, if given."""
    rollout = call_model(model, "imagine", batch, samples, seed, **knobs)
    if not isinstance(rollout, Rollout):
        raise BadInputError(
            f"model {model_name(model)!r}: imagine gave {type(rollout).__name__}, expected Rollout"
        )
    clips, future = len(batch), model.spec.future
    expected: dict[str, tuple[tuple[int | None, ...], tuple[str, ...]]] = {
        FEATURES: ((clips, samples, future, None), ("float32",)),
        GAP: ((clips, samples), ("float64", "float32")),
        CONTACT: ((clips, samples), ("bool",)),
    }
    arrays: dict[str, NDArray[Any]] = {}
    for name, (shape, dtypes) in expected.items():
        value = getattr(rollout, name)
        if value is None:
            continue
        what = f"imagine gave {name}"
        arrays[name] = to_array(value, model, what, shape, dtypes)
        check_finite(arrays[name], model, what, batch.trials)
    if not arrays:
        raise BadInputError(
            f"model {model_name(model)!r}: imagine gave none of features, gap and contact"
        )
    if FEATURES in arrays:
        features = arrays[FEATURES]
        arrays[FEATURES] = features.reshape(clips, samples * future, features.shape[-1])
    if GAP in arrays:
        arrays[GAP] = arrays[GAP].astype(np.float64)
    return _split(arrays, clips)


def _split(arrays: Mapping[str, NDArray[Any]], clips: int) -> list[Arrays]:
    """Return copies by clip: the model may use its own arrays again."""
    return [{name: value[row].copy() for name, value in arrays.items()} for row in range(clips)]


# Imagined outcomes of trials, made in processes, and stored.
#
# Outcomes are small: for every trial, value of the knobs and sample, whether agent and patient
# touch or how close they come. They are kept as one JSON file for a trial and value of the knobs,
# under a digest of everything that decides them.

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
        with ``trials_together`` uses `FeatureStore.imagined` instead.
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
    if checksum != _rollouts_checksum(values) or samples not in (
        len(contact or ()),
        len(gap or ()),
    ):
        return None
    return contact, gap


def _write(path: Path | None, outcome: Cell) -> None:
    if path is None:
        return
    values = {"contact": outcome[0], "gap": outcome[1]}
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"outcomes": values, "sha256": _rollouts_checksum(values)}
    write_atomic(path, json.dumps(content).encode())


def _rollouts_checksum(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


_FEATURE_STORE_VERSION = "1"
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
            Model that encodes; see `physion.models.interface.Model`.
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
            batch = _feature_store_read(read, group)
            return encode_clips(model, batch)

        work = _Work(
            "features", lambda: ask(model, "encoder_digest")(), compute, model_name(model), part
        )
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
            Model that imagines; see `physion.models.interface.Model`.
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
            batch = _feature_store_read(source.context, group)
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


def _feature_store_read(read: Callable[[tuple[str, ...]], Batch], group: tuple[str, ...]) -> Batch:
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
        "version": _FEATURE_STORE_VERSION,
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
