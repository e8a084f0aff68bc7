"""Rate limit: a token bucket per address, for a bounded number of addresses."""

from collections import OrderedDict
from dataclasses import dataclass


@dataclass(frozen=True)
class Rate:
    """Size of a bucket, and the tokens it gains per second."""

    burst: float
    per_second: float


class RateLimit:
    """`take(key, now)` returns how long to wait [s]: 0 if a request may proceed."""

    def __init__(self, rate: Rate, keys: int = 1000) -> None:
        """Remembers the `keys` addresses seen last."""
        self.rate, self._keys = rate, keys
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, key: str, now: float, cost: float = 1.0) -> float:
        """Take `cost` tokens of the key's bucket at `now` [s], monotonic; returns the wait for enough [s]."""
        left, since = self._buckets.pop(key, (self.rate.burst, now))
        left = min(self.rate.burst, left + (now - since) * self.rate.per_second)
        wait = max(0.0, (1.0 - left) / self.rate.per_second)
        self._buckets[key] = (left if wait else left - cost, now)
        while len(self._buckets) > self._keys:
            self._buckets.popitem(last=False)
        return wait
