"""Clips of trials, and the features that an encoder makes of them, each computed once.

Under a protocol that must predict, the only source is `ObservedClips`: it holds the observed
movies, which are cut, and not the dataset, so there is no way from it to a later frame.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
import torch
from lightning_fabric import Fabric
from numpy.typing import NDArray

from physion.atomic import write_atomic
from physion.errors import BadInputError, UnknownNameError
from physion.models.interface import Clip, Encodes, Model, Spec
from physion.scenes.scene import OBSERVED_FRAMES
from physion.trials.dataset import Dataset, ObservedDataset

Floats = NDArray[np.float32]
Progress = Callable[[str, int, int], None]
"""Called with what is being done, how many are done, and how many there are."""

_FEATURE_VERSION = 1
"""Raised whenever the same movie and encoder could give other features."""


class FutureFrameError(BadInputError):
    """A frame after the observed part was asked of a source that only shows the observed part."""


class ClipSource(Protocol):
    """Hands out clips of one part of the trials."""

    @property
    def indices(self) -> tuple[int, ...]:
        """Movie frames of every clip."""
        ...

    def clip(self, trial: str) -> Clip:
        """The clip of a trial."""
        ...

    def key(self, trial: str) -> str:
        """SHA-256 of the movie that the clip comes from."""
        ...


class ObservedClips:
    """Clips of the observed part; made from the observed movies and their hashes alone."""

    def __init__(self, movies: ObservedDataset, hashes: dict[str, str], spec: Spec) -> None:
        self._movies, self._hashes, self._spec = movies, hashes, spec

    @property
    def indices(self) -> tuple[int, ...]:
        """Movie frames of the context."""
        return self._spec.observed_indices()

    def clip(self, trial: str) -> Clip:
        """The context of a trial."""
        return self.read(trial, self.indices)

    def read(self, trial: str, indices: Sequence[int]) -> Clip:
        """Any observed frames of a trial; `FutureFrameError` for one at or after frame 45."""
        late = [index for index in indices if index >= OBSERVED_FRAMES]
        if late or min(indices, default=0) < 0:
            raise FutureFrameError(
                f"trial {trial!r}: frame {(late or [min(indices)])[0]} is not among the "
                f"{OBSERVED_FRAMES} observed frames, and nothing later can be shown here"
            )
        stride, count = _steps(indices)
        size = self._spec.image_size
        frames = self._movies.frames(trial, count=count, stride=stride, size=(size, size))
        return Clip(trial, frames, tuple(indices), observed=True)

    def key(self, trial: str) -> str:
        """SHA-256 of the observed movie."""
        return str(_look_up(self._hashes, trial))


class FullClips:
    """Clips of whole movies: to train dynamics on, and for the protocol *full*.

    A trial ends early when every body sleeps, so a clip goes on with its last frame.
    """

    def __init__(self, dataset: Dataset, spec: Spec) -> None:
        table = dataset.index
        self._dataset, self._spec = dataset, spec
        self._hashes = dict(zip(table["trial"], table["movie_sha256"], strict=True))
        self._lengths = dict(zip(table["trial"], table["frames"], strict=True))

    @property
    def indices(self) -> tuple[int, ...]:
        """Movie frames of the whole clip."""
        return self._spec.all_indices()

    def clip(self, trial: str) -> Clip:
        """The whole clip of a trial."""
        spec = self._spec
        length = int(_look_up(self._lengths, trial))
        count = min(spec.total, 1 + (length - 1) // spec.stride)
        size = (spec.image_size, spec.image_size)
        frames = self._dataset.frames(trial, count=count, stride=spec.stride, size=size)
        rest = np.repeat(frames[-1:], spec.total - len(frames), axis=0)
        return Clip(trial, np.concatenate([frames, rest]), self.indices, observed=False)

    def key(self, trial: str) -> str:
        """SHA-256 of the full movie."""
        return str(_look_up(self._hashes, trial))


def observed_clips(dataset: Dataset, spec: Spec) -> ObservedClips:
    """The observed part of a dataset at a model's size and stride."""
    table: pd.DataFrame = dataset.index
    hashes = dict(zip(table["trial"], table["observed_movie_sha256"], strict=True))
    return ObservedClips(dataset.observed, hashes, spec)


class FeatureStore:
    """Features of clips by one encoder, kept as ``.npy`` files under the hash of their content.

    ``folder`` None keeps nothing. ``batch`` clips go through the encoder at a time.
    """

    def __init__(
        self, model: Model, folder: Path | None, fabric: Fabric, *, batch: int = 4
    ) -> None:
        if not isinstance(model, Encodes):
            raise BadInputError(f"model {model.provenance().model!r} cannot encode clips")
        self._model, self._folder, self._fabric, self._batch = model, folder, fabric, batch
        self._digest = model.encoder_digest()

    def features(
        self, clips: ClipSource, trials: Sequence[str], progress: Progress | None = None
    ) -> Floats:
        """Features (trials, time, features) in the order of ``trials``; stored ones are read.

        A feature that is not finite raises `BadInputError` with the name of the trial.
        """
        found: dict[str, Floats] = {}
        missing = []
        for trial in dict.fromkeys(trials):
            stored = self._read(clips, trial)
            if stored is None:
                missing.append(trial)
            else:
                found[trial] = stored
        for start in range(0, len(missing), self._batch):
            some = missing[start : start + self._batch]
            for trial, features in zip(some, self._encode(clips, some), strict=True):
                self._write(clips, trial, features)
                found[trial] = features
            if progress is not None:
                progress("features", min(start + self._batch, len(missing)), len(missing))
        if not trials:
            return np.zeros((0, len(clips.indices), 0), np.float32)
        return np.stack([found[trial] for trial in trials])

    def _encode(self, clips: ClipSource, trials: list[str]) -> Floats:
        frames = np.stack([clips.clip(trial).frames for trial in trials])
        tensor = self._fabric.to_device(torch.from_numpy(frames))
        assert isinstance(self._model, Encodes)
        features: Floats = self._model.encode(tensor).cpu().numpy().astype(np.float32)
        for trial, values in zip(trials, features, strict=True):
            if not np.isfinite(values).all():
                raise BadInputError(
                    f"trial {trial!r}: the encoder gives features that are not finite; "
                    "are its weights damaged?"
                )
        return features

    def _path(self, clips: ClipSource, trial: str) -> Path | None:
        if self._folder is None:
            return None
        parts = (_FEATURE_VERSION, self._digest, clips.key(trial), clips.indices)
        name = hashlib.sha256(repr(parts).encode()).hexdigest()
        return self._folder / self._digest[:16] / name[:2] / f"{name}.npy"

    def _read(self, clips: ClipSource, trial: str) -> Floats | None:
        path = self._path(clips, trial)
        if path is None or not path.is_file():
            return None
        try:
            stored: Any = np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError):
            return None  # a damaged file is computed again
        usable = stored.dtype == np.float32 and stored.ndim == 2
        return stored if usable and np.isfinite(stored).all() else None

    def _write(self, clips: ClipSource, trial: str, features: Floats) -> None:
        path = self._path(clips, trial)
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        np.save(buffer, features, allow_pickle=False)
        write_atomic(path, buffer.getvalue())


def _steps(indices: Sequence[int]) -> tuple[int, int]:
    """Stride and count of ``indices``, which must be 0, s, 2 s, ..."""
    stride = indices[1] - indices[0] if len(indices) > 1 else 1
    if stride < 1 or list(indices) != list(range(0, stride * len(indices), stride)):
        raise BadInputError(f"frames must start at 0 in equal steps, not {list(indices)}")
    return stride, len(indices)


def _look_up(values: dict[str, Any], trial: str) -> Any:
    if trial not in values:
        raise UnknownNameError("trial", trial, values)
    return values[trial]
