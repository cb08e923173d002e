"""The three readout protocols of the study: which features of a clip a readout receives.

| protocol | official | features |
|---|---|---|
| *observed* | C | encoder, observed frames |
| *observed+simulated* | B | encoder, observed frames; dynamics, the rest |
| *full* | A | encoder, all frames |

*full* is detection, not prediction: the frames show the outcome. It measures how much of the
outcome the features of the encoder contain.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError, UnknownNameError


class Readout(Enum):
    """Readout protocol; the value is its name in the paper."""

    OBSERVED = "observed"
    OBSERVED_SIMULATED = "observed+simulated"
    FULL = "full"

    @property
    def letter(self) -> str:
        """Value of ``Readout Type`` in the official result files."""
        return {"observed": "C", "observed+simulated": "B", "full": "A"}[self.value]

    @property
    def sees_future(self) -> bool:
        """Whether the readout receives frames after the observed part."""
        return self is Readout.FULL

    @classmethod
    def named(cls, name: str) -> Readout:
        """Return the protocol called ``name``; raise `UnknownNameError` with the closest names."""
        try:
            return cls(name)
        except ValueError:
            raise UnknownNameError("readout protocol", name, [r.value for r in cls]) from None


def flatten_time(*parts: NDArray[Any]) -> NDArray[np.float32]:
    """Concatenate features (n, T, D) in time and flatten them to (n, T_all * D)."""
    joined = np.concatenate([np.asarray(part, np.float32) for part in parts], axis=1)
    if joined.ndim != 3:
        raise BadInputError(f"features must be (trials, time, features), not {joined.shape}")
    return joined.reshape(len(joined), -1)
