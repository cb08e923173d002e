"""ASGI middleware: limits on size and rate, security headers, errors that reveal nothing.

It wraps only `receive` and `send` and starts no task of its own.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from typing import TYPE_CHECKING
from urllib.parse import quote

from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from physion.experiment.protocol.messages import MAX_BODY
from physion.experiment.web.bearer import read_token
from physion.experiment.web.rate_limits import RateLimits
from physion.experiment.web.refusals import Reply, refuse
from physion.experiment.web.security_headers import HTTPS_ONLY, security_headers

if TYPE_CHECKING:
    from physion.experiment.study.study import Study

log = logging.getLogger("physion.experiment")

MAX_TARGET = 4096
"""Bytes of path and query."""
MAX_HEADERS, MAX_HEADER_BYTES = 64, 16 * 1024
ISSUED_TOKEN = "given_token"
"""Key of the request's state under which the application stores a token that it issues."""
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
        self._limits = RateLimits(study.limits)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            await _Exchange(self._app, self._headers, self._limits, scope, receive, send).run()
        else:
            await send({"type": "websocket.close", "code": 1000})


class _Exchange:
    """One request and its response."""

    def __init__(self, app: ASGIApp, headers: list[tuple[bytes, bytes]], limits: RateLimits,
                 scope: Scope, receive: Receive, send: Send) -> None:  # fmt: skip
        self._app, self._extra, self._limits = app, headers, limits
        self._scope, self._receive, self._send = scope, receive, send
        scope.setdefault("state", {})
        self._address = scope["client"][0] if scope.get("client") else ""
        self._path: str = scope["path"]
        self._token = read_token(scope["headers"])
        self._declared = 0
        self._deadline = 0.0
        self._taken = 0
        self._body_ended = True
        self._refusal: Reply | None = None
        self._started = False

    async def run(self) -> None:
        """Check the request, run the application and send its response or a refusal."""
        refusal = self._read_headers() or self._check_rate()
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

    def _check_rate(self) -> Reply | None:
        """Return a refusal if the request exceeds a rate limit."""
        wait = self._limits.wait_time(
            self._scope["method"], self._path, self._token, self._address, time.monotonic()
        )
        if wait <= 0:
            return None
        return refuse("too_many", headers={"retry-after": str(math.ceil(wait))})

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
            self._update_limits(message["status"])
            message = self._with_headers(message)
        await self._send(message)

    def _update_limits(self, status: int) -> None:
        """Tell the rate limits the status of the response and any issued token."""
        now = time.monotonic()
        self._limits.record_status(status, self._path, self._token, self._address, now)
        issued = self._scope["state"].get(ISSUED_TOKEN)
        if issued is not None:
            self._limits.add_token(issued, now)

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
