"""How long someone has to wait before the next try of a password."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

from physion.experiment.web.rate_limits import network_of

ADDRESSES = 10_000
"""Addresses that are kept; beyond that the one that failed longest ago is forgotten."""
FORGET_AFTER = 3600.0
"""Seconds without a failure after which the failures of an address are forgotten."""


@dataclass(frozen=True)
class Waits:
    """``free`` failures cost nothing; then the wait doubles from one second up to ``longest``."""

    free: int
    longest: float

    def after(self, failures: int) -> float:
        """Seconds to wait after so many failures."""
        over = failures - self.free
        return 0.0 if over < 0 else min(self.longest, 2.0 ** min(over, 30))


BY_ADDRESS = Waits(free=5, longest=900.0)
OVERALL = Waits(free=50, longest=5.0)
"""For all addresses together. It is short, so that whoever guesses from many addresses is slowed
down without the experimenter being locked out."""


@dataclass
class _Failures:
    count: int = 0
    last: float = 0.0

    def wait(self, waits: Waits, now: float) -> float:
        if now - self.last > FORGET_AFTER:
            return 0.0
        return max(0.0, self.last + waits.after(self.count) - now)

    def add(self, now: float) -> None:
        self.count = 1 if now - self.last > FORGET_AFTER else self.count + 1
        self.last = now


class Attempts:
    """Counts failures by address and overall. Times are seconds of any steady clock.

    A try is counted as failed when it begins (`begin`) and taken back when it succeeds, so that
    many tries at once do not all pass before the first of them has failed. An address that has
    succeeded before waits for its own failures alone.
    """

    def __init__(self) -> None:
        self._by_address: OrderedDict[str, _Failures] = OrderedDict()
        self._overall = _Failures()
        self._trusted: OrderedDict[str, None] = OrderedDict()

    def begin(self, address: str, now: float) -> float:
        """0 where a try may be made now, which is then counted; else the seconds to wait."""
        who = network_of(address)
        own = self._by_address.get(who, _Failures())
        wait = own.wait(BY_ADDRESS, now)
        if who not in self._trusted:
            wait = max(wait, self._overall.wait(OVERALL, now))
        if wait > 0:
            return wait
        own.add(now)
        self._overall.add(now)
        self._by_address[who] = own
        self._by_address.move_to_end(who)
        while len(self._by_address) > ADDRESSES:
            self._by_address.popitem(last=False)
        return 0.0

    def succeeded(self, address: str) -> None:
        """The password was right: the address begins anew."""
        who = network_of(address)
        self._by_address.pop(who, None)
        self._overall.count = max(0, self._overall.count - 1)
        self._trusted[who] = None
        self._trusted.move_to_end(who)
        while len(self._trusted) > ADDRESSES:
            self._trusted.popitem(last=False)
