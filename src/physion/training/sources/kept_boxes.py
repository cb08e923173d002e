"""Boxes of objects that were rendered before, kept in memory by trial and frame."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 2**28
"""Bytes that the boxes of one reader take at most: those of 100,000 frames are 13 MB at 8 objects
of 16 bytes."""


@dataclass(frozen=True, eq=False)
class BoxesOfTrial:
    """Boxes (F, K, 4) of the frames of a trial, and which of them are known (F,)."""

    boxes: NDArray[np.float32]
    known: NDArray[np.bool_]

    @classmethod
    def unknown(cls, frames: int, objects: int) -> BoxesOfTrial:
        """Return those of a trial of which nothing is known yet."""
        shape = (frames, objects, 4)
        return cls(np.full(shape, np.nan, np.float32), np.zeros(frames, np.bool_))

    @property
    def bytes(self) -> int:
        """Size in memory."""
        return self.boxes.nbytes + self.known.nbytes


class KeptBoxes:
    """Boxes of trials; the trials that were used longest ago are forgotten first.

    Threads may share it. Another process that receives it starts with an empty one.

    Parameters
    ----------
    objects
        Rows K of the boxes of a frame.
    most_bytes
        Largest size in memory; 0 keeps nothing.
    """

    def __init__(self, objects: int, most_bytes: int = MOST_BYTES) -> None:
        self._objects, self._most_bytes = objects, most_bytes
        self._trials: OrderedDict[str, BoxesOfTrial] = OrderedDict()
        self._bytes, self._lock = 0, threading.Lock()

    @property
    def bytes(self) -> int:
        """Size in memory of what is kept."""
        return self._bytes

    def get(
        self, trial: str, frames: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the boxes (T, K, 4) of frames (T,), and which are known (T,); copies."""
        with self._lock:
            kept = self._trials.get(trial)
            if kept is None:
                kept = BoxesOfTrial.unknown(len(frames), self._objects)
                return kept.boxes, kept.known
            self._trials.move_to_end(trial)
            return kept.boxes[frames], kept.known[frames]

    def missing(self, trial: str) -> NDArray[np.int64]:
        """Return the frames of a trial whose boxes are not known; none if it is not kept at all."""
        with self._lock:
            kept = self._trials.get(trial)
            return np.zeros(0, np.int64) if kept is None else np.flatnonzero(~kept.known)

    def add(
        self, trial: str, length: int, frames: NDArray[np.int64], boxes: NDArray[np.float32]
    ) -> None:
        """Keep the boxes (T, K, 4) of frames (T,) of a trial with ``length`` frames."""
        with self._lock:
            kept = self._trials.get(trial)
            if kept is None:
                kept = BoxesOfTrial.unknown(length, self._objects)
                self._trials[trial] = kept
                self._bytes += kept.bytes
            kept.boxes[frames], kept.known[frames] = boxes, True
            while self._bytes > self._most_bytes:
                self._bytes -= self._trials.popitem(last=False)[1].bytes

    def __reduce__(self) -> tuple[Any, ...]:
        # A lock cannot be sent to another process.
        return KeptBoxes, (self._objects, self._most_bytes)
