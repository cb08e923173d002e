"""Requests of a simulated participant, sent again until the server answers, as the pages do."""

from __future__ import annotations

import asyncio
import time

import httpx2

from physion.errors import PhysionError
from physion.experiment.protocol import messages as wire

GO_ON = ("out_of_order", "already_answered", "wrong_stage")
"""Refusals that carry the state from which a session goes on."""


class RefusedError(PhysionError):
    """The server said no: a ``code`` of `wire.REFUSALS`, and where the session stands, if told."""

    def __init__(self, refusal: wire.Refusal) -> None:
        super().__init__(refusal.message)
        self.code, self.state = refusal.error, refusal.state


class SimulatedBrowser:
    """One visitor's requests, sent again until the server answers.

    The pauses before a request is sent again double from the first of ``waits_s`` to the second;
    ``patience_s``: how long a request is tried.
    """

    def __init__(
        self, client: httpx2.AsyncClient, waits_s: tuple[float, float], patience_s: float
    ) -> None:
        self._client, self._waits_s, self._patience_s = client, waits_s, patience_s
        self.token = ""
        self.retries = 0

    async def ask(self, method: str, path: str, body: wire.Message | None = None) -> bytes:
        """The body of the answer. `RefusedError` for a no, `PhysionError` when out of patience."""
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
                if answer.status_code != 429 and answer.status_code < 500:
                    raise RefusedError(_refusal(answer))
                trouble = f"the server answers {answer.status_code}"
            if time.monotonic() > until:
                raise PhysionError(f"{method} {path}: {trouble} for {self._patience_s:g} s")
            self.retries += 1
            await asyncio.sleep(wait)
            wait = min(2 * wait, longest)


def _refusal(answer: httpx2.Response) -> wire.Refusal:
    try:
        return wire.Refusal.model_validate_json(answer.content)
    except ValueError:
        return wire.Refusal(error="bad_request", message=f"status {answer.status_code}")


def state_after(refused: RefusedError) -> wire.State:
    """The state from which a session goes on after a refusal; raises it again without one."""
    if refused.code in GO_ON and refused.state is not None:
        return refused.state
    raise refused
