"""What a readout is given of a clip: the three protocols of the study.

| protocol | official | features |
|---|---|---|
| *observed* | C | encoder, observed frames |
| *observed+simulated* | B | encoder, observed frames; dynamics, the rest |
| *full* | A | encoder, all frames |

*full* is detection: it sees the answer. It tells how much of it the encoder's features hold.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError, UnknownNameError


class Readout(Enum):
    """A readout protocol; the value is its name in the paper."""

    OBSERVED = "observed"
    OBSERVED_SIMULATED = "observed+simulated"
    FULL = "full"

    @property
    def letter(self) -> str:
        """The ``Readout Type`` of the official result files."""
        return {"observed": "C", "observed+simulated": "B", "full": "A"}[self.value]

    @property
    def sees_future(self) -> bool:
        """Does it see frames after the observed part?"""
        return self is Readout.FULL

    @classmethod
    def named(cls, name: str) -> Readout:
        """The protocol called ``name``; `UnknownNameError` with the closest names."""
        try:
            return cls(name)
        except ValueError:
            raise UnknownNameError("readout protocol", name, [r.value for r in cls]) from None


def flatten_time(*parts: NDArray[Any]) -> NDArray[np.float32]:
    """Features (n, T, D) of several parts, one after the other in time, as (n, T_all * D)."""
    joined = np.concatenate([np.asarray(part, np.float32) for part in parts], axis=1)
    if joined.ndim != 3:
        raise BadInputError(f"features must be (trials, time, features), not {joined.shape}")
    return joined.reshape(len(joined), -1)
