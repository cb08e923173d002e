"""How many requests are let through: buckets that fill at a steady rate, in bounded memory."""

from __future__ import annotations

import ipaddress
from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from physion.experiment.study.study import Limits

MAX_BUCKETS = 20_000
"""So many addresses or tokens are remembered; the one not seen for longest is forgotten first."""
WRONG_TOKENS_PER_SECOND, WRONG_TOKENS_BURST = 2.0, 60.0
WRONG = (401, 422)
"""Answers to a token that opens nothing: it may be refused for what else is wrong before that."""
WITH_TOKEN = frozenset(
    f"/api/{name}"
    for name in ("session", "trials/familiarization", "trials/test", "page", "answers", "events",
                 "result")
)  # fmt: skip


class Buckets:
    """One bucket a key: ``burst`` requests at once, then ``rate`` a second."""

    def __init__(self, rate: float, burst: float, most: int = MAX_BUCKETS) -> None:
        self._rate, self._burst, self._most = rate, burst, most
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def __contains__(self, key: str) -> bool:
        return key in self._left

    def __len__(self) -> int:
        return len(self._left)

    def wait(self, key: str, now: float) -> float:
        """Seconds until one more is let through; 0 for at once. Takes nothing."""
        left, since = self._left.get(key, (self._burst, now))
        missing = 1.0 - min(self._burst, left + (now - since) * self._rate)
        return max(0.0, missing / self._rate)

    def take(self, key: str, now: float) -> float:
        """As `wait`, and where that is 0, takes one."""
        left, since = self._left.get(key, (self._burst, now))
        left = min(self._burst, left + (now - since) * self._rate)
        missing = 1.0 - left
        self._left[key] = (left if missing > 0 else left - 1.0, now)
        self._left.move_to_end(key)
        if len(self._left) > self._most:
            self._left.popitem(last=False)
        return max(0.0, missing / self._rate)


class RateLimits:
    """The limits of one server: by token, and by address for entering.

    A token is known, and has a bucket of its own, once the server has given it out or it has opened
    a session: invented ones fill no memory. They spend from the bucket of unknown tokens of their
    address, which keeps out nobody who is known. The experimenter's login has waits of its own.
    """

    def __init__(self, limits: Limits) -> None:
        per_second = limits.sessions_per_minute / 60.0
        self._tokens = Buckets(limits.requests_per_second, float(limits.burst))
        self._entering = Buckets(per_second, float(limits.sessions_at_once))
        self._wrong = Buckets(WRONG_TOKENS_PER_SECOND, WRONG_TOKENS_BURST)

    def before(self, method: str, path: str, token: str, address: str, now: float) -> float:
        """Seconds that this request has to wait; 0 lets it through."""
        if method == "POST" and path == "/api/enter":
            return self._entering.take(network_of(address), now)
        if path not in WITH_TOKEN:
            return 0.0
        if token in self._tokens:
            return self._tokens.take(token, now)
        return self._wrong.wait(network_of(address), now)

    def after(self, status: int, path: str, token: str, address: str, now: float) -> None:
        """Learn from the status of the answer whether the token opens anything."""
        if path not in WITH_TOKEN:
            return
        if token in self._tokens:
            return
        if status == 200:
            self._tokens.take(token, now)
        elif status in WRONG:
            self._wrong.take(network_of(address), now)

    def gave_out(self, token: str, now: float) -> None:
        """A token is known from the moment that it is given to somebody who entered."""
        self._tokens.take(token, now)


def network_of(address: str) -> str:
    """The address; of IPv6 its first 64 bits, all of which one household may use."""
    if ":" not in address:
        return address
    try:
        whole = ipaddress.IPv6Address(address.partition("%")[0])
    except ValueError:
        return address
    mapped = whole.ipv4_mapped
    return str(mapped) if mapped else str(ipaddress.IPv6Network((whole, 64), strict=False))
