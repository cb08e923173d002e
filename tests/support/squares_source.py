"""Source of trials in which coloured squares move at constant speed; it needs no file."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence

import numpy as np

from physion.clips.batch import Batch, Spec, clip_frames
from physion.clips.source import Part
from support.clip_source import ClipSource
from support.moving_squares import squares

FRAMES = 60
"""Length of a trial, in which a square crosses up to 0.7 of the picture."""


class SquaresSource(ClipSource):
    """Source of ``count`` trials with two squares each; the seed determines the trials."""

    def __init__(self, spec: Spec, count: int, seed: int = 0) -> None:
        self.spec = spec
        self._whole = squares(count, FRAMES, dataclasses.replace(spec, stride=1), seed)
        self.trials = self._whole.trials
        self._seed = seed

    def length(self, trial: str) -> int:
        return FRAMES

    def key(self, trial: str, part: Part) -> str:
        return hashlib.sha256(f"{trial} {self._seed} {part} {self.spec}".encode()).hexdigest()

    def clips(self, trials: Sequence[str], frames: Sequence[Sequence[int]]) -> Batch:
        clipped = [clip_frames(wanted, FRAMES) for wanted in frames]
        rows = [self.trials.index(trial) for trial in trials]
        shown = np.stack([frame for frame, _ in clipped])
        chosen = np.array(rows)[:, None], shown
        boxes = self._whole.boxes
        return Batch(
            trials=tuple(trials),
            frames=shown,
            valid=np.stack([valid for _, valid in clipped]),
            rgb=self._whole.rgb.numpy()[chosen],
            boxes=None if boxes is None else boxes.numpy()[chosen],
        )
