"""Anchor `constant-motion`: bodies go on as they move at the last observed frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from physion.errors import BadInputError
from physion.models.anchors.observed_motion import motions, observed_motion, touched
from physion.models.anchors.settings_digest import settings_digest
from physion.models.anchors.smallest_gap import gap_in_constant_motion
from physion.models.batch import LAST_OBSERVED, Batch, Motion, Provenance, Rollout, Spec
from physion.models.build import make_config
from physion.version import __version__

NAME, VERSION = "constant-motion", 1


@dataclass(frozen=True, slots=True)
class ConstantMotionConfig:
    """Settings of `ConstantMotion`.

    - ``frames``: how far it looks ahead, in frames of 0.01 s. The default ends with frame 150, the
      last one of a trial of the usual smallest length.
    """

    frames: int = 106

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise BadInputError(f"{NAME}: frames must be at least 1, not {self.frames}")


class ConstantMotion:
    """Simulator without forces: constant velocity and angular velocity from frame 44 on.

    Gravity, contacts and joints have no effect; a body that lies or flies goes on alike. The gap is
    the smallest distance of the hulls of agent and patient on their way (`smallest_gap`), and 0 if
    they touched in the observed part. All samples are equal. A learned simulator should predict
    better.
    """

    reader = "gap"
    samples = 1
    seed = 0
    knobs: Mapping[str, tuple[float, ...]] = MappingProxyType({})

    def __init__(self, config: ConstantMotionConfig) -> None:
        self.config = config
        self.spec = Spec(inputs=("state",), stride=1, context=1, future=config.frames, anchor="end")

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: float) -> Rollout:
        """Return gaps and contacts (B, samples); nothing is random and there are no knobs."""
        pairs = zip(motions(context, NAME), context.trials, strict=True)
        gaps = np.array([self._gap(observed_motion(motion, trial)) for motion, trial in pairs])
        repeated = np.repeat(gaps.reshape(-1, 1), samples, axis=1)
        return Rollout(gap=repeated, contact=repeated <= 0)

    def provenance(self) -> Provenance:
        """Return name and versions for the table of predictions."""
        return Provenance(
            NAME,
            "none",
            encoder_type="true state",
            dynamics_type="constant velocity",
            versions=f"physion {__version__}",
        )

    def digest(self) -> str:
        """Return the SHA-256 of code version and settings."""
        return settings_digest(NAME, VERSION, dataclasses.asdict(self.config))

    def _gap(self, motion: Motion) -> float:
        """Return the gap of one observed motion."""
        if touched(motion):
            return 0.0
        state = motion.trajectory.state(LAST_OBSERVED)
        return gap_in_constant_motion(motion.scene, state, self.config.frames)


def constant_motion(**options: Any) -> ConstantMotion:
    """Build a model in which bodies go on as they move at the last observed frame.

    ``options`` are the fields of `ConstantMotionConfig`.
    """
    return ConstantMotion(make_config(ConstantMotionConfig, NAME, options))
