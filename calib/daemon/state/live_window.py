"""The readings of the last minutes, kept in memory: for the page when it opens, and to download."""

from collections import deque

import numpy as np

from calib.daemon.loop.loop_messages import Batch
from gcomp.arrays import Array

WINDOW_SECONDS = 600.0
"""Older readings are dropped [s]."""
READ = ("position", "torque")
"""Channels that are kept as the bus loop reports them."""


class LiveWindow:
    """One row per batch, ten times a second; rows are never changed once they are kept."""

    def __init__(self, n: int) -> None:
        self._unknown = np.full(n, np.nan)
        self._rows: deque[tuple[float, tuple[Array, ...]]] = deque()

    def append(self, batch: Batch) -> None:
        """Keep the newest sample of a batch, and the temperatures with it."""
        t = float(batch.t[-1])
        if self._rows and t <= self._rows[-1][0]:
            self._rows.clear()
        temperature = self._unknown if batch.temperature is None else batch.temperature
        self._rows.append((t, (*(batch.channels[name][-1].copy() for name in READ), temperature)))
        while self._rows[0][0] < t - WINDOW_SECONDS:
            self._rows.popleft()

    def rows(self, seconds: float, most: int) -> tuple[Array, dict[str, Array]]:
        """Times (K,) [s], monotonic, and channels (K, n) of the last `seconds`, thinned evenly to at most `most`.

        Channels are `position` [rad], `torque` as sent [N·m] and `temperature` [°C]; NaN if missing.
        """
        first = self._rows[-1][0] - seconds if self._rows else 0.0
        kept = [row for row in self._rows if row[0] >= first]
        step = max(1, -(-len(kept) // most))
        kept = kept[::-1][::step][::-1]  # the newest is always among them
        n = len(self._unknown)
        values = np.array([row[1] for row in kept]).reshape(len(kept), len(READ) + 1, n)
        channels = {name: values[:, k] for k, name in enumerate((*READ, "temperature"))}
        return np.array([row[0] for row in kept]), channels
