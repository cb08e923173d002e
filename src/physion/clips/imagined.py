"""What models saw and imagined of trials, as the viewer shows it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

PICTURES = ("rgb", "boxes", "masks", "slots")
"""Names of the arrays that are shown as pictures, boxes over them, or lines."""
SHOWABLE = ("particles", *PICTURES)
"""Names of the arrays that the viewer shows."""

Arrays = Mapping[str, NDArray[Any]]

_UNKNOWN = float("nan")


def _no_frames() -> NDArray[np.int64]:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class ImaginedTrial:
    """Future of a trial as a model imagined it, and what the model says about the outcome.

    - ``model``: its name. ``weights``: their origin, or that they are untrained.
    - ``frames`` (F,): the frame of the trial that each row of ``shown`` is at, increasing.
    - ``shown``: arrays of one future, by the names of `physion.models.Rollout`. The viewer shows
      ``particles`` (F, P, 3) in metres, with ``things`` (P,), the index in `Scene.names` of the
      object of each; ``rgb`` (F, H, W, 3) uint8; ``boxes`` (F, K, 4) in 0..1, NaN for none;
      ``masks`` (F, K, h, w) in 0..1; and ``slots`` (F, K, D), values of K slots.
    - ``seen_frames`` (T,), ``seen``: the frames that the model saw, before ``frames``, and what it
      saw or made of them: ``rgb``, ``boxes``, ``masks`` and ``slots``.
    - ``true``: what was to be imagined in ``frames``: ``rgb``, and ``slots`` that the model finds
      in it.
    - ``probability``: P(contact). ``gap``: smallest distance of agent and patient in the future
      that is shown, metres; 0 or less is a contact. NaN for what is unknown.
    - ``futures``: number of imagined futures, of which the first is shown.
    """

    model: str
    weights: str
    frames: NDArray[np.int64]
    shown: Arrays = field(default_factory=dict)
    seen_frames: NDArray[np.int64] = field(default_factory=_no_frames)
    seen: Arrays = field(default_factory=dict)
    true: Arrays = field(default_factory=dict)
    probability: float = _UNKNOWN
    gap: float = _UNKNOWN
    futures: int = 1


Imagine = Callable[[Sequence[str]], Mapping[str, Sequence[ImaginedTrial]]]
"""Function from the names of trials to what models imagined of each, by name."""
