"""Who is logged in: sessions in memory, their cookie, and the tokens of forms.

Nothing is written to disk: a restart of the server logs everybody out, and so does another
password.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections import OrderedDict
from dataclasses import dataclass

COOKIE = "physion_experimenter"
PATH = "/experimenter"
IDLE = 2 * 3600.0
"""Seconds without anything being asked for by a person after which a login ends."""
LONGEST = 12 * 3600.0
"""Seconds after which a login ends in any case."""
CONFIRMED_FOR = 600.0
"""Seconds for which the password, given once more, opens the page of payments."""
AT_MOST = 100
"""Logins kept at once; beyond that the oldest ends."""


@dataclass
class Login:
    """One browser that gave the password; times are seconds of a steady clock."""

    made: float
    seen: float
    confirmed: float | None = None

    def is_over(self, now: float) -> bool:
        """Too old, or idle for too long."""
        return now - self.made > LONGEST or now - self.seen > IDLE

    def may_see_payments(self, now: float) -> bool:
        """Was the password given a short while ago?"""
        return self.confirmed is not None and now - self.confirmed <= CONFIRMED_FOR


class Logins:
    """The logins of one server process, by the hash of their token."""

    def __init__(self) -> None:
        self._open: OrderedDict[str, Login] = OrderedDict()
        self._form_key = secrets.token_bytes(32)
        self.under = ""
        """The hash of the password with which all of them were opened."""

    def password_is(self, under: str) -> None:
        """The password has this hash now: with another one than before, all logins end."""
        if under != self.under:
            self._open.clear()
            self.under = under

    def open(self, now: float) -> str:
        """A new login; its token goes into the cookie and is not kept."""
        token = new_visit()
        self._open[_hashed(token)] = Login(now, now)
        while len(self._open) > AT_MOST:
            self._open.popitem(last=False)
        return token

    def find(self, token: str, now: float, by_person: bool = True) -> Login | None:
        """The login of a token, None where there is none or it is over.

        ``by_person``: someone asked for this, so the login is not idle; a page that refreshes
        by itself does not keep it open.
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
        """Ends a login, if there is one."""
        self._open.pop(_hashed(token), None)

    def form_token(self, token: str) -> str:
        """What every form of the browser with this cookie has to bring."""
        return hmac.new(self._form_key, token.encode(), hashlib.sha256).hexdigest()

    def is_form_token(self, token: str, given: str) -> bool:
        """Does a form come from a page that this browser was given?"""
        return bool(token) and hmac.compare_digest(
            self.form_token(token).encode(), given.encode("utf-8", "replace")
        )


def new_visit() -> str:
    """A random word for a cookie; 256 bits."""
    return secrets.token_urlsafe(32)


def _hashed(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()
