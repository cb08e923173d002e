"""The token that a request carries, read in one way by who counts requests and who answers them."""

from __future__ import annotations

import re
from collections.abc import Iterable

_BEARER = re.compile(rb"bearer ([A-Za-z0-9_-]{1,200})", re.IGNORECASE)
"""What `identity.new_token` makes, and nothing around it: one token is written in one way."""


def read_token(headers: Iterable[tuple[bytes, bytes]]) -> str:
    """The token of ``Authorization: Bearer TOKEN`` in the headers of an ASGI request.

    Empty where there is none, more than one such header, or anything else in it: a token that
    could be written in two ways would be counted as two.
    """
    given = [value for name, value in headers if name == b"authorization"]
    found = _BEARER.fullmatch(given[0]) if len(given) == 1 else None
    return found[1].decode("ascii") if found else ""
