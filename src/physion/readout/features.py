"""Features and imagined futures of trials: computed once, and stored in one file per trial.

A file is named by a hash of the digest of the model, asked when the file is written, and of the key
of the clip, so that features of other weights, other movies or another `Spec` are never read. The
files are a cache: one that is damaged is deleted and made again.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from physion.clips.batch import Batch
from physion.clips.source import ObservedSource, Part
from physion.compute.local import SerialExecutor
from physion.compute.tasks import Executor, Progress, tracked
from physion.core.errors import BadInputError, PhysionError
from physion.core.files import digest_of, write_atomic
from physion.models.build import OutOfMemoryError
from physion.models.interface import Model, ask
from physion.models.user_files import LoadedFiles
from physion.readout.model_calls import (
    MEMORY_ADVICE,
    check_finite,
    encoded,
    imagined,
    model_name,
    notes_of,
    to_array,
)


@dataclass(frozen=True)
class FeatureFile:
    """Safetensors file with the arrays of one trial, flattened; ``shapes`` holds their shapes."""

    path: Path
    shapes: Mapping[str, tuple[int, ...]]

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return values ``start`` to ``stop`` of the flattened array ``name``.

        The file is open for the time of the call only, since thousands of trials are read at a
        time. Raises `BadInputError` if it was deleted or cut since it was opened.
        """
        try:
            with safe_open(self.path, "numpy") as file:
                values: NDArray[Any] = file.get_slice(name)[start:stop]
                return values
        except (OSError, SafetensorError) as error:
            raise BadInputError(
                f"features {self.path} cannot be read ({error}); run again"
            ) from None

    def array(self, name: str) -> NDArray[Any]:
        """Return the array ``name``."""
        return self.read(name).reshape(self.shapes[name])


def write_features(path: Path, arrays: Mapping[str, NDArray[Any]]) -> FeatureFile:
    """Write arrays to a file such that no reader sees a part of it.

    Raises `BadInputError` if it cannot be written, for example because the disk is full.
    """
    shapes = {name: value.shape for name, value in arrays.items()}
    flat = {name: np.ascontiguousarray(value).reshape(-1) for name, value in arrays.items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, save(flat, {"shapes": json.dumps(shapes)}))
    except OSError as error:
        raise BadInputError(
            f"features cannot be stored in {path.parent} ({error.strerror}); free space there, or "
            "choose another folder"
        ) from error
    return FeatureFile(path, shapes)


def open_features(path: Path) -> FeatureFile | None:
    """Return the file at ``path``; None if there is none, or if it is damaged, and deleted."""
    if not path.is_file():
        return None
    try:
        with safe_open(path, "numpy") as file:
            shapes = json.loads(file.metadata()["shapes"])
    except (OSError, SafetensorError, ValueError, KeyError, TypeError):
        path.unlink(missing_ok=True)
        return None
    return FeatureFile(path, {name: tuple(shape) for name, shape in shapes.items()})


# Features of trials that are read from their files piece by piece.

Floats = NDArray[np.float32]

FEATURES = "features"
"""Name of the array of features."""


class FeatureRow:
    """Features (T', D) float32 of one trial, in a file of which time steps are read."""

    def __init__(self, file: FeatureFile) -> None:
        self._file = file
        self.shape = file.shapes[FEATURES]

    def __getitem__(self, steps: slice) -> Floats:
        """Return a range of time steps, with a step of 1."""
        start, stop, _ = steps.indices(self.shape[0])
        size = self.shape[1]
        values: Floats = self._file.read(FEATURES, start * size, stop * size).reshape(-1, size)
        return values


class StoredFeatures:
    """Features (n, T', D) float32 of n trials, in files of which pieces are read.

    Parameters
    ----------
    trials
        Names (n).
    rows
        For every trial the file with its features (T', D).
    repeated
        Whether trials may have different numbers of time steps. T' is then the largest, and a trial
        with fewer repeats its last one, as a movie that has ended keeps showing its last frame.

    Raises
    ------
    BadInputError
        If the shapes of two trials differ otherwise.
    """

    def __init__(
        self, trials: Sequence[str], rows: Sequence[FeatureFile], *, repeated: bool = False
    ) -> None:
        self.trials, self._repeated = tuple(trials), repeated
        self._rows = tuple(rows)
        shapes = [row.shapes[FEATURES] for row in self._rows]
        for trial, shape in zip(self.trials, shapes, strict=True):
            if shape[repeated:] != shapes[0][repeated:]:
                raise BadInputError(
                    f"features of trial {trial!r} have shape {shape}, but {self.trials[0]!r} has "
                    f"{shapes[0]}; a model must give equal shapes for all trials"
                )
        self._steps = max((shape[0] for shape in shapes), default=0)
        self._size = shapes[0][1] if shapes else 0

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

    def with_steps(self, steps: int) -> StoredFeatures:
        """Return features of ``steps`` time steps: what is longer is cut, or the last repeated."""
        changed = StoredFeatures(self.trials, self._rows, repeated=True)
        changed._steps, changed._size = steps, self._size
        return changed

    def columns(self, start: int, stop: int) -> Floats:
        """Return columns ``start`` to ``stop`` of the features flattened in time, (n, columns)."""
        stop = min(stop, self.width)
        out = np.empty((len(self._rows), max(stop - start, 0)), np.float32)
        for values, row in zip(out, self._rows, strict=True):
            known = row.shapes[FEATURES][0] * self._size
            ends = min(stop, known)
            if start < ends:
                values[: ends - start] = row.read(FEATURES, start, ends)
            if known < stop:
                last = row.read(FEATURES, known - self._size, known)
                repeated = np.arange(max(start, known), stop) % self._size
                values[max(known - start, 0) :] = last[repeated]
        return out

    def frame(self, step: int) -> Floats:
        """Return the features (n, D) of one time step."""
        return self.columns(step * self._size, (step + 1) * self._size)

    def array(self) -> Floats:
        """Return all features (n, T', D), in memory."""
        return self.columns(0, self.width).reshape(self.shape)

    def by_trial(self) -> list[FeatureRow]:
        """Return the features (T', D) of every trial, none repeated, which are read when needed."""
        return [FeatureRow(row) for row in self._rows]

    def select(self, rows: Sequence[int] | NDArray[Any]) -> StoredFeatures:
        """Return the trials with the given row numbers; their features are not read."""
        chosen = [int(row) for row in rows]
        selected = StoredFeatures(
            [self.trials[row] for row in chosen],
            [self._rows[row] for row in chosen],
            repeated=self._repeated,
        )
        # Equal for all choices, also without a trial.
        selected._steps, selected._size = self._steps, self._size
        return selected


# Features and outcomes that a model gives for a batch of clips, checked and split by trial.

GAP, CONTACT, END, CLOSEST, NOTE = "gap", "contact", "end", "closest", "note"
Arrays = Mapping[str, NDArray[Any]]
"""Arrays of one trial, by name."""


def encode_clips(model: Model, batch: Batch) -> list[Arrays]:
    """Return the features (T', D) of every clip of a batch.

    Of framewise features, at most `_FRAMES` frames of a clip are encoded at a time.
    """
    clips, steps = batch.frames.shape[:2]
    framewise, what = model.spec.framewise, "encode gave features"
    bounds = np.linspace(0, steps, (-(-steps // _FRAMES) if framewise else 1) + 1).astype(int)
    parts = []
    for start, stop in itertools.pairwise(bounds.tolist()):
        parts.append(encoded(model, batch.steps(slice(start, stop))))
    features = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
    if features.shape[1] > steps:
        raise BadInputError(
            f"model {model_name(model)!r}: encode gave features of {features.shape[1]} time "
            f"steps for clips of {steps} frames"
        )
    check_finite(features, model, what, batch.trials)
    return _split({FEATURES: features}, clips)


def imagine_clips(
    model: Model, batch: Batch, samples: int, seed: int, arguments: Mapping[str, float]
) -> list[Arrays]:
    """Return features (S * future, D), distances (S) and contact (S) of every clip, if given.

    Also a note, the bytes of a text, of clips that have one.
    """
    rollout = imagined(model, batch, samples, seed, **arguments)
    clips, future = len(batch), batch.future
    expected: dict[str, tuple[tuple[int | None, ...], tuple[str, ...]]] = {
        FEATURES: ((clips, samples, future, None), ("float32",)),
        **dict.fromkeys((GAP, END, CLOSEST), ((clips, samples), ("float64", "float32"))),
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
    for name in {GAP, END, CLOSEST} & set(arrays):
        arrays[name] = arrays[name].astype(np.float64)
    rows = _split(arrays, clips)
    return [
        {**row, NOTE: np.frombuffer(note.encode(), np.uint8)} if note else row
        for row, note in zip(rows, notes_of(model, batch), strict=True)
    ]


def _split(arrays: Mapping[str, NDArray[Any]], clips: int) -> list[Arrays]:
    """Return copies by clip: the model may use its own arrays again."""
    return [{name: value[row].copy() for name, value in arrays.items()} for row in range(clips)]


# Imagined futures of trials.

Arguments = tuple[tuple[str, float], ...]
"""Arguments of `imagine` and their values, sorted by name."""


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Imagined outcomes of n trials, S samples each.

    ``contact`` (n, S) bool where the model reports contacts, and ``gap`` (n, S) float64 in metres
    where it reports distances; 0 or less is a touch. ``end``, ``closest``: see `Rollout`.
    """

    contact: NDArray[np.bool_] | None
    gap: NDArray[np.float64] | None
    end: NDArray[np.float64] | None = None
    closest: NDArray[np.float64] | None = None

    def touches(self) -> NDArray[np.bool_]:
        """Return for every trial and sample (n, S) whether agent and patient touch."""
        if self.contact is not None:
            return self.contact
        assert self.gap is not None, "one of them is given"
        return self.gap <= 0


@dataclass(frozen=True, eq=False)
class Imagined:
    """What a model imagined of n trials with one set of arguments."""

    model: str
    rows: Mapping[str, FeatureFile]

    @property
    def trials(self) -> tuple[str, ...]:
        """Names of the trials that could be imagined."""
        return tuple(self.rows)

    def features(self) -> StoredFeatures | None:
        """Return features (n, S * future, D), one future after the other, if the model gave any."""
        if any(FEATURES not in row.shapes for row in self.rows.values()):
            return None
        return StoredFeatures(self.trials, list(self.rows.values()))

    def note(self, trial: str) -> str:
        """Return the note of the model on a trial; empty for none."""
        row = self.rows[trial]
        return row.array(NOTE).tobytes().decode() if NOTE in row.shapes else ""

    def outcomes(self, trials: Sequence[str] | None = None) -> Outcomes:
        """Return gaps and contacts of ``trials``, in order, or of all.

        Raises `BadInputError` if the model gave neither.
        """
        rows = [self.rows[trial] for trial in (self.trials if trials is None else trials)]
        if not rows:
            return Outcomes(np.zeros((0, 1), np.bool_), np.zeros((0, 1), np.float64))
        names = set.intersection(*(set(row.shapes) for row in rows))
        contact, gap, end, closest = (
            np.stack([row.array(name) for row in rows]) if name in names else None
            for name in (CONTACT, GAP, END, CLOSEST)
        )
        if gap is None and contact is None:
            raise BadInputError(f"model {self.model!r}: imagine gave neither gap nor contact")
        return Outcomes(contact, gap, end, closest)


def all_arguments(arguments: Mapping[str, Sequence[float]]) -> list[Arguments]:
    """Return every combination of the values of ``arguments``; one empty one without arguments."""
    names = sorted(arguments)
    values = [[float(value) for value in arguments[name]] for name in names]
    return [tuple(zip(names, chosen, strict=True)) for chosen in itertools.product(*values)]


_VERSION = "4"
"""To be increased with every change that can alter what is stored of a clip and model."""
IMAGINED = "imagined"
_FRAMES = 25
"""Frames of a clip that an encoder batch is counted by; of longer clips it has fewer."""


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
    """Store of what models compute of trials: features, and imagined futures.

    Parameters
    ----------
    folder
        Folder of the files.
    batch
        Clips of `_FRAMES` frames that a model receives at a time, the *encoder batch*.
    executor
        Runs models whose futures are imagined in processes.
    elsewhere
        By trial another folder, for trials whose files are shared by several stores.
    """

    def __init__(
        self,
        folder: Path,
        *,
        batch: int = 4,
        executor: Executor | None = None,
        elsewhere: Mapping[str, Path] = MappingProxyType({}),
    ) -> None:
        if batch < 1:
            raise BadInputError(f"the encoder batch must be at least 1, not {batch}")
        self._folder, self._batch, self._elsewhere = folder, batch, elsewhere
        self._executor: Executor = executor if executor is not None else SerialExecutor()
        self.problems: dict[str, str] = {}
        """Reasons of trials that could not be imagined in processes, by name."""

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
            Model that encodes; see `physion.models.interface`.
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
            return encode_clips(model, _read_clips(read, group))

        digest = ask(model, "encoder_digest")
        work = _Work("features", digest, compute, model_name(model), part)
        steps = {trial: source.steps(trial, part) for trial in dict.fromkeys(trials)}
        rows = self._rows(work, source, steps, progress)
        whole = part == "whole"
        return StoredFeatures(trials, [rows[trial] for trial in trials], repeated=whole)

    def imagined(
        self,
        model: Model,
        source: ObservedSource,
        trials: Sequence[str],
        *,
        samples: int,
        seed: int,
        arguments: Mapping[str, Sequence[float]],
        future: Mapping[str, int],
        context: StoredFeatures | None = None,
        together: int = 0,
        progress: Progress | None = None,
    ) -> dict[Arguments, Imagined]:
        """Return what the model imagines of ``trials`` with every set of arguments.

        Parameters
        ----------
        model
            Model that imagines; see `physion.models.interface`.
        source
            Source of the context.
        trials
            Names of trials.
        samples, seed, arguments
            Number of futures S, seed and settings for ``model.imagine``.
        future
            Steps that are imagined, by trial.
        context
            Features of the context of at least ``trials``, for a model that also encodes.
        together
            Trials that a process of the executor imagines at a time. With 0 this process imagines
            them, an encoder batch at a time.
        progress
            Learns how many groups of trials are done.

        Raises
        ------
        BadInputError, OutOfMemoryError
            As `encoded`. In processes, a trial that fails is left out instead; `problems` names the
            reason.
        """
        place = {trial: row for row, trial in enumerate(context.trials if context else ())}
        found: dict[Arguments, Imagined] = {}
        works: dict[Arguments, _Work] = {}
        for value in all_arguments(arguments):

            def compute(group: tuple[str, ...], value: Arguments = value) -> list[Arrays]:
                batch = _read_clips(source.context, group)
                batch = dataclasses.replace(batch, future=future[group[0]])
                if context is not None:
                    features = context.select([place[trial] for trial in group]).array()
                    batch = dataclasses.replace(batch, features=features)
                return imagine_clips(model, batch, samples, seed, dict(value))

            settings = json.dumps({"samples": samples, "seed": seed, "arguments": dict(value)})
            works[value] = _Work(
                IMAGINED, model.digest, compute, model_name(model), IMAGINED, settings
            )
        steps = {trial: future[trial] for trial in trials}
        if together:
            request = functools.partial(_Request, LoadedFiles(), model, samples, seed)
            by_value = self._rows_of_processes(works, request, source, steps, together, progress)
        else:
            by_value = {v: self._rows(w, source, steps, progress) for v, w in works.items()}
        for value, rows in by_value.items():
            kept = {trial: rows[trial] for trial in trials if trial in rows}
            found[value] = Imagined(model_name(model), kept)
        return found

    def _rows(
        self,
        work: _Work,
        source: ObservedSource,
        steps: Mapping[str, int],
        progress: Progress | None,
    ) -> dict[str, FeatureFile]:
        """Return the arrays of every trial, read where they are stored, and computed elsewhere.

        ``steps`` are the frames of its clip, or the steps to be imagined, by trial.
        """
        digest = _ask_digest(work)
        part: Any = "context" if work.part == IMAGINED else work.part
        paths = {
            trial: self._path(work, digest, source.key(trial, part), trial, count)
            for trial, count in steps.items()
        }
        rows = _stored(paths)
        missing = {trial: steps[trial] for trial in paths if trial not in rows}
        of_clips = part == work.part
        groups = _groups(
            missing,
            lambda count: (
                max(1, self._batch * _FRAMES // max(count, _FRAMES)) if of_clips else self._batch
            ),
        )
        changed = False
        try:
            for group in tracked(groups, work.what, len(groups), progress if groups else None):
                for trial, arrays in zip(group, work.compute(group), strict=True):
                    rows[trial] = write_features(paths[trial], arrays)
        finally:  # so that features of other weights are never left under this digest
            changed = bool(missing) and _ask_digest(work) != digest
            for trial in missing if changed else ():
                paths[trial].unlink(missing_ok=True)
        if changed:
            raise BadInputError(
                f"model {work.model!r}: its digest changed while it computed {work.what}; "
                "its methods must leave weights and settings as they are"
            )
        return rows

    def _rows_of_processes(
        self,
        works: Mapping[Arguments, _Work],
        request: Callable[[Arguments, Batch], _Request],
        source: ObservedSource,
        steps: Mapping[str, int],
        together: int,
        progress: Progress | None,
    ) -> dict[Arguments, dict[str, FeatureFile]]:
        """Return the arrays of every trial with all arguments, computed by the executor."""
        digest = _ask_digest(next(iter(works.values())))
        paths: dict[Arguments, dict[str, Path]] = {value: {} for value in works}
        for trial, count in steps.items():
            try:
                key = source.key(trial, "context")
            except BadInputError as error:
                self.problems[trial] = str(error)
                continue
            for value, work in works.items():
                paths[value][trial] = self._path(work, digest, key, trial, count)
        found = {value: _stored(of_value) for value, of_value in paths.items()}
        missing = {v: [t for t in paths[v] if t not in found[v]] for v in works}
        requests: dict[str, _Request] = {}
        read: dict[tuple[str, ...], list[Batch]] = {}
        for value, left in missing.items():
            for group in _groups({t: steps[t] for t in left}, lambda _: together):
                if group not in read:
                    read[group] = [
                        dataclasses.replace(context, future=steps[group[0]])
                        for context in self._contexts(source, group)
                    ]
                for context in read[group]:
                    arguments = " ".join(f"{name}={level:g}" for name, level in value)
                    name = f"{context.trials[0]} {arguments}".strip()
                    requests[name] = request(value, context)
        done, total = 0, sum(len(asked.context) for asked in requests.values())
        for outcome in self._executor.map(_imagine_request, requests):
            asked = requests[outcome.key]
            for row, trial in enumerate(asked.context.trials):
                made = outcome.error if outcome.error else outcome.value[row]
                if isinstance(made, str):
                    self.problems[trial] = made
                else:
                    found[asked.arguments][trial] = write_features(
                        paths[asked.arguments][trial], made
                    )
                done += 1
                if progress is not None:
                    progress("rollouts", done, total)
        return found

    def _contexts(self, source: ObservedSource, trials: tuple[str, ...]) -> Iterator[Batch]:
        """Yield the observed part of trials; if one has none, the others are read one by one."""
        try:
            yield source.context(trials)
        except BadInputError as error:
            if len(trials) == 1:
                self.problems[trials[0]] = str(error)
            else:
                for trial in trials:
                    yield from self._contexts(source, (trial,))

    def _path(self, work: _Work, digest: str, key: str, trial: str, steps: int) -> Path:
        """Return the file of a trial, named by all that its arrays depend on."""
        identity = [_VERSION, digest, key, trial, work.part, work.settings, steps]
        name = digest_of(json.dumps(identity))
        folder = self._elsewhere.get(trial, self._folder)
        return folder / work.part / digest[:16] / name[:2] / f"{name}.safetensors"


@dataclass(frozen=True, eq=False)
class _Request:
    """Trials with one set of arguments: what a worker process needs.

    ``files`` comes before ``model``, whose class may stand in one of them.
    """

    files: LoadedFiles
    model: Any
    samples: int
    seed: int
    arguments: Arguments
    context: Batch


def _imagine_request(request: _Request) -> list[Arrays | str]:
    """Return the arrays of every trial, or why it has none.

    If trials cannot be imagined together they are imagined one by one.
    """
    context = request.context
    try:
        arguments = dict(request.arguments)
        return [*imagine_clips(request.model, context, request.samples, request.seed, arguments)]
    except PhysionError as error:
        if len(context) == 1:
            return [" ".join(str(error).split())]
        singles = [
            dataclasses.replace(request, context=context.select([i])) for i in range(len(context))
        ]
        return [made for single in singles for made in _imagine_request(single)]


def _stored(paths: Mapping[str, Path]) -> dict[str, FeatureFile]:
    """Return what is stored, by trial."""
    opened = ((trial, open_features(path)) for trial, path in paths.items())
    return {trial: file for trial, file in opened if file is not None}


def _groups(steps: Mapping[str, int], size: Callable[[int], int]) -> list[tuple[str, ...]]:
    """Return groups of trials with equal ``steps``, each of at most ``size`` of them."""
    groups: list[tuple[str, ...]] = []
    ordered = sorted(steps, key=lambda trial: steps[trial])
    for count, same in itertools.groupby(ordered, lambda trial: steps[trial]):
        trials, most = list(same), size(count)
        groups += [tuple(trials[i : i + most]) for i in range(0, len(trials), most)]
    return groups


def _read_clips(read: Callable[[tuple[str, ...]], Batch], group: tuple[str, ...]) -> Batch:
    """Return the clips of a group of trials; `OutOfMemoryError` if memory is used up."""
    try:
        return read(group)
    except MemoryError as error:
        count = len(group)
        advice = MEMORY_ADVICE if count == 1 else f"lower the option encoder_batch, now {count}"
        raise OutOfMemoryError(
            f"reading {count} clips at a time ran out of memory; {advice}"
        ) from error


def _ask_digest(work: _Work) -> str:
    digest: object = work.digest()
    if not (isinstance(digest, str) and re.fullmatch("[0-9a-f]{64}", digest)):
        raise BadInputError(
            f"model {work.model!r}: digest gave {digest!r}, expected a SHA-256 of 64 hexadecimal "
            "digits"
        )
    return digest
