"""Clips of trials, and a store of the features that an encoder computes of them.

Protocols that must predict read from `ObservedClips` alone. It holds only the observed movies,
which are cut files, and not the dataset, so that it cannot reach a later frame.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
import torch
from lightning_fabric import Fabric
from numpy.typing import NDArray

from physion.atomic import write_atomic
from physion.compute.progress import Progress
from physion.errors import BadInputError, UnknownNameError
from physion.models.interface import Clip, Encodes, Model, Spec
from physion.scenes.scene import OBSERVED_FRAMES
from physion.trials.dataset import Dataset, ObservedDataset

Floats = NDArray[np.float32]

_FEATURE_VERSION = 1
"""To be increased with every change that can alter the features of a movie and encoder."""


class FutureFrameError(BadInputError):
    """Error for a request of a frame after the observed part from `ObservedClips`."""


class ClipSource(Protocol):
    """Source of clips."""

    @property
    def indices(self) -> tuple[int, ...]:
        """Movie frames of every clip."""
        ...

    def clip(self, trial: str) -> Clip:
        """Return the clip of a trial."""
        ...

    def key(self, trial: str) -> str:
        """Return the SHA-256 of the movie of a trial's clip."""
        ...


class ObservedClips:
    """Source of clips of the observed part, from the observed movies and their hashes alone."""

    def __init__(self, movies: ObservedDataset, hashes: dict[str, str], spec: Spec) -> None:
        self._movies, self._hashes, self._spec = movies, hashes, spec

    @property
    def indices(self) -> tuple[int, ...]:
        """Movie frames of the context."""
        return self._spec.observed_indices()

    def clip(self, trial: str) -> Clip:
        """Return the context frames of a trial."""
        return self.read(trial, self.indices)

    def read(self, trial: str, indices: Sequence[int]) -> Clip:
        """Return observed frames of a trial; raise `FutureFrameError` for frame 45 or later."""
        late = [index for index in indices if index >= OBSERVED_FRAMES]
        if late or min(indices, default=0) < 0:
            raise FutureFrameError(
                f"trial {trial!r}: frame {(late or [min(indices)])[0]} is not one of the "
                f"{OBSERVED_FRAMES} observed frames"
            )
        stride, count = _steps(indices)
        size = self._spec.image_size
        frames = self._movies.frames(trial, count=count, stride=stride, size=(size, size))
        return Clip(trial, frames, tuple(indices), observed=True)

    def key(self, trial: str) -> str:
        """Return the SHA-256 of the observed movie of a trial."""
        return str(_look_up(self._hashes, trial))


class FullClips:
    """Source of clips of whole movies, for the training of dynamics and the protocol *full*.

    The last frame of a movie that is shorter than a clip is repeated.
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
        """Return the whole clip of a trial."""
        spec = self._spec
        length = int(_look_up(self._lengths, trial))
        count = min(spec.total, 1 + (length - 1) // spec.stride)
        size = (spec.image_size, spec.image_size)
        frames = self._dataset.frames(trial, count=count, stride=spec.stride, size=size)
        padding = np.repeat(frames[-1:], spec.total - len(frames), axis=0)
        return Clip(trial, np.concatenate([frames, padding]), self.indices, observed=False)

    def key(self, trial: str) -> str:
        """Return the SHA-256 of the full movie of a trial."""
        return str(_look_up(self._hashes, trial))


def observed_clips(dataset: Dataset, spec: Spec) -> ObservedClips:
    """Return the source of the observed clips of a dataset, at the size and stride of ``spec``."""
    table: pd.DataFrame = dataset.index
    hashes = dict(zip(table["trial"], table["observed_movie_sha256"], strict=True))
    return ObservedClips(dataset.observed, hashes, spec)


class FeatureStore:
    """Store of the features of one encoder, as ``.npy`` files named by a hash of their inputs.

    If ``folder`` is None, nothing is stored. The encoder processes ``batch`` clips at a time.
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
        """Return features (trials, time, features) in the order of ``trials``.

        Stored features are read, others computed and stored. Raises `BadInputError` with the name
        of the trial if a feature is not finite.
        """
        known: dict[str, Floats] = {}
        missing = []
        for trial in dict.fromkeys(trials):
            stored = self._read(clips, trial)
            if stored is None:
                missing.append(trial)
            else:
                known[trial] = stored
        for start in range(0, len(missing), self._batch):
            group = missing[start : start + self._batch]
            for trial, features in zip(group, self._encode(clips, group), strict=True):
                self._write(clips, trial, features)
                known[trial] = features
            if progress is not None:
                progress("features", min(start + self._batch, len(missing)), len(missing))
        if not trials:
            return np.zeros((0, len(clips.indices), 0), np.float32)
        return np.stack([known[trial] for trial in trials])

    def _encode(self, clips: ClipSource, trials: list[str]) -> Floats:
        frames = np.stack([clips.clip(trial).frames for trial in trials])
        tensor = self._fabric.to_device(torch.from_numpy(frames))
        assert isinstance(self._model, Encodes)
        features: Floats = self._model.encode(tensor).cpu().numpy().astype(np.float32)
        for trial, values in zip(trials, features, strict=True):
            if not np.isfinite(values).all():
                raise BadInputError(
                    f"trial {trial!r}: the encoder gives features that are not finite; "
                    "check its weights"
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
    """Return stride and count of ``indices``, which must be 0, s, 2 s, ..."""
    stride = indices[1] - indices[0] if len(indices) > 1 else 1
    if stride < 1 or list(indices) != list(range(0, stride * len(indices), stride)):
        raise BadInputError(f"frames must start at 0 in equal steps, not {list(indices)}")
    return stride, len(indices)


def _look_up(values: dict[str, Any], trial: str) -> Any:
    if trial not in values:
        raise UnknownNameError("trial", trial, values)
    return values[trial]
