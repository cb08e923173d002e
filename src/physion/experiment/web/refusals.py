"""Responses that refuse a request: the same body for all errors, without internal details."""

from __future__ import annotations

import re
from typing import Any

from pydantic import BaseModel, ValidationError
from starlette.responses import Response

from physion.experiment.protocol.messages import REFUSALS, Completion, Refusal, SessionState

MESSAGES = {
    "not_found": "There is nothing at this address.",
    "not_allowed": "This address does not accept this method.",
    "too_large": "The request is too large.",
    "too_many": "Too many requests; wait a little and try again.",
    "unavailable": "The server cannot reach its database.",
    "server_error": "An error occurred on the server; try again, or write to the experimenter.",
    "bad_request": "The request was not understood.",
}


class Reply(Response):
    """JSON response whose body is a message of `physion.experiment.protocol.messages`."""

    media_type = "application/json"

    def __init__(self, message: BaseModel, status: int = 200,
                 headers: dict[str, str] | None = None) -> None:  # fmt: skip
        super().__init__(message.model_dump_json(), status, headers)


def refuse(code: str, message: str = "", state: SessionState | None = None, status: int = 0,
           headers: dict[str, str] | None = None,
           completion: Completion | None = None) -> Reply:  # fmt: skip
    """Return the response for a refusal.

    Parameters
    ----------
    code
        A key of `REFUSALS`.
    message
        Sentence for people; the default of the code if empty.
    state
        SessionState of the session, if the client can continue from it.
    status
        HTTP status in place of that of the code; 0 for none.
    headers
        Additional headers.
    completion
        How the refused participant reports back to the recruiter.
    """
    body = Refusal(
        error=code,
        message=message or MESSAGES.get(code, code),
        state=state,
        completion=completion,
    )
    return Reply(body, status or REFUSALS[code], headers)


def code_of(status: int) -> str:
    """Return the refusal code for an HTTP status that was set by the framework."""
    known = {401: "unknown_token", 403: "bad_link", 404: "not_found", 405: "not_allowed",
             413: "too_large", 422: "bad_request", 429: "too_many", 503: "unavailable"}  # fmt: skip
    return known.get(status, "bad_request" if status < 500 else "server_error")


def describe_faults(error: ValidationError) -> str:
    """Describe the first three faults of a message by field and reason, without the values."""
    faults = error.errors(include_url=False, include_context=False, include_input=False)
    lines = [f"{_field_path(fault['loc'])}: {fault['msg'][:120]}" for fault in faults[:3]]
    more = f"; and {len(faults) - 3} more" if len(faults) > 3 else ""
    return "; ".join(lines) + more


def _field_path(location: tuple[Any, ...]) -> str:
    """Return the path of a field with dots; unknown characters of the client's names become "?"."""
    parts = [re.sub(r"[^A-Za-z0-9_-]", "?", str(part)[:40]) for part in location[:5]]
    return ".".join(parts) or "body"
