"""Between browser and pages: cookies, forms, headers, and the check of the password."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import parse_qsl

from starlette.requests import Request
from starlette.responses import Response

from physion.experiment.experimenter.access.attempts import Attempts
from physion.experiment.experimenter.access.login import (
    COOKIE,
    LONGEST,
    PATH,
    Login,
    Logins,
    new_visit,
)
from physion.experiment.study.identity import Secrets, check_password

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "cache-control": "no-store",
    "content-security-policy": POLICY,
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
}
"""On every page; stricter than the participants' pages, which a recruiter may show in a frame."""
MAX_FORM = 8192
"""Bytes of a form."""
CHECKS_AT_ONCE = 2
"""Passwords checked at once: each takes tens of MiB and of milliseconds."""
CHECKS_WAITING = 8
"""Checks waiting for their turn; more are sent away."""


class Gate:
    """Who may see the pages. One for a server process; used from its event loop alone."""

    def __init__(
        self, read_secrets: Callable[[], Secrets], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.logins, self.clock = Logins(), clock
        self._read_secrets, self._attempts = read_secrets, Attempts()
        self._threads = ThreadPoolExecutor(CHECKS_AT_ONCE, thread_name_prefix="password")
        self._waiting = 0

    def login(self, request: Request, by_person: bool = True) -> Login | None:
        """The login of the browser; None where it has to give the password first."""
        self.logins.password_is(self._read_secrets().password_hash)
        return self.logins.find(self.token(request), self.clock(), by_person)

    def token(self, request: Request) -> str:
        """The word in the browser's cookie, empty without one."""
        return request.cookies.get(COOKIE, "")[:200]

    def visit(self, request: Request) -> str:
        """The browser's word, a new one where it has none yet: forms are bound to it."""
        return self.token(request) or new_visit()

    async def form(self, request: Request) -> dict[str, str] | None:
        """The fields of a form; None where it did not come from a page of ours."""
        fields = await read_form(request)
        good = self.logins.is_form_token(self.token(request), fields.get("form_token", ""))
        return fields if good else None

    async def try_password(self, request: Request, password: str) -> float | None:
        """None where the password is right; else the seconds to wait before the next try, 0 where
        it was wrong, more where it was not even looked at."""
        address = request.client.host if request.client else ""
        if self._waiting >= CHECKS_WAITING:
            return 2.0
        wait = self._attempts.begin(address, self.clock())
        if wait > 0:
            return wait
        secrets = self._read_secrets()
        self.logins.password_is(secrets.password_hash)
        self._waiting += 1
        try:
            loop = asyncio.get_running_loop()
            right = await loop.run_in_executor(self._threads, check_password, secrets, password)
        finally:
            self._waiting -= 1
        # It may have been changed meanwhile.
        if not right or self.logins.under != secrets.password_hash:
            return 0.0
        self._attempts.succeeded(address)
        return None

    def close(self) -> None:
        """Ends the threads."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def set_cookie(request: Request, response: Response, token: str) -> None:
    """The cookie of a login, or of a visit before it."""
    response.set_cookie(
        COOKIE, token, max_age=int(LONGEST), path=PATH, secure=request.url.scheme == "https",
        httponly=True, samesite="strict",
    )  # fmt: skip


def drop_cookie(request: Request, response: Response) -> None:
    """Makes the browser forget its cookie."""
    response.delete_cookie(
        COOKIE, path=PATH, secure=request.url.scheme == "https", httponly=True, samesite="strict"
    )


async def read_form(request: Request) -> dict[str, str]:
    """The fields of a small form, the last of each name; none where it is something else."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/x-www-form-urlencoded":
        return {}
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MAX_FORM:
            return {}
    try:
        return dict(parse_qsl(body.decode("ascii"), keep_blank_values=True, max_num_fields=20))
    except ValueError:
        return {}
