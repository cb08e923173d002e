"""Exception by which the store refuses a participant's request."""

from __future__ import annotations

from physion.core.errors import PhysionError
from physion.experiment.protocol.messages import REFUSALS, Completion, SessionState


class Refused(PhysionError):
    """Refusal of a request, which then has changed nothing.

    Parameters
    ----------
    code
        A key of `REFUSALS`.
    message
        A sentence for people.
    state
        Current state of the session, for the codes after which a client can continue.
    completion
        How the refused participant reports back to the recruiter, if the study says it.
    wait_s
        Seconds after which the same request will be accepted, for ``too_early``.
    """

    def __init__(
        self,
        code: str,
        message: str,
        state: SessionState | None = None,
        completion: Completion | None = None,
        *,
        wait_s: float = 0.0,
    ) -> None:
        assert code in REFUSALS
        super().__init__(message)
        self.wait_s = wait_s
        self.code, self.message, self.state = code, message, state
        self.completion = completion
