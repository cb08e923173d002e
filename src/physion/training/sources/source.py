"""What a source of batches offers.

Code under a predicting protocol gets an `ObservedSource`, which cannot reach a frame after the
observed part: it opens the observed movies, and motions that were cut when they were read.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Protocol

from physion.errors import BadInputError
from physion.models.batch import Batch, Spec

Part = Literal["context", "later", "whole"]
"""Part of a clip: its context, the frames after the context, or both."""


class FutureFrameError(BadInputError):
    """Error for a request of a frame after the observed part from an `ObservedSource`."""


class ObservedSource(Protocol):
    """Source of the observed part of trials."""

    @property
    def spec(self) -> Spec:
        """What the batches hold."""
        ...

    @property
    def trials(self) -> tuple[str, ...]:
        """Names of all trials."""
        ...

    def context(self, trials: Sequence[str]) -> Batch:
        """Return the context of clips; motions end with the last observed frame.

        Raises `UnknownNameError` for an unknown trial.
        """
        ...

    def key(self, trial: str, part: Part) -> str:
        """Return the hexadecimal SHA-256 of all that determines the part of a trial's clip."""
        ...


class WholeSource(ObservedSource, Protocol):
    """Source of whole trials, for training and for the protocol *full*; motions are whole."""

    def length(self, trial: str) -> int:
        """Return the number of frames of a trial's motion."""
        ...

    def later(self, trials: Sequence[str]) -> Batch:
        """Return the frames of clips that follow the context."""
        ...

    def whole(self, trials: Sequence[str]) -> Batch:
        """Return whole clips."""
        ...

    def window(self, trials: Sequence[str], starts: Sequence[int], length: int) -> Batch:
        """Return ``length`` frames of every trial, ``spec.stride`` apart, from its start frame."""
        ...
