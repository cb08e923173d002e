"""Sources of batches: what is read of trials, put together from readers of single clips.

Code under a predicting protocol gets an `ObservedSource`, which cannot reach a frame after the
observed part: it opens the observed movies, and motions that were cut when they were read.
`WholeSource` reads whole trials, for training and for the protocol *full*.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import LAST_OBSERVED, Batch, Motion, Spec, clip_frames
from physion.clips.states import digest_in
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import digest_of

Part = Literal["context", "whole"]
"""Part of a clip: its context, or all its frames."""


class FutureFrameError(BadInputError):
    """Error for a request of a frame after the observed part from an `ObservedSource`."""


_VERSION = 2
"""To be increased with every change that can alter what a source gives for equal files."""


class ClipReader(Protocol):
    """Reader of some arrays of a clip."""

    def read(self, trial: str, frames: NDArray[np.int64]) -> Mapping[str, NDArray[Any]]:
        """Return arrays of `Batch` by name, without the axis B, of ``frames``, which increase."""
        ...

    def identity(self, trial: str) -> str:
        """Return text that differs if the arrays of any frames of the trial may differ."""
        ...


class TrialReaders:
    """What is read of trials: their lengths in frames, arrays of clips, and motions.

    Parameters
    ----------
    lengths
        Number of frames by trial.
    readers
        Readers of the arrays that the `Spec` asks for.
    state
        Motions by trial, or None if the `Spec` does not ask for them.
    """

    def __init__(
        self,
        lengths: Mapping[str, int],
        readers: Sequence[ClipReader],
        state: Mapping[str, Motion] | None = None,
    ) -> None:
        self._lengths, self._readers, self._state = lengths, tuple(readers), state

    @property
    def trials(self) -> tuple[str, ...]:
        """Names of all trials."""
        return tuple(self._lengths)

    def length(self, trial: str) -> int:
        """Return the number of frames of a trial; `UnknownNameError` for an unknown one."""
        if trial not in self._lengths:
            raise UnknownNameError("trial", trial, self._lengths)
        return self._lengths[trial]

    def batch(self, trials: Sequence[str], frames: Sequence[Sequence[int]]) -> Batch:
        """Return the clips of ``trials`` that show these frames (B, T)."""
        if not trials:
            raise BadInputError("a batch needs at least one trial")
        shown, valid, clips = [], [], []
        for trial, wanted in zip(trials, frames, strict=True):
            indices, exist = clip_frames(wanted, self.length(trial))
            shown.append(indices)
            valid.append(exist)
            clips.append(self._clip(trial, indices))
        state = None if self._state is None else tuple(self._state[trial] for trial in trials)
        arrays: dict[str, Any] = {
            name: np.stack([clip[name] for clip in clips]) for name in clips[0]
        }
        return Batch(tuple(trials), np.stack(shown), np.stack(valid), state=state, **arrays)

    def _clip(self, trial: str, frames: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        return {
            name: values
            for reader in self._readers
            for name, values in reader.read(trial, frames).items()
        }

    def identity(self, trial: str) -> list[str]:
        """Return texts that differ if anything that is read of the trial may differ."""
        self.length(trial)
        texts = [reader.identity(trial) for reader in self._readers]
        if self._state is not None:
            texts.append(f"state {digest_in(self._state, trial)}")
        return texts


class ObservedSource:
    """Source of the observed part of trials, which are read by ``readers``.

    ``last``: by trial the last frame that may be seen, where it is an earlier one than
    `LAST_OBSERVED`. Motions are not cut there.
    """

    def __init__(
        self, spec: Spec, readers: TrialReaders, last: Mapping[str, int] = MappingProxyType({})
    ) -> None:
        self._spec, self._readers, self._last = spec, readers, last

    @property
    def spec(self) -> Spec:
        """What the batches hold."""
        return self._spec

    @property
    def trials(self) -> tuple[str, ...]:
        """Names of all trials."""
        return self._readers.trials

    def context(self, trials: Sequence[str]) -> Batch:
        """Return the context of clips; motions end with the last observed frame.

        The batch has the ``future`` of the spec, or 0 where it depends on the movies.
        """
        frames = [self._context(trial) for trial in trials]
        latest = max((max(each) for each in frames), default=0)
        if latest > LAST_OBSERVED:
            raise FutureFrameError(
                f"frame {latest} comes after the observed part, whose last frame is {LAST_OBSERVED}"
            )
        batch = self._readers.batch(trials, frames)
        return dataclasses.replace(batch, future=self._spec.future or 0)

    def _context(self, trial: str) -> tuple[int, ...]:
        """Return the frames of the context of a trial."""
        if trial not in self._last:
            return self._spec.context_frames()
        return self._spec.context_frames(min(self._last[trial], LAST_OBSERVED))

    def steps(self, trial: str, part: Part) -> int:
        """Return the number of frames of a part of a trial's clip."""
        return self._spec.context

    def key(self, trial: str, part: Part) -> str:
        """Return the hexadecimal SHA-256 of all that determines the context of a trial."""
        if part != "context":
            raise FutureFrameError(
                f"trial {trial!r}: a source of the observed part has no part {part!r} of a clip"
            )
        return clip_key(self._spec, self._context(trial), self._readers.identity(trial))


class WholeSource(ObservedSource):
    """Source of whole trials, which are read by ``readers``; the context comes from ``observed``.

    Movies of the observed part and of the whole trial are encoded apart, so the first frames of
    `whole` differ from `context` by the rounding of the encoder. ``windows``: by trial the first
    and the last frame of `whole`, where it is not the entire trial; frames before or after the
    trial show its first or last one.
    """

    def __init__(
        self,
        observed: ObservedSource,
        readers: TrialReaders,
        windows: Mapping[str, tuple[int, int]] = MappingProxyType({}),
    ) -> None:
        super().__init__(observed.spec, readers)
        self._observed, self._windows = observed, windows

    def length(self, trial: str) -> int:
        """Return the number of frames of a trial's motion."""
        return self._readers.length(trial)

    def context(self, trials: Sequence[str]) -> Batch:
        """Return the context of clips; motions end with the last observed frame."""
        return self._observed.context(trials)

    def whole(self, trials: Sequence[str], length: int = 0) -> Batch:
        """Return whole clips, of motions of ``length`` frames; 0: of the longest of the trials."""
        longest = length or max((self.length(trial) for trial in trials), default=0)
        return self._read(trials, [self._whole(trial, longest) for trial in trials])

    def _whole(self, trial: str, length: int) -> tuple[int, ...]:
        """Return the frames of the whole clip of a trial."""
        if trial not in self._windows:
            return self.spec.all_frames(length)
        first, last = self._windows[trial]
        return tuple(max(f, 0) for f in range(last, first - 1, -self.spec.stride))[::-1]

    def steps(self, trial: str, part: Part) -> int:
        """Return the number of frames of a part of a trial's clip."""
        if part == "context":
            return self.spec.context
        return len(self._whole(trial, self.length(trial)))

    def window(self, trials: Sequence[str], starts: Sequence[int], length: int) -> Batch:
        """Return ``length`` frames of every trial, ``spec.stride`` apart, from its start frame."""
        if length < 1 or len(starts) != len(trials):
            raise BadInputError(
                f"a window needs at least 1 frame and a start for each trial, not {length} frames "
                f"and {len(starts)} starts for {len(trials)} trials"
            )
        stride = self.spec.stride
        frames: list[Sequence[int]] = []
        for trial, start in zip(trials, starts, strict=True):
            if not 0 <= start < self.length(trial):
                raise BadInputError(
                    f"trial {trial!r} has {self.length(trial)} frames: a window cannot start at "
                    f"{start}"
                )
            frames.append(range(start, start + length * stride, stride))
        return self._read(trials, frames)

    def _read(self, trials: Sequence[str], frames: Sequence[Sequence[int]]) -> Batch:
        """Return the clips of ``trials`` that show ``frames`` (B, T)."""
        return self._readers.batch(trials, frames)

    def key(self, trial: str, part: Part) -> str:
        """Return the hexadecimal SHA-256 of all that determines the part of a trial's clip."""
        if part == "context":
            return self._observed.key(trial, part)
        frames = self._whole(trial, self.length(trial))
        return clip_key(self.spec, frames, self._readers.identity(trial))


def clip_key(spec: Spec, frames: Sequence[int], identity: Sequence[str]) -> str:
    """Return the hexadecimal SHA-256 of ``identity``, ``frames`` and what ``spec`` says of them.

    Statistics of the weights (``mean``, ``std``) do not count: a source does not use them.
    """
    values = {
        "version": _VERSION,
        "frames": list(frames),
        "inputs": sorted(set(spec.inputs)),
        "size": spec.image_size if spec.sees_pictures else None,
        "objects": spec.objects if "boxes" in spec.inputs else None,
        "read": list(identity),
    }
    return digest_of(json.dumps(values, sort_keys=True))
