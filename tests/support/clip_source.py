"""Base class of sources whose clips are computed, for tests that need no file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from physion.clips.batch import Batch, Spec


class ClipSource:
    """Source of whole trials; subclasses set ``spec`` and compute clips, lengths and keys."""

    spec: Spec

    def clips(self, trials: Sequence[str], frames: Sequence[Sequence[int]]) -> Batch:
        """Return the clips of ``trials`` that show these frames (B, T)."""
        raise NotImplementedError

    def context(self, trials: Sequence[str]) -> Batch:
        return self.clips(trials, [self.spec.context_frames()] * len(trials))

    def length(self, trial: str) -> int:
        """Return the frames of a trial."""
        raise NotImplementedError

    def whole(self, trials: Sequence[str]) -> Batch:
        longest = max(self.length(trial) for trial in trials)
        return self.clips(trials, [self.spec.all_frames(longest)] * len(trials))

    def window(self, trials: Sequence[str], starts: Sequence[int], length: int) -> Batch:
        steps = self.spec.stride * np.arange(length)
        return self.clips(trials, [(start + steps).tolist() for start in starts])
