"""Who may see the experimenter's pages: one password, and logins in memory.

Nothing is written to disk: a restart of the server ends all logins. Browsers do not send the cookie
with requests from other sites (``SameSite=Strict``), and forms must come from a page of this
server. Passwords are checked one at a time, 50 ms each; a proxy limits the rate further.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from urllib.parse import parse_qsl, urlsplit

from starlette.requests import Request
from starlette.responses import Response

from physion.experiment.study.identity import Secrets, check_password, hash_token

PATH = "/experimenter"
COOKIE = "physion_experimenter"
IDLE_TIMEOUT = 2 * 3600.0
"""Seconds without a request by a person after which a login ends."""
MAX_DURATION = 12 * 3600.0
"""Maximum duration of a login in seconds."""
MAX_LOGINS = 100
"""Maximum number of logins; beyond it the oldest one ends."""
CHECKS_WAITING = 8
"""Maximum number of password checks in progress or queued."""
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
    "referrer-policy": "same-origin",
}
"""Headers of every page; the participants' pages, which recruiters embed, have weaker ones.
With "no-referrer", browsers would not say from which site a form comes."""


@dataclass
class _Login:
    """Login of one browser; times are seconds of a monotonic clock."""

    made: float
    seen: float


class Access:
    """Logins of one server process; to be used from its event loop only.

    Parameters
    ----------
    keys
        The keys of the study.
    clock
        Monotonic clock in seconds.
    """

    def __init__(self, keys: Secrets, clock: Callable[[], float] = time.monotonic) -> None:
        self._keys, self._clock = keys, clock
        self._logins: OrderedDict[str, _Login] = OrderedDict()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="password")
        self._waiting = 0

    def is_logged_in(self, request: Request) -> bool:
        """Return whether the browser is logged in.

        Each request resets the idle time, except those by which a page refreshes itself.
        """
        key, now = _hashed(request), self._clock()
        login = self._logins.get(key)
        if login is None:
            return False
        if now - login.made > MAX_DURATION or now - login.seen > IDLE_TIMEOUT:
            del self._logins[key]
            return False
        if request.query_params.get("auto") != "1":
            login.seen = now
        return True

    async def check(self, password: str) -> bool | None:
        """Return whether this is the password; None if too many checks wait."""
        if self._waiting >= CHECKS_WAITING:
            return None
        self._waiting += 1
        try:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._thread, check_password, self._keys, password)
        finally:
            self._waiting -= 1

    def open(self, request: Request, response: Response) -> None:
        """Log the browser in and set its cookie, of whose token only the hash is kept."""
        self._logins.pop(_hashed(request), None)
        token, now = secrets.token_urlsafe(32), self._clock()
        self._logins[hash_token(token)] = _Login(now, now)
        if len(self._logins) > MAX_LOGINS:
            self._logins.popitem(last=False)
        response.set_cookie(
            COOKIE,
            token,
            max_age=int(MAX_DURATION),
            path=PATH,
            secure=request.url.scheme == "https",
            httponly=True,
            samesite="strict",
        )

    def close(self, request: Request, response: Response) -> None:
        """Log the browser out."""
        self._logins.pop(_hashed(request), None)
        response.delete_cookie(COOKIE, path=PATH)

    def stop(self) -> None:
        """Stop the thread that checks passwords."""
        self._thread.shutdown(wait=False, cancel_futures=True)


def _hashed(request: Request) -> str:
    """Return the hash of the token in the browser's cookie."""
    return hash_token(request.cookies.get(COOKIE, ""))


async def read_form(request: Request) -> dict[str, str] | None:
    """Return the fields of a form; None if it is malformed, too large, or of another site."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    origin = urlsplit(request.headers.get("origin", "")).netloc
    if kind != "application/x-www-form-urlencoded" or origin != request.headers.get("host"):
        return None
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MAX_FORM:
            return None
    try:
        return dict(parse_qsl(body.decode("ascii"), keep_blank_values=True, max_num_fields=20))
    except ValueError:
        return None
