"""Who may see the experimenter's pages: one password, logins in memory, cookies and form tokens.

Nothing is written to disk: a restart of the server ends all logins, and so does a new password.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from urllib.parse import parse_qsl

from starlette.requests import Request
from starlette.responses import Response

from physion.experiment.study.identity import Secrets, check_password

PATH = "/experimenter"
COOKIE = "physion_experimenter"
IDLE_TIMEOUT = 2 * 3600.0
"""Seconds without a request by a person after which a login ends."""
MAX_DURATION = 12 * 3600.0
"""Maximum duration of a login in seconds."""
MAX_LOGINS = 100
"""Maximum number of logins; beyond it the oldest one ends."""
FREE_ATTEMPTS = 5
"""Wrong passwords of one address without a pause; then 1 s, doubled with each further one."""
LONGEST_PAUSE = 900.0
MAX_ADDRESSES = 10_000
"""Addresses whose wrong passwords are remembered; the oldest are dropped first."""
CHECKS_WAITING = 8
"""Maximum number of password checks in progress or queued; each takes about 50 ms."""
MAX_FORM = 8192
"""Maximum size of a form in bytes."""
HEADERS = {
    "cache-control": "no-store",
    "content-security-policy": (
        "default-src 'none'; style-src 'self'; img-src 'self'; form-action 'self'; "
        "base-uri 'none'; frame-ancestors 'none'"
    ),
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
}
"""Headers of every page; stricter than on the participants' pages, which recruiters embed."""


@dataclass
class _Login:
    """Login of one browser; times are seconds of a monotonic clock."""

    password_hash: str
    made: float
    seen: float


class Access:
    """Logins of one server process; to be used from its event loop only.

    Parameters
    ----------
    read_secrets
        Reads the keys of the study; called at each check, so that a new password counts at once.
    clock
        Monotonic clock in seconds.
    """

    def __init__(
        self, read_secrets: Callable[[], Secrets], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._read_secrets, self.clock = read_secrets, clock
        self._logins: OrderedDict[str, _Login] = OrderedDict()
        self._wrong: OrderedDict[str, tuple[int, float]] = OrderedDict()
        self._form_key = secrets.token_bytes(32)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="password")
        self._waiting = 0

    def is_logged_in(self, request: Request, by_person: bool = True) -> bool:
        """Return whether the browser is logged in.

        ``by_person``: the request was made by a person, which resets the idle time; automatic
        refreshes do not.
        """
        key, now = _hashed(_token(request)), self.clock()
        login = self._logins.get(key)
        if login is None:
            return False
        over = now - login.made > MAX_DURATION or now - login.seen > IDLE_TIMEOUT
        if over or login.password_hash != self._read_secrets().password_hash:
            del self._logins[key]
            return False
        if by_person:
            login.seen = now
        return True

    async def log_in(self, request: Request, password: str) -> float:
        """Check the password; return 0 if it is right, else the seconds until the next try.

        A negative number: it was wrong, and the next attempt may be made at once.
        """
        address, now = request.client.host if request.client else "", self.clock()
        count, last = self._wrong.get(address, (0, 0.0))
        over = count - FREE_ATTEMPTS
        wait = last + (min(LONGEST_PAUSE, 2.0 ** min(over, 30)) if over >= 0 else 0.0) - now
        if wait > 0 or self._waiting >= CHECKS_WAITING:
            return max(wait, 2.0)
        # An attempt counts as wrong from its start, so that simultaneous ones are limited too.
        self._wrong[address] = (count + 1, now)
        self._wrong.move_to_end(address)
        if len(self._wrong) > MAX_ADDRESSES:
            self._wrong.popitem(last=False)
        keys = self._read_secrets()
        self._waiting += 1
        try:
            loop = asyncio.get_running_loop()
            right = await loop.run_in_executor(self._thread, check_password, keys, password)
        finally:
            self._waiting -= 1
        # The password may have been changed during the check.
        if not right or self._read_secrets().password_hash != keys.password_hash:
            return -1.0
        self._wrong.pop(address, None)
        return 0.0

    def open(self, request: Request, response: Response) -> None:
        """Log the browser in and set its cookie, of whose token only the hash is kept."""
        self._logins.pop(_hashed(_token(request)), None)
        token, now = secrets.token_urlsafe(32), self.clock()
        self._logins[_hashed(token)] = _Login(self._read_secrets().password_hash, now, now)
        if len(self._logins) > MAX_LOGINS:
            self._logins.popitem(last=False)
        _set_cookie(request, response, token)

    def close(self, request: Request, response: Response) -> None:
        """Log the browser out."""
        self._logins.pop(_hashed(_token(request)), None)
        response.delete_cookie(
            COOKIE,
            path=PATH,
            secure=request.url.scheme == "https",
            httponly=True,
            samesite="strict",
        )

    def visit(self, request: Request) -> str:
        """Return the browser's cookie token, or a new one, to which forms are bound."""
        return _token(request) or secrets.token_urlsafe(32)

    def set_visit(self, request: Request, response: Response, token: str) -> None:
        """Set the cookie to which the form of the login is bound."""
        _set_cookie(request, response, token)

    def form_token(self, token: str) -> str:
        """Return what forms of the browser with this cookie must contain."""
        return hmac.new(self._form_key, token.encode(), hashlib.sha256).hexdigest()

    async def form(self, request: Request) -> dict[str, str] | None:
        """Return the fields of a form, or None if its token is not valid for this browser."""
        fields, token = await _read_form(request), _token(request)
        wanted, given = self.form_token(token).encode(), fields.get("form_token", "").encode()
        return fields if token and hmac.compare_digest(wanted, given) else None

    def stop(self) -> None:
        """Stop the thread that checks passwords."""
        self._thread.shutdown(wait=False, cancel_futures=True)


def _token(request: Request) -> str:
    """Return the token in the browser's cookie, or an empty text."""
    return request.cookies.get(COOKIE, "")[:200]


def _hashed(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()


def _set_cookie(request: Request, response: Response, token: str) -> None:
    """Set the cookie of a login, or of a visit before login."""
    response.set_cookie(
        COOKIE,
        token,
        max_age=int(MAX_DURATION),
        path=PATH,
        secure=request.url.scheme == "https",
        httponly=True,
        samesite="strict",
    )


async def _read_form(request: Request) -> dict[str, str]:
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
