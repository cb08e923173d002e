"""Protect the application: limits on size and time, security headers, errors that reveal nothing.

`Guards` is an ASGI middleware around the whole application. It wraps only `receive` and `send` and
starts no task of its own. Rates and slow clients are the business of the reverse proxy in front.
"""

from __future__ import annotations

import asyncio
import logging
import re
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from pydantic import BaseModel, ValidationError
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from physion.experiment.protocol import MAX_BODY, REFUSALS, Completion, Refusal, SessionState
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
        HTTP status in place of the code's; 0 for none.
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

MAX_TARGET = 4096
"""Bytes of path and query."""
MAX_HEADERS, MAX_HEADER_BYTES = 64, 16 * 1024
BODY_SECONDS = 20.0
"""Time in which a body must arrive."""
LINGER_BYTES, LINGER_SECONDS = 256 * 1024, 1.0
"""Part of a refused body that is still read, since clients read the response only afterwards."""


class _BodyRefused(Exception):
    """Raised in the application to end a request whose body is too large or too slow."""


class Guards:
    """ASGI middleware around the whole application."""

    def __init__(self, app: ASGIApp, study: Study) -> None:
        self._app = app
        self._headers = security_headers(study)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            await _Exchange(self._app, self._headers, scope, receive, send).run()
        else:
            await send({"type": "websocket.close", "code": 1000})


class _Exchange:
    """One request and its response."""

    def __init__(self, app: ASGIApp, headers: list[tuple[bytes, bytes]],
                 scope: Scope, receive: Receive, send: Send) -> None:  # fmt: skip
        self._app, self._extra = app, headers
        self._scope, self._receive, self._send = scope, receive, send
        self._path: str = scope["path"]
        self._declared = 0
        self._deadline = 0.0
        self._taken = 0
        self._body_ended = True
        self._refusal: Reply | None = None
        self._started = False

    async def run(self) -> None:
        """Check the request, run the application and send its response or a refusal."""
        refusal = self._read_headers()
        if refusal is not None:
            await self._refuse(refusal)
            return
        try:
            await self._app(self._scope, self.receive, self.send)
        except _BodyRefused:
            pass
        except ClientDisconnect:
            return
        except Exception:
            # Only path and traceback: query, headers and body may identify the participant.
            log.exception("%s %s failed", self._scope["method"], quote(self._path))
            if self._started:
                raise
            self._refusal = refuse("server_error")
        if self._refusal is not None and not self._started:
            await self._refuse(self._refusal)

    def _read_headers(self) -> Reply | None:
        """Read the declared body length; refuse a URL, headers or body that are too long."""
        scope = self._scope
        headers = scope["headers"]
        target = len(scope.get("raw_path") or b"") + len(scope["query_string"])
        if target > MAX_TARGET or len(headers) > MAX_HEADERS:
            return refuse("too_large", "The address or the headers are too long.")
        size = 0
        for name, value in headers:
            size += len(name) + len(value)
            if name == b"content-length":
                self._declared = int(value) if value.isdigit() and len(value) < 19 else MAX_BODY + 1
                self._body_ended = self._declared == 0
            elif name == b"transfer-encoding":
                self._body_ended = False
        if size > MAX_HEADER_BYTES:
            return refuse("too_large", "The address or the headers are too long.")
        return refuse("too_large") if self._declared > MAX_BODY else None

    async def receive(self) -> Message:
        """Receive the next part of the body, within the limits on size and time."""
        if self._body_ended:
            return await self._receive()
        now = asyncio.get_running_loop().time()
        self._deadline = self._deadline or now + BODY_SECONDS
        try:
            async with asyncio.timeout_at(self._deadline):
                message = await self._receive()
        except TimeoutError as error:
            self._refusal = refuse("bad_request", "The body took too long.", status=408)
            raise _BodyRefused from error
        self._taken += len(message.get("body", b""))
        self._body_ended = not message.get("more_body", False)
        if self._taken > MAX_BODY:
            self._refusal = refuse("too_large")
            raise _BodyRefused
        return message

    async def send(self, message: Message) -> None:
        """Send a response with the additional headers; drop it if the body was refused."""
        if self._refusal is not None and not self._started:
            return
        if message["type"] == "http.response.start":
            self._started = True
            message = self._with_headers(message)
        await self._send(message)

    def _with_headers(self, message: Message) -> Message:
        """Return the start of a response with the additional headers, and log it."""
        if log.isEnabledFor(logging.INFO):
            # No query, which may identify the participant; quoted, so it cannot forge log lines.
            path = quote(self._path[:200])
            log.info("%s %s %d", self._scope["method"], path, message["status"])
        headers = list(message.get("headers", ()))
        present = {name for name, _ in headers}
        headers += [pair for pair in self._extra if pair[0] not in present]
        if b"cache-control" not in present:
            headers.append((b"cache-control", b"no-store"))
        if self._scope["scheme"] == "https":
            headers.append(HTTPS_ONLY)
        if not self._body_ended:
            headers.append((b"connection", b"close"))
        return {**message, "headers": headers}

    async def _refuse(self, reply: Reply) -> None:
        """Send a refusal and read a limited rest of the body, so that the client can receive it."""
        if not self._body_ended and self._declared <= MAX_BODY and self._taken <= MAX_BODY:
            await self._drain_body()
        start = {"type": "http.response.start", "status": reply.status_code,
                 "headers": reply.raw_headers}  # fmt: skip
        self._started = True
        await self._send(self._with_headers(start))
        body = b"" if self._scope["method"] == "HEAD" else reply.body
        await self._send({"type": "http.response.body", "body": body, "more_body": True})
        if not self._body_ended:
            await self._drain_body()
        await self._send({"type": "http.response.body", "body": b""})

    async def _drain_body(self) -> None:
        """Read and discard the rest of the body, up to the limits on bytes and time."""
        taken = 0
        try:
            async with asyncio.timeout(LINGER_SECONDS):
                while not self._body_ended and taken < LINGER_BYTES:
                    message = await self._receive()
                    taken += len(message.get("body", b""))
                    self._body_ended = not message.get("more_body", False)
        except TimeoutError:
            return
