"""HTTP client of a simulated participant, with the same retries as the browser pages."""

from __future__ import annotations

import asyncio
import time

import httpx2

from physion.core.errors import PhysionError
from physion.experiment.protocol import messages as wire

GO_ON = ("out_of_order", "already_answered", "wrong_stage", "not_shown")
"""Refusals that carry the session's state, with which the participant continues."""


class RefusedError(PhysionError):
    """Refusal by the server: a ``code`` of `wire.REFUSALS` and the session's state, if sent."""

    def __init__(self, refusal: wire.Refusal) -> None:
        super().__init__(refusal.message)
        self.code, self.state = refusal.error, refusal.state


class SimulatedBrowser:
    """Client of one visitor that retries each request until the server answers.

    Parameters
    ----------
    client
        The shared HTTP client.
    waits_s
        First and longest pause between retries in seconds; the pause doubles in between.
    patience_s
        Seconds after which a request is given up.
    """

    def __init__(
        self, client: httpx2.AsyncClient, waits_s: tuple[float, float], patience_s: float
    ) -> None:
        self._client, self._waits_s, self._patience_s = client, waits_s, patience_s
        self.token = ""
        self.retries = 0

    async def ask(self, method: str, path: str, body: wire.Message | None = None) -> bytes:
        """Send a request and return the body of the response.

        Raises
        ------
        RefusedError
            The server refused the request.
        PhysionError
            The server did not answer within ``patience_s``.
        """
        content = None if body is None else body.model_dump_json(by_alias=True, exclude_none=True)
        headers = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        if content is not None:
            headers["Content-Type"] = "application/json"
        (wait, longest), until = self._waits_s, time.monotonic() + self._patience_s
        while True:
            trouble = "the server does not answer"
            try:
                answer = await self._client.request(method, path, content=content, headers=headers)
            except httpx2.TransportError as error:
                trouble = f"the server does not answer ({type(error).__name__})"
            else:
                if answer.is_success:
                    return answer.content
                if answer.status_code not in (425, 429) and answer.status_code < 500:
                    raise RefusedError(_refusal(answer))
                trouble = f"the server answers {answer.status_code}"
            if time.monotonic() > until:
                raise PhysionError(f"{method} {path}: {trouble} for {self._patience_s:g} s")
            self.retries += 1
            await asyncio.sleep(wait)
            wait = min(2 * wait, longest)


def _refusal(answer: httpx2.Response) -> wire.Refusal:
    """Return the refusal in a response; a generic one if the body is not a `Refusal`."""
    try:
        return wire.Refusal.model_validate_json(answer.content)
    except ValueError:
        return wire.Refusal(error="bad_request", message=f"status {answer.status_code}")


def state_after(refused: RefusedError) -> wire.SessionState:
    """Return the state with which to continue after a refusal; raise the refusal if it has none."""
    if refused.code in GO_ON and refused.state is not None:
        return refused.state
    raise refused
