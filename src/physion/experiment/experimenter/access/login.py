"""Logins of experimenters: kept in memory, identified by a cookie; and tokens of forms.

Nothing is written to disk: a restart of the server ends all logins, a new password those of its
account.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections import OrderedDict
from dataclasses import dataclass

from physion.experiment.study.identity import Account

COOKIE = "physion_experimenter"
PATH = "/experimenter"
IDLE_TIMEOUT = 2 * 3600.0
"""Seconds without a request by a person after which a login ends."""
MAX_DURATION = 12 * 3600.0
"""Maximum duration of a login in seconds."""
CONFIRMED_FOR = 600.0
"""Seconds for which the payments page stays open after the password was given again."""
MAX_LOGINS = 100
"""Maximum number of logins; beyond it the oldest one ends."""


@dataclass
class Login:
    """Login of one browser; times are seconds of a monotonic clock.

    ``account``: whose login it is, as the account was last read.
    """

    account: Account
    made: float
    seen: float
    confirmed: float | None = None

    def is_over(self, now: float) -> bool:
        """Return whether the login is too old or was idle for too long."""
        return now - self.made > MAX_DURATION or now - self.seen > IDLE_TIMEOUT

    def may_see_payments(self, now: float) -> bool:
        """Return whether the password was given again recently."""
        return self.confirmed is not None and now - self.confirmed <= CONFIRMED_FOR


class LoginRegistry:
    """All logins of one server process, stored by the hash of their token."""

    def __init__(self) -> None:
        self._open: OrderedDict[str, Login] = OrderedDict()
        self._form_key = secrets.token_bytes(32)

    def open(self, account: Account, now: float) -> str:
        """Open a login; return its token for the cookie, of which only the hash is kept."""
        token = new_cookie_token()
        self._open[_hashed(token)] = Login(account, now, now)
        while len(self._open) > MAX_LOGINS:
            self._open.popitem(last=False)
        return token

    def find(self, token: str, now: float, by_person: bool = True) -> Login | None:
        """Return the login of a token, or None if there is none or it has ended.

        ``by_person``: the request was made by a person, which resets the idle time; automatic
        refreshes do not.
        """
        key = _hashed(token)
        login = self._open.get(key)
        if login is None:
            return None
        if login.is_over(now):
            del self._open[key]
            return None
        if by_person:
            login.seen = now
        return login

    def close(self, token: str) -> None:
        """End the login of this token, if there is one."""
        self._open.pop(_hashed(token), None)

    def form_token(self, token: str) -> str:
        """Return the token that forms of the browser with this cookie must contain."""
        return hmac.new(self._form_key, token.encode(), hashlib.sha256).hexdigest()

    def is_form_token(self, token: str, given: str) -> bool:
        """Return whether ``given`` is the form token of the browser with this cookie."""
        return bool(token) and hmac.compare_digest(
            self.form_token(token).encode(), given.encode("utf-8", "replace")
        )


def new_cookie_token() -> str:
    """Return a random token for a cookie (256 bits)."""
    return secrets.token_urlsafe(32)


def _hashed(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()
