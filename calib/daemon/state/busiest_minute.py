"""The minute in which the arm moved most, kept in memory at the full rate: what the diagnosis of the day looks at.

The recordings' rows are too far apart for it: an acceleration of a tenth of a second falls between those of 25 Hz.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armlink.arrays import Array
from armlink.recording.mcap import RecordingWriter
from calib.daemon.loop.loop_messages import Batch

SECONDS = 60.0
"""Length of a minute; a pause in the samples ends it before [s]."""
LONGEST_PAUSE = 1.0
"""Longest pause in the samples within a minute [s]."""
ROW_RATE = 250.0
"""Rows are thinned to about this rate if the bus is faster [Hz]."""


Rows = tuple[Array, dict[str, NDArray[np.float32]]]
"""Times (K,) [s], and channels (K, n)."""


@dataclass(frozen=True)
class Minute:
    """Rows at the full rate."""

    travel: float
    """Path of all joints together [rad]."""
    parts: tuple[Rows, ...]

    def write(self, path: Path, names: tuple[str, ...]) -> Iterator[None]:
        """Write an MCAP recording in parts, so that other work can go on between them; raises OSError."""
        begun, written = self.parts[0][0][0], 0
        with RecordingWriter(path, names) as writer:
            for t, channels in self.parts:
                for k, at in enumerate((t - begun).tolist()):
                    writer.append(at, {name: values[k] for name, values in channels.items()})
                written += len(t)
                if written >= 300:  # some hundredths of a second
                    written = 0
                    yield


class BusiestMinute:
    """Takes all samples, and keeps the minute with the most motion since it was asked last."""

    def __init__(self, rate: float) -> None:
        """For samples at `rate` [Hz]."""
        self._stride = max(1, round(rate / ROW_RATE))
        self._parts: list[Rows] = []
        self._travel = 0.0
        self._at: Array | None = None
        self._best: Minute | None = None

    def append(self, batch: Batch) -> None:
        t = batch.t[:: self._stride].copy()
        if self._parts and not 0.0 <= t[0] - self._parts[-1][0][-1] <= LONGEST_PAUSE:
            self._end()
        self._parts.append((t, {name: x[:: self._stride].astype(np.float32) for name, x in batch.channels.items()}))
        at = batch.channels["position"][-1]
        if self._at is not None:
            self._travel += float(np.nansum(np.abs(at - self._at)))
        self._at = at
        if t[-1] - self._parts[0][0][0] >= SECONDS:
            self._end()

    def take(self, least: float) -> Minute | None:
        """The busiest minute if its path is `least` [rad] or more; the search begins again then."""
        found = self._best
        if found is None or found.travel < least:
            return None
        self._best = None
        return found

    def _end(self) -> None:
        if self._best is None or self._travel > self._best.travel:
            self._best = Minute(self._travel, tuple(self._parts))
        self._parts, self._travel, self._at = [], 0.0, None
