"""What models imagined of a trial, for the viewer: next to the true motion, in few bytes.

The caller gives plain arrays (`ImaginedTrial`). What can be shown is one entry of `_PACKERS` for
each kind of array, and its counterpart in the page's script.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.report.viewer.motion import pack_grid, role_of
from physion.scenes.scene import OBSERVED_FRAMES, Scene

PARTICLES = 1500
"""Largest number of particles of a trial in the page."""
PARTICLE_BYTES = 700_000
"""Largest size of their positions before base64, which adds a third."""
REACH = 50.0
"""Metres from the origin beyond which particles are not followed: models may lose objects."""

_UNKNOWN = float("nan")


@dataclass(frozen=True, eq=False)
class ImaginedTrial:
    """Future of a trial as a model imagined it, and what the model says about the outcome.

    - ``model``: its name. ``weights``: their origin, or that they are untrained.
    - ``frames`` (F,): the frame of the trial that each row of ``shown`` is at, increasing.
    - ``shown``: arrays of one future, by the names of `physion.models.Rollout`. The viewer shows
      those of `SHOWABLE`: ``particles`` (F, P, 3) in metres, with ``things`` (P,), the index in
      `Scene.names` of the object of each.
    - ``probability``: P(contact). ``gap``: smallest distance of agent and patient in the future
      that is shown, metres; 0 or less is a contact. NaN for what is unknown.
    - ``futures``: number of imagined futures, of which the first is shown.
    """

    model: str
    weights: str
    frames: NDArray[np.int64]
    shown: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    probability: float = _UNKNOWN
    gap: float = _UNKNOWN
    futures: int = 1


Imagine = Callable[[Sequence[str]], Mapping[str, Sequence[ImaginedTrial]]]
"""Function from the names of trials to what models imagined of each, by name."""


def pack_imagined(imagined: ImaginedTrial, scene: Scene, length: int) -> dict[str, Any]:
    """Return what the page shows of an imagined trial.

    Parameters
    ----------
    imagined
        The imagined trial.
    scene
        The scene of the trial.
    length
        Frames of the true trial; the page shows no later ones.

    Raises
    ------
    BadInputError
        If an array has another shape than it must have, or nothing can be shown.
    """
    names = [name for name in _PACKERS if name in imagined.shown]
    if not names:
        raise BadInputError(
            f"model {imagined.model!r} imagined nothing that the viewer shows of trial "
            f"{scene.name!r}: it shows {', '.join(SHOWABLE)}"
        )
    record = {name: _PACKERS[name](imagined, scene, length) for name in names}
    return record | {"model": imagined.model, "caption": caption(imagined)}


def caption(imagined: ImaginedTrial) -> str:
    """Return model, weights, P(contact) and smallest gap as text."""
    facts = []
    if math.isfinite(imagined.probability):
        several = f" from {imagined.futures} futures" if imagined.futures > 1 else ""
        facts.append(f"P(contact) {imagined.probability:.2f}{several}")
    if math.isfinite(imagined.gap):
        which = " of the one shown" if imagined.futures > 1 else ""
        facts.append(
            f"smallest gap{which} {round(imagined.gap, 3) + 0.0:.3f} m, 0 or less is a contact"
        )
    text = f"{imagined.model} ({imagined.weights})"
    return f"{text}: {'; '.join(facts)}." if facts else f"{text}."


def _pack_particles(imagined: ImaginedTrial, scene: Scene, length: int) -> dict[str, Any]:
    """Return positions on a grid, their frames, and where each object's particles are.

    Kinematic bodies are left out unless they are agent or patient: they do not move. So are rows
    from the first that is not finite on, particles above `PARTICLES` and rows above
    `PARTICLE_BYTES`, both evenly.
    """
    positions, things = _checked_particles(imagined, scene)
    names = scene.names()
    fixed = {body.name for body in scene.bodies if body.kinematic}
    kept = [
        row
        for row, thing in enumerate(things.tolist())
        if thing >= 0 and (names[thing] not in fixed or role_of(scene, names[thing]))
    ]
    kept = sorted(kept, key=lambda row: int(things[row]))
    columns = np.array(kept, np.int64)[_evenly(len(kept), PARTICLES)]
    finite = np.isfinite(positions[:, columns]).all(axis=(1, 2))
    count = len(finite) if finite.all() else int(np.argmin(finite))
    # One row may lie past the end, so that the last frames are between two.
    count = min(count, int(np.searchsorted(imagined.frames, length - 1)) + 1)
    if not len(columns) or not count:
        raise BadInputError(
            f"model {imagined.model!r} imagined no particle with a finite position of trial "
            f"{scene.name!r}"
        )
    rows = np.arange(count)[_evenly(count, max(2, PARTICLE_BYTES // (6 * len(columns))))]
    points = np.clip(positions[np.ix_(rows, columns)].astype(np.float64), -REACH, REACH)
    return {
        "from": OBSERVED_FRAMES,
        "frames": [int(frame) for frame in imagined.frames[rows]],
        "points": pack_grid(points),
        "groups": _groups(things[columns], scene),
    }


def _checked_particles(
    imagined: ImaginedTrial, scene: Scene
) -> tuple[NDArray[np.floating], NDArray[np.integer]]:
    """Return particles (F, P, 3) and things (P,); raise `BadInputError` for other shapes."""
    positions = np.asarray(imagined.shown["particles"])
    things = np.asarray(imagined.shown.get("things", np.zeros(0, np.int64)))
    wanted = (len(imagined.frames), len(things), 3)
    if positions.shape != wanted or (len(things) and things.max() >= len(scene.names())):
        raise BadInputError(
            f"model {imagined.model!r}, trial {scene.name!r}: particles must be (frames, "
            f"particles, 3), here {wanted}, not {positions.shape}, and things objects of the scene"
        )
    return positions, things


def _groups(things: NDArray[np.integer], scene: Scene) -> list[dict[str, Any]]:
    """Return role, first row and number of the particles of each object; ``things`` is sorted."""
    names = scene.names()
    values, first, counts = np.unique(things, return_index=True, return_counts=True)
    return [
        {"role": role_of(scene, names[thing]), "first": int(start), "count": int(count)}
        for thing, start, count in zip(values.tolist(), first, counts, strict=True)
    ]


def _evenly(count: int, most: int) -> NDArray[np.int64]:
    """Return at most ``most`` of the rows 0 to ``count`` - 1, with the first and the last."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.rint(np.linspace(0, count - 1, most)).astype(np.int64))


_PACKERS: dict[str, Callable[[ImaginedTrial, Scene, int], dict[str, Any]]] = {
    "particles": _pack_particles,
}
"""For each array of ``shown`` the function that makes it small."""
SHOWABLE = tuple(_PACKERS)
"""Names of the arrays that the viewer shows."""
