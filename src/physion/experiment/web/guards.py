"""Refusals, security headers, and errors that reveal nothing.

`Guards` is an ASGI middleware around the whole application. Rates, slow clients, and the lengths of
addresses and headers are the business of the reverse proxy in front.
"""

from __future__ import annotations

import logging
import re
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from pydantic import BaseModel, ValidationError
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from physion.experiment.protocol import REFUSALS, Completion, Refusal, SessionState
from physion.experiment.study.recruitment import MTURK_HOSTS

if TYPE_CHECKING:
    from physion.experiment.study.study import Study


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
    """JSON response whose body is a message of `physion.experiment.protocol`."""

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
        HTTP status in place of the code's own; 0 for none.
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


NOT_NEEDED = ("accelerometer", "camera", "display-capture", "geolocation", "gyroscope", "hid",
              "magnetometer", "microphone", "midi", "payment", "serial", "usb",
              "xr-spatial-tracking")  # fmt: skip


def content_policy(study: Study) -> str:
    """Return the content security policy: files of this server only, and media as blobs.

    Blobs are needed because trials are preloaded. Forms may be sent to this server, and to MTurk if
    the study may be embedded there, since tasks on MTurk are submitted by a form.
    """
    frames = " ".join(study.embed_from) or "'none'"
    forms = " ".join(("'self'", *(MTURK_HOSTS if study.embed_from else ())))
    return "; ".join((
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob:",
        "media-src 'self' blob:",
        "connect-src 'self'",
        f"frame-ancestors {frames}",
        "base-uri 'none'",
        f"form-action {forms}",
    ))  # fmt: skip


def security_headers(study: Study) -> list[tuple[bytes, bytes]]:
    """Return the raw headers of every response, with lower-case names.

    No referrer is sent, since page URLs contain recruiters' ids. Cross-origin isolation also gives
    the page the browser's high-resolution clock.
    """
    headers = {
        "content-security-policy": content_policy(study),
        "x-content-type-options": "nosniff",
        "referrer-policy": "no-referrer",
        "permissions-policy": ", ".join(f"{name}=()" for name in NOT_NEEDED),
        "cross-origin-opener-policy": "same-origin",
        "cross-origin-embedder-policy": "require-corp",
        "cross-origin-resource-policy": "same-origin",
        "x-robots-tag": "noindex, nofollow",
    }
    if not study.embed_from:
        headers["x-frame-options"] = "DENY"
    return [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]


HTTPS_ONLY = (b"strict-transport-security", b"max-age=31536000")
"""Header added to responses over HTTPS."""


log = logging.getLogger("physion.experiment")


class Guards:
    """ASGI middleware that adds headers to every response and hides internal errors."""

    def __init__(self, app: ASGIApp, study: Study) -> None:
        self._app = app
        self._headers = security_headers(study)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1000})
            return
        started = False

        async def guarded(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                message = self._with_headers(scope, message)
            await send(message)

        try:
            await self._app(scope, receive, guarded)
        except ClientDisconnect:
            return
        except Exception:
            # Only path and traceback: query, headers and body may identify the participant.
            log.exception("%s %s failed", scope["method"], quote(scope["path"]))
            if started:
                raise
            await refuse("server_error")(scope, receive, guarded)

    def _with_headers(self, scope: Scope, message: Message) -> Message:
        """Return the start of a response with the additional headers, and log it."""
        if log.isEnabledFor(logging.INFO):
            # No query, which may identify the participant; quoted, so it cannot forge log lines.
            log.info("%s %s %d", scope["method"], quote(scope["path"][:200]), message["status"])
        headers = list(message.get("headers", ()))
        present = {name for name, _ in headers}
        headers += [pair for pair in self._headers if pair[0] not in present]
        if b"cache-control" not in present:
            headers.append((b"cache-control", b"no-store"))
        if scope["scheme"] == "https":
            headers.append(HTTPS_ONLY)
        return {**message, "headers": headers}
