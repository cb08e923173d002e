"""What anchors read from a motion: its observed part, and nothing after it."""

from __future__ import annotations

import numpy as np

from physion.errors import BadInputError
from physion.models.batch import Batch, Motion
from physion.models.observed import cut_to_observed
from physion.physics.labels import label_contact


def motions(batch: Batch, model: str) -> tuple[Motion, ...]:
    """Return the motions of a batch; raise `BadInputError` for a batch without any."""
    if batch.state is None:
        raise BadInputError(f"{model} needs motions, but the batch holds none (input state)")
    return batch.state


def require_motion(motion: Motion, trial: str) -> None:
    """Raise `BadInputError` for a trial that was imported as a movie, without motion."""
    if not np.isfinite(motion.trajectory.positions).all():
        raise BadInputError(
            f"trial {trial!r} was imported without motion ({motion.trajectory.engine}): use a "
            "model that sees pictures"
        )


def observed_motion(motion: Motion, trial: str) -> Motion:
    """Return the part of a motion up to the last observed frame.

    Raises `BadInputError` for a trial that is shorter or has no motion.
    """
    seen = Motion(motion.scene, cut_to_observed(motion.scene, motion.trajectory))
    require_motion(seen, trial)
    return seen


def touched(motion: Motion) -> bool:
    """Return whether agent and patient touch in a motion."""
    return label_contact(motion.scene, motion.trajectory).contact
