"""Time, injected: the machine's monotonic clock in production, a simulated one in lock-step and in tests."""

import time
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock [s]."""

    def now(self) -> float:
        """Seconds since an arbitrary instant."""

    def sleep_until(self, instant: float) -> None:
        """Return when `now()` has reached `instant` [s]; at once if it already has."""


class MonotonicClock:
    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, instant: float) -> None:
        remaining = instant - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)
