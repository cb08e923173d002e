"""Motions cut at the last observed frame, such that nothing leads to what was cut off."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from physion.models.batch import Motion
from physion.models.observed import cut_to_observed


def cut_motion(motion: Motion) -> Motion:
    """Return the observed part of a motion.

    Its arrays are copies: a view of an array would still refer to all of it. Raises `BadInputError`
    for a motion that is shorter than the observed part.
    """
    cut = cut_to_observed(motion.scene, motion.trajectory)
    contacts = dataclasses.replace(cut.contacts, **_copies(cut.contacts))
    return Motion(motion.scene, dataclasses.replace(cut, **(_copies(cut) | {"contacts": contacts})))


class CutMotions(Mapping[str, Motion]):
    """Observed parts of motions by name, cut when they are asked for."""

    def __init__(self, motions: Mapping[str, Motion]) -> None:
        self._motions = motions

    def __getitem__(self, name: str) -> Motion:
        return cut_motion(self._motions[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._motions)

    def __len__(self) -> int:
        return len(self._motions)


def motion_digest(motion: Motion) -> str:
    """Return the hexadecimal SHA-256 of a scene, including its appearance, and its trajectory."""
    trajectory = motion.trajectory
    texts = (
        motion.scene.to_json(),
        trajectory.digest(),
        trajectory.engine,
        str(trajectory.completed),
    )
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def _copies(values: object) -> dict[str, Any]:
    """Return copies of the arrays of a dataclass by name."""
    return {name: a.copy() for name, a in vars(values).items() if isinstance(a, np.ndarray)}
