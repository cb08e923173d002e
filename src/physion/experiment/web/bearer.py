"""Read the bearer token of a request, in the same way for rate limits and for the endpoints."""

from __future__ import annotations

import re
from collections.abc import Iterable

_BEARER = re.compile(rb"bearer ([A-Za-z0-9_-]{1,200})", re.IGNORECASE)
"""A token of `identity.new_token`, without anything around it."""


def read_token(headers: Iterable[tuple[bytes, bytes]]) -> str:
    """Return the token of ``Authorization: Bearer TOKEN`` in the headers of an ASGI request.

    Returns an empty string if there is no or more than one such header, or another value: if a
    token could be written in two ways, the rate limits would count it as two tokens.
    """
    values = [value for name, value in headers if name == b"authorization"]
    match = _BEARER.fullmatch(values[0]) if len(values) == 1 else None
    return match[1].decode("ascii") if match else ""
