"""Refusals as responses: one body for all errors, with no more than a person needs to know."""

from __future__ import annotations

import re
from typing import Any

from pydantic import BaseModel, ValidationError
from starlette.responses import Response

from physion.experiment.protocol.messages import REFUSALS, Refusal, State

MESSAGES = {
    "not_found": "There is nothing at this address.",
    "not_allowed": "This address does not take this kind of request.",
    "too_large": "The request is too large.",
    "too_many": "Too many requests; wait a little and try again.",
    "unavailable": "The server cannot reach its database.",
    "server_error": "The server made a mistake; try again, or write to the experimenter.",
    "bad_request": "The request was not understood.",
}


class Reply(Response):
    """A message of `physion.experiment.protocol.messages` as the body."""

    media_type = "application/json"

    def __init__(self, message: BaseModel, status: int = 200,
                 headers: dict[str, str] | None = None) -> None:  # fmt: skip
        super().__init__(message.model_dump_json(), status, headers)


def refuse(code: str, message: str = "", state: State | None = None, status: int = 0,
           headers: dict[str, str] | None = None) -> Reply:  # fmt: skip
    """The response for one of the codes of REFUSALS."""
    body = Refusal(error=code, message=message or MESSAGES.get(code, code), state=state)
    return Reply(body, status or REFUSALS[code], headers)


def code_of(status: int) -> str:
    """The code for an HTTP status that some part of the framework chose."""
    known = {401: "unknown_token", 403: "bad_link", 404: "not_found", 405: "not_allowed",
             413: "too_large", 422: "bad_request", 429: "too_many", 503: "unavailable"}  # fmt: skip
    return known.get(status, "bad_request" if status < 500 else "server_error")


def explain(error: ValidationError) -> str:
    """The first faults of a message: where and what, never the value itself."""
    faults = error.errors(include_url=False, include_context=False, include_input=False)
    words = [f"{_place(fault['loc'])}: {fault['msg'][:120]}" for fault in faults[:3]]
    more = f"; and {len(faults) - 3} more" if len(faults) > 3 else ""
    return "; ".join(words) + more


def _place(location: tuple[Any, ...]) -> str:
    """Field by field; names that the client made up are cut to plain letters."""
    parts = [re.sub(r"[^A-Za-z0-9_-]", "?", str(part)[:40]) for part in location[:5]]
    return ".".join(parts) or "body"
