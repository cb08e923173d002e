"""Delays between login attempts, which grow with the number of failures."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

from physion.experiment.web.rate_limits import network_of

MAX_ADDRESSES = 10_000
"""Maximum number of addresses kept; the one with the oldest failure is dropped first."""
FORGET_AFTER = 3600.0
"""Seconds after the last failure at which the failures of an address are forgotten."""


@dataclass(frozen=True)
class Backoff:
    """Exponential backoff: no delay for ``free`` failures, then 1 s, doubled up to ``longest``."""

    free: int
    longest: float

    def after(self, failures: int) -> float:
        """Return the seconds to wait after this number of failures."""
        over = failures - self.free
        return 0.0 if over < 0 else min(self.longest, 2.0 ** min(over, 30))


BY_ADDRESS = Backoff(free=5, longest=900.0)
OVERALL = Backoff(free=50, longest=5.0)
"""Backoff for all addresses together. It is short: guessing from many addresses is slowed down, but
the experimenter is not locked out."""


@dataclass
class _Failures:
    """Number and time of the recent failures of one address, or of all."""

    count: int = 0
    last: float = 0.0

    def wait(self, waits: Backoff, now: float) -> float:
        if now - self.last > FORGET_AFTER:
            return 0.0
        return max(0.0, self.last + waits.after(self.count) - now)

    def add(self, now: float) -> None:
        self.count = 1 if now - self.last > FORGET_AFTER else self.count + 1
        self.last = now


class LoginAttempts:
    """Counter of failed login attempts by address and overall.

    An attempt counts as failed from its start (`begin`) until it succeeds, so that simultaneous
    attempts are limited too. An address that has logged in before is delayed by its own failures
    only. Times are seconds of a monotonic clock.
    """

    def __init__(self) -> None:
        self._by_address: OrderedDict[str, _Failures] = OrderedDict()
        self._overall = _Failures()
        self._trusted: OrderedDict[str, None] = OrderedDict()

    def begin(self, address: str, now: float) -> float:
        """Start an attempt: return 0 if it is allowed now, otherwise the seconds to wait."""
        network = network_of(address)
        failures = self._by_address.get(network, _Failures())
        wait = failures.wait(BY_ADDRESS, now)
        if network not in self._trusted:
            wait = max(wait, self._overall.wait(OVERALL, now))
        if wait > 0:
            return wait
        failures.add(now)
        self._overall.add(now)
        self._by_address[network] = failures
        self._by_address.move_to_end(network)
        while len(self._by_address) > MAX_ADDRESSES:
            self._by_address.popitem(last=False)
        return 0.0

    def succeeded(self, address: str) -> None:
        """Record that the password was right: the failures of the address are forgotten."""
        network = network_of(address)
        self._by_address.pop(network, None)
        self._overall.count = max(0, self._overall.count - 1)
        self._trusted[network] = None
        self._trusted.move_to_end(network)
        while len(self._trusted) > MAX_ADDRESSES:
            self._trusted.popitem(last=False)
