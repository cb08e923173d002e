"""What models imagined of a trial, as the record that the page's script shows."""

from __future__ import annotations

from typing import Any

from physion.core.errors import BadInputError
from physion.report.viewer.imagined.particles import pack_particles
from physion.report.viewer.imagined.pictures import PICTURES, pack_pictures
from physion.report.viewer.imagined.trial import ImaginedTrial, caption
from physion.scenes.scene import Scene

SHOWABLE = ("particles", *PICTURES)
"""Names of the arrays that the viewer shows."""


def pack_imagined(
    imagined: ImaginedTrial, scene: Scene, length: int, *, observed: bool = False
) -> dict[str, Any]:
    """Return what the page shows of an imagined trial.

    Parameters
    ----------
    imagined
        The imagined trial.
    scene
        The scene of the trial.
    length
        Frames of the true trial; the page shows no later ones.
    observed
        Whether agent and patient touched in the observed part.

    Raises
    ------
    BadInputError
        If an array has another shape than it must have, or nothing can be shown.
    """
    if not any(name in imagined.shown for name in SHOWABLE):
        raise BadInputError(
            f"model {imagined.model!r} imagined nothing that the viewer shows of trial "
            f"{scene.name!r}: it shows {', '.join(SHOWABLE)}"
        )
    record: dict[str, Any] = {
        "model": imagined.model,
        "caption": caption(imagined, observed=observed),
    }
    if "particles" in imagined.shown:
        record["particles"] = pack_particles(imagined, scene, length)
    if any(name in imagined.shown for name in PICTURES):
        record["pictures"] = pack_pictures(imagined, scene.name, length)
    return record
