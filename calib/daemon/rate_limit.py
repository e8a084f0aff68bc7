"""So many at once and so many a second: requests of an address, lines of a logger."""

from collections import OrderedDict
from dataclasses import dataclass

MOST_KEYS = 1000
"""Addresses or loggers seen last that are remembered."""


@dataclass(frozen=True)
class Rate:
    """Size of a bucket, and the tokens it gains per second."""

    burst: float
    per_second: float


class RateLimit:
    def __init__(self, rate: Rate) -> None:
        self.rate = rate
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, key: str, now: float) -> float:
        """Take a token of the key's bucket at `now` [s]; returns the wait until there is one [s], 0 if it is taken."""
        left, since = self._buckets.pop(key, (self.rate.burst, now))
        left = min(self.rate.burst, left + max(now - since, 0.0) * self.rate.per_second)
        wait = max(0.0, (1.0 - left) / self.rate.per_second)
        self._buckets[key] = (left if wait else left - 1.0, now)
        while len(self._buckets) > MOST_KEYS:
            self._buckets.popitem(last=False)
        return wait
