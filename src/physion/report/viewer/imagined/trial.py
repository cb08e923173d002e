"""What a model saw and imagined of a trial, as the caller of the viewer gives it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    - ``seen_frames`` (T,), ``seen``: the frames that the model saw, before those of ``frames``, and
      what it saw or made of them: ``rgb``, ``boxes``, ``masks`` and ``slots``.
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


def caption(imagined: ImaginedTrial, *, observed: bool = False) -> str:
    """Return model, weights, P(contact) and smallest gap as text.

    ``observed``: agent and patient touched in the observed part, so that the gap says nothing.
    """
    facts = []
    several = imagined.futures > 1
    if math.isfinite(imagined.probability):
        source = f" from {imagined.futures} futures" if several else ""
        facts.append(f"P(contact) {imagined.probability:.2f}{source}")
    if observed:
        facts.append("the contact was already observed")
    elif math.isfinite(imagined.gap):
        which = " of the one shown" if several else ""
        facts.append(
            f"smallest gap{which} {round(imagined.gap, 3) + 0.0:.3f} m, 0 or less is a contact"
        )
    text = f"{imagined.model} ({imagined.weights})"
    return f"{text}: {'; '.join(facts)}." if facts else f"{text}."


def evenly(count: int, most: int) -> NDArray[np.int64]:
    """Return at most ``most`` of the rows 0 to ``count`` - 1, with the first and the last."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.rint(np.linspace(0, count - 1, most)).astype(np.int64))
