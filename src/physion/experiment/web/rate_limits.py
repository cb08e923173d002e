"""Rate limits of requests: token buckets in bounded memory."""

from __future__ import annotations

import ipaddress
from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from physion.experiment.study.study import Limits

MAX_BUCKETS = 20_000
"""Number of addresses or tokens remembered; the least recently used are dropped first."""
WRONG_TOKENS_PER_SECOND, WRONG_TOKENS_BURST = 2.0, 60.0
WRONG = (401, 422)
"""Statuses of responses to unknown tokens; 422 since an invalid body is refused first."""
WITH_TOKEN = frozenset(
    f"/api/{name}"
    for name in ("session", "trials/familiarization", "trials/test", "page", "showings", "answers",
                 "events", "result", "ending", "jump")
)  # fmt: skip


class Buckets:
    """Token buckets by key: ``burst`` requests at once, then ``rate`` per second."""

    def __init__(self, rate: float, burst: float, most: int = MAX_BUCKETS) -> None:
        self._rate, self._burst, self._most = rate, burst, most
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def __contains__(self, key: str) -> bool:
        return key in self._left

    def __len__(self) -> int:
        return len(self._left)

    def wait(self, key: str, now: float) -> float:
        """Return the seconds until the next request is allowed, without counting one."""
        left, since = self._left.get(key, (self._burst, now))
        missing = 1.0 - min(self._burst, left + (now - since) * self._rate)
        return max(0.0, missing / self._rate)

    def take(self, key: str, now: float) -> float:
        """Return the seconds as `wait`; if they are 0, count one request."""
        left, since = self._left.get(key, (self._burst, now))
        left = min(self._burst, left + (now - since) * self._rate)
        missing = 1.0 - left
        self._left[key] = (left if missing > 0 else left - 1.0, now)
        self._left.move_to_end(key)
        if len(self._left) > self._most:
            self._left.popitem(last=False)
        return max(0.0, missing / self._rate)


class RateLimits:
    """Rate limits of one server: per token, and per client address for entering.

    A token is known, and gets its own bucket, once the server has issued it or it has been accepted
    for a session; invented tokens use no memory. Requests with unknown tokens share one bucket per
    address, which does not limit known tokens. The experimenter's login has its own limits.
    """

    def __init__(self, limits: Limits) -> None:
        per_second = limits.sessions_per_minute / 60.0
        self._tokens = Buckets(limits.requests_per_second, float(limits.burst))
        self._entering = Buckets(per_second, float(limits.sessions_at_once))
        self._wrong = Buckets(WRONG_TOKENS_PER_SECOND, WRONG_TOKENS_BURST)

    def wait_time(self, method: str, path: str, token: str, address: str, now: float) -> float:
        """Return the seconds that a request has to wait; 0 if it is allowed now.

        Parameters
        ----------
        method, path
            HTTP method and path of the request.
        token
            Its bearer token, or an empty string.
        address
            IP address of the client.
        now
            Time of a monotonic clock in seconds.
        """
        if method == "POST" and path == "/api/enter":
            return self._entering.take(network_of(address), now)
        if path not in WITH_TOKEN:
            return 0.0
        if token in self._tokens:
            return self._tokens.take(token, now)
        return self._wrong.wait(network_of(address), now)

    def record_status(self, status: int, path: str, token: str, address: str, now: float) -> None:
        """Update the buckets with the status of a response, which shows if the token is known."""
        if path not in WITH_TOKEN:
            return
        if token in self._tokens:
            return
        if status == 200:
            self._tokens.take(token, now)
        elif status in WRONG:
            self._wrong.take(network_of(address), now)

    def add_token(self, token: str, now: float) -> None:
        """Make a newly issued token known."""
        self._tokens.take(token, now)


def network_of(address: str) -> str:
    """Return the address, or its /64 network for IPv6, since one household has all of that."""
    if ":" not in address:
        return address
    try:
        whole = ipaddress.IPv6Address(address.partition("%")[0])
    except ValueError:
        return address
    mapped = whole.ipv4_mapped
    return str(mapped) if mapped else str(ipaddress.IPv6Network((whole, 64), strict=False))
