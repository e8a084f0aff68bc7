"""Statistics of the cycle on a bus: period, jitter, latency of readings, missed cycles, bus load.

A cycle begins with SYNC, of drives without SYNC with the command to the first of them that is commanded.
"""

import math
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np

from armlink.arrays import Array
from armlink.bus.frame_bits import frame_bits
from armlink.link.joints.groups import Group

KEPT_CYCLES = 1_000_000
"""Maximum number of cycles whose times are kept; more than an hour at 250 Hz."""
EDGES_MS = (0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.5, 10.0, 20.0, 50.0, 100.0)
"""Upper edges of the histogram's bins [ms]; the last bin is open."""


class CycleStats:
    """Collects statistics from every frame and its timestamp, in bus order."""

    def __init__(self, groups: Sequence[Group], period: float, bitrate: int) -> None:
        """`period` of the cycle [s] from the arm file, `bitrate` of the bus [bit/s]."""
        self._readings = frozenset(can_id | group.tag for group in groups for can_id in group.drives.reading_ids())
        syncs = [can_id | group.tag for group in groups for can_id in group.drives.cycle_ids()]
        self._begins = min(syncs, default=None)
        self._commands = frozenset(can_id | group.tag for group in groups for can_id in group.drives.commands())
        self._period, self._bitrate = period, bitrate
        self._periods, self._latencies = array("d"), array("d")
        self._waiting: set[int] = set()
        self._sync = self._last = self._first = math.nan
        self._bits = self._whole = self._missed = self._cycles = 0

    def take(self, stamp: float, can_id: int, data: bytes) -> None:
        if self._first == self._first:  # frames before the first SYNC belong to no whole cycle
            self._bits += frame_bits(can_id, data)
        if self._begins is None and can_id in self._commands:
            self._begins = can_id
        if can_id == self._begins:
            self._begin(stamp)
        elif can_id in self._waiting:
            self._waiting.discard(can_id)
            self._last = stamp

    def _begin(self, stamp: float) -> None:
        if self._sync == self._sync:
            period = stamp - self._sync
            lost = max(0, round(period / self._period) - 1)
            self._cycles += 1
            self._missed += lost + bool(self._waiting)
            if len(self._periods) < KEPT_CYCLES:
                self._periods.append(period)
                if not self._waiting:
                    self._latencies.append(self._last - self._sync)
        else:
            self._first = stamp
        self._whole = self._bits
        self._sync = stamp
        self._waiting = set(self._readings)

    def report(self) -> dict[str, Any]:
        """Statistics over all cycles for JSON (docs/formats.md, monitor); NaN if none was complete."""
        periods, latencies = np.array(self._periods) * 1e3, np.array(self._latencies) * 1e3
        at = np.percentile(latencies, (50, 99, 99.9, 100)).tolist() if latencies.size else [math.nan] * 4
        elapsed = self._sync - self._first
        return {
            "cycles": self._cycles,
            "missed": self._missed,
            "period_ms": float(periods.mean()) if periods.size else math.nan,
            "jitter_ms": float(periods.std()) if periods.size else math.nan,
            "longest_period_ms": float(periods.max()) if periods.size else math.nan,
            **dict(zip(("latency_p50_ms", "latency_p99_ms", "latency_p999_ms", "latency_max_ms"), at, strict=True)),
            "histogram": _histogram(latencies),
            "load": self._whole / (self._bitrate * elapsed) if elapsed > 0 else math.nan,
            "bus_ms_per_cycle": self._whole / self._bitrate * 1e3 / self._cycles if self._cycles else math.nan,
        }


def _histogram(latencies: Array) -> tuple[tuple[float, int], ...]:
    """Upper edge of each bin [ms] (inf for the last) and its count; empty bins at both ends are omitted."""
    counts = np.bincount(np.searchsorted(EDGES_MS, latencies), minlength=len(EDGES_MS) + 1)
    bins = list(zip((*EDGES_MS, math.inf), counts.tolist(), strict=True))
    filled = [i for i, (_, count) in enumerate(bins) if count]
    return tuple(bins[filled[0] : filled[-1] + 1]) if filled else ()
