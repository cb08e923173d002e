"""Motions of trials, from trial files."""

from __future__ import annotations

import dataclasses
import os
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from physion.clips.batch import Motion, cut_to_observed
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import digest_of
from physion.scenes.scene import Scene
from physion.trials.files import IndexedFile
from physion.trials.making.plan import ANSWERS
from physion.trials.trial_file import Trial


def without_answers(scene: Scene) -> Scene:
    """Return a scene whose parameters do not tell what a model is asked (`ANSWERS`)."""
    known = {name: value for name, value in scene.parameters.items() if name not in ANSWERS}
    same = len(known) == len(scene.parameters)
    return scene if same else dataclasses.replace(scene, parameters=known)


# Motions cut at the last observed frame, such that nothing leads to what was cut off.


def cut_motion(motion: Motion) -> Motion:
    """Return the observed part of a motion.

    Its arrays are copies: a view of an array would still refer to all of it. Raises `BadInputError`
    for a motion that is shorter than the observed part.
    """
    cut = cut_to_observed(motion.scene, motion.trajectory)
    contacts = dataclasses.replace(cut.contacts, **_copies(cut.contacts))
    return Motion(motion.scene, dataclasses.replace(cut, **(_copies(cut) | {"contacts": contacts})))


def motion_digest(motion: Motion) -> str:
    """Return the hexadecimal SHA-256 of a scene, including its appearance, and its trajectory."""
    trajectory = motion.trajectory
    texts = (
        motion.scene.to_json(),
        trajectory.digest(),
        trajectory.engine,
        str(trajectory.completed),
    )
    return digest_of("\n".join(texts))


def digest_in(motions: Mapping[str, Motion], trial: str) -> str:
    """Return the `motion_digest` of a trial; of trial files it is computed once in a process."""
    if isinstance(motions, TrialMotions):
        return motions.digest(trial)
    return motion_digest(motions[trial])


def _copies(values: object) -> dict[str, Any]:
    """Return copies of the arrays of a dataclass by name."""
    return {name: a.copy() for name, a in vars(values).items() if isinstance(a, np.ndarray)}


_DIGESTS: dict[tuple[Path, str, bool], str] = {}
"""Digests of motions by file, its SHA-256, and whether they are cut."""
_LEAST_BYTES, _FRACTION = 2**28, 8
"""Motions that were read last are kept in memory up to one eighth of it, or this size."""


class TrialMotions(Mapping[str, Motion]):
    """Motions of trials by name, each read from its file when it is asked for.

    The parameters of their scenes lack what would tell the answer (`without_answers`).
    With ``observed``, a motion is cut at the last observed frame when it is read.
    """

    def __init__(self, files: Mapping[str, IndexedFile], *, observed: bool) -> None:
        self._files, self._observed = files, observed
        self._kept: OrderedDict[str, Motion] = OrderedDict()
        self._bytes, self._lock = 0, threading.Lock()

    def __getitem__(self, trial: str) -> Motion:
        with self._lock:
            if trial in self._kept:
                self._kept.move_to_end(trial)
                return self._kept[trial]
        if trial not in self._files:
            raise UnknownNameError("trial", trial, self._files)
        stored = self._files[trial]
        opened = Trial(stored.read(), f"trial file {stored.path}")
        motion = Motion(without_answers(opened.scene), opened.trajectory)
        if np.isnan(motion.trajectory.positions).all():
            raise BadInputError(
                f"trial {trial!r} has no state, since it was imported from a movie; use a model "
                "that sees pictures"
            )
        if self._observed:
            motion = cut_motion(motion)
        with self._lock:
            self._keep(trial, motion)
        return motion

    def digest(self, trial: str) -> str:
        """Return the `motion_digest` of a trial, computed once in a process for each file."""
        if trial in self._files:
            stored = self._files[trial]
            stored.check()
            known = stored.path, stored.sha256, self._observed
            if known not in _DIGESTS:
                _DIGESTS[known] = motion_digest(self[trial])
            return _DIGESTS[known]
        raise UnknownNameError("trial", trial, self._files)

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)

    def __reduce__(self) -> tuple[Any, ...]:
        # Another process reads the files itself; a lock cannot be sent to it.
        return partial(TrialMotions, observed=self._observed), (self._files,)

    def _keep(self, trial: str, motion: Motion) -> None:
        """Keep a motion, and forget those that were used longest ago."""
        if trial in self._kept:
            return
        self._kept[trial] = motion
        self._bytes += _size(motion)
        while self._bytes > kept_bytes() and len(self._kept) > 1:
            self._bytes -= _size(self._kept.popitem(last=False)[1])


@cache
def kept_bytes() -> int:
    """Return how many bytes of motions are kept in memory, and as many of particles."""
    names = ("SC_PAGE_SIZE", "SC_PHYS_PAGES")
    if not all(name in getattr(os, "sysconf_names", {}) for name in names):
        return _LEAST_BYTES
    page, pages = (os.sysconf(name) for name in names)
    return max(_LEAST_BYTES, page * pages // _FRACTION)


def _size(motion: Motion) -> int:
    """Return the bytes of the arrays of a motion."""
    parts = (motion.trajectory, motion.trajectory.contacts)
    values = [getattr(part, field.name) for part in parts for field in dataclasses.fields(part)]
    return sum(int(getattr(value, "nbytes", 0)) for value in values)
