"""Access control of the experimenter's pages: cookies, form tokens, headers, password checks."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import parse_qsl

from starlette.requests import Request
from starlette.responses import Response

from physion.experiment.experimenter.access.attempts import LoginAttempts
from physion.experiment.experimenter.access.login import (
    COOKIE,
    MAX_DURATION,
    PATH,
    Login,
    LoginRegistry,
    new_cookie_token,
)
from physion.experiment.study.identity import Account, Secrets, check_password

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
"""Headers of every page; stricter than those of the participants' pages, which recruiters embed."""
MAX_FORM = 8192
"""Maximum size of a form in bytes."""
CHECKS_AT_ONCE = 2
"""Passwords checked in parallel; each check takes tens of MiB and tens of milliseconds."""
CHECKS_WAITING = 8
"""Maximum number of checks in progress or queued; further attempts are refused."""


class AccessControl:
    """Login state of a server process; to be used from its event loop only."""

    def __init__(
        self, read_secrets: Callable[[], Secrets], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.logins, self.clock = LoginRegistry(), clock
        self._read_secrets, self._attempts = read_secrets, LoginAttempts()
        self._threads = ThreadPoolExecutor(CHECKS_AT_ONCE, thread_name_prefix="password")
        self._waiting = 0

    def login(self, request: Request, by_person: bool = True) -> Login | None:
        """Return the login of the browser, or None if it must give the password first.

        ``by_person``: the request was made by a person, not by an automatic refresh. A login ends
        when its account is removed or has a new password; a new role counts at once.
        """
        token = self.token(request)
        login = self.logins.find(token, self.clock(), by_person)
        if login is None:
            return None
        account = self._read_secrets().account(login.account.name)
        if account is None or account.password_hash != login.account.password_hash:
            self.logins.close(token)
            return None
        login.account = account
        return login

    def has_names(self) -> bool:
        """Return whether logging in needs a name: there are more accounts than the first."""
        return bool(self._read_secrets().others)

    def token(self, request: Request) -> str:
        """Return the token in the browser's cookie, or an empty text."""
        return request.cookies.get(COOKIE, "")[:200]

    def visit(self, request: Request) -> str:
        """Return the browser's cookie token, or a new one, to which forms are bound."""
        return self.token(request) or new_cookie_token()

    async def form(self, request: Request) -> dict[str, str] | None:
        """Return the fields of a form, or None if its token is not valid for this browser."""
        fields = await read_form(request)
        good = self.logins.is_form_token(self.token(request), fields.get("form_token", ""))
        return fields if good else None

    async def try_password(self, request: Request, name: str, password: str) -> Account | float:
        """Check the password of an account.

        Returns
        -------
        Account or float
            The account if the password is right, 0 if name or password is wrong, otherwise the
            seconds to wait before the next attempt (the password was not checked).
        """
        address = request.client.host if request.client else ""
        if self._waiting >= CHECKS_WAITING:
            return 2.0
        wait = self._attempts.begin(address, self.clock())
        if wait > 0:
            return wait
        secrets = self._read_secrets()
        account = secrets.account(name)
        self._waiting += 1
        try:
            loop = asyncio.get_running_loop()
            right = await loop.run_in_executor(
                self._threads, check_password, secrets, password, name
            )
        finally:
            self._waiting -= 1
        # The password may have been changed during the check.
        if not right or account is None or self._read_secrets().account(name) != account:
            return 0.0
        self._attempts.succeeded(address)
        return account

    def close(self) -> None:
        """Stop the threads that check passwords."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def set_cookie(request: Request, response: Response, token: str) -> None:
    """Set the cookie of a login, or of a visit before login."""
    response.set_cookie(
        COOKIE, token, max_age=int(MAX_DURATION), path=PATH, secure=request.url.scheme == "https",
        httponly=True, samesite="strict",
    )  # fmt: skip


def drop_cookie(request: Request, response: Response) -> None:
    """Delete the browser's cookie."""
    response.delete_cookie(
        COOKIE, path=PATH, secure=request.url.scheme == "https", httponly=True, samesite="strict"
    )


async def read_form(request: Request) -> dict[str, str]:
    """Return the fields of a URL-encoded form; empty if the body is too large or malformed."""
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
