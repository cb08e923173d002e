"""Why a participant's request is refused, as an exception of the store."""

from __future__ import annotations

from physion.errors import PhysionError
from physion.experiment.protocol.messages import REFUSALS, State


class Refused(PhysionError):
    """A request that is not granted, and has changed nothing.

    ``code`` is a key of `REFUSALS`; ``message`` a sentence for people; ``state`` where the session
    stands, for the codes from which a client goes on.
    """

    def __init__(self, code: str, message: str, state: State | None = None) -> None:
        assert code in REFUSALS
        super().__init__(message)
        self.code, self.message, self.state = code, message, state
