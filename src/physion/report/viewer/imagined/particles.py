"""Imagined particles for the viewer: positions next to the true motion, in few bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.report.viewer.imagined.trial import ImaginedTrial, evenly
from physion.report.viewer.motion import pack_grid, role_of
from physion.scenes.scene import OBSERVED_FRAMES, Scene

PARTICLES = 1500
"""Largest number of particles of a trial in the page."""
PARTICLE_BYTES = 700_000
"""Largest size of their positions before base64, which adds a third."""
REACH = 50.0
"""Metres from the origin beyond which particles are not followed: models may lose objects."""


def pack_particles(imagined: ImaginedTrial, scene: Scene, length: int) -> dict[str, Any]:
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
    columns = np.array(kept, np.int64)[evenly(len(kept), PARTICLES)]
    finite = np.isfinite(positions[:, columns]).all(axis=(1, 2))
    count = len(finite) if finite.all() else int(np.argmin(finite))
    # One row may lie past the end, so that the last frames are between two.
    count = min(count, int(np.searchsorted(imagined.frames, length - 1)) + 1)
    if not len(columns) or not count:
        raise BadInputError(
            f"model {imagined.model!r} imagined no particle with a finite position of trial "
            f"{scene.name!r}"
        )
    rows = np.arange(count)[evenly(count, max(2, PARTICLE_BYTES // (6 * len(columns))))]
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
