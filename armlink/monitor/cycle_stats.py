"""What a bus shows of its cycle: period and jitter of SYNC, time from SYNC to the last reading, missed cycles, load."""

import math
from array import array
from dataclasses import asdict, dataclass

import numpy as np

from armlink.arrays import Array
from armlink.bus.frame_bits import frame_bits
from armlink.canopen.object_dictionary import SYNC_ID
from armlink.canopen.pdo import TPDO1

KEPT = 1_000_000
"""Cycles whose times are kept; over an hour at 250 Hz."""
EDGES_MS = (0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.5, 10.0, 20.0, 50.0, 100.0)
"""Upper ends of the histogram's bins [ms]; the last bin is open."""


@dataclass(frozen=True)
class CycleReport:
    """Figures over all cycles so far; NaN where no cycle was complete. Times in milliseconds."""

    cycles: int
    """SYNC to SYNC."""
    missed: int
    """Cycles in which a joint's reading (TPDO1) did not come before the next SYNC, or whose own SYNC did not come."""
    period_ms: float
    jitter_ms: float
    """Standard deviation of the period."""
    longest_period_ms: float
    latency_p50_ms: float
    """SYNC to the last joint's TPDO1, of complete cycles."""
    latency_p99_ms: float
    latency_p999_ms: float
    latency_max_ms: float
    histogram: tuple[tuple[float, int], ...]
    """Upper end of each bin of the latency [ms] (inf for the last) and its cycles; empty bins at both ends left out."""
    load: float
    """Share of the time that frames occupied the bus, stuff bits computed from what they carried."""
    bus_ms_per_cycle: float
    """Time a cycle's frames take on the wire: what every cycle waits for, however fast the host."""


class CycleStats:
    """Fed with every frame and its time stamp, in the order of the bus."""

    def __init__(self, nodes: tuple[int, ...], period: float, bitrate: int) -> None:
        """`period` of SYNC [s] as the arm file has it, `bitrate` of the bus."""
        self._readings = frozenset(TPDO1.cob_base + node for node in nodes)
        self._period, self._bitrate = period, bitrate
        self._periods, self._latencies = array("d"), array("d")
        self._waiting: set[int] = set()
        self._sync = self._last = self._first = math.nan
        self._bits = self._whole = self._missed = self._cycles = 0

    def take(self, stamp: float, can_id: int, data: bytes) -> None:
        """Count a frame that came at `stamp` [s]."""
        if self._first == self._first:  # what came before the first SYNC is no whole cycle
            self._bits += frame_bits(can_id, data)
        if can_id == SYNC_ID:
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
            if len(self._periods) < KEPT:
                self._periods.append(period)
                if not self._waiting:
                    self._latencies.append(self._last - self._sync)
        else:
            self._first = stamp
        self._whole = self._bits
        self._sync = stamp
        self._waiting = set(self._readings)

    def report(self) -> CycleReport:
        """The figures so far."""
        periods, latencies = np.array(self._periods) * 1e3, np.array(self._latencies) * 1e3
        at = np.percentile(latencies, (50, 99, 99.9, 100)).tolist() if latencies.size else [math.nan] * 4
        elapsed = self._sync - self._first
        return CycleReport(
            cycles=self._cycles,
            missed=self._missed,
            period_ms=float(periods.mean()) if periods.size else math.nan,
            jitter_ms=float(periods.std()) if periods.size else math.nan,
            longest_period_ms=float(periods.max()) if periods.size else math.nan,
            latency_p50_ms=at[0],
            latency_p99_ms=at[1],
            latency_p999_ms=at[2],
            latency_max_ms=at[3],
            histogram=_histogram(latencies),
            load=self._whole / (self._bitrate * elapsed) if elapsed > 0 else math.nan,
            bus_ms_per_cycle=self._whole / self._bitrate * 1e3 / self._cycles if self._cycles else math.nan,
        )

    def as_json(self) -> dict[str, object]:
        """The report by the names of its fields."""
        return asdict(self.report())


def _histogram(latencies: Array) -> tuple[tuple[float, int], ...]:
    counts = np.bincount(np.searchsorted(EDGES_MS, latencies), minlength=len(EDGES_MS) + 1)
    bins = list(zip((*EDGES_MS, math.inf), counts.tolist(), strict=True))
    filled = [i for i, (_, count) in enumerate(bins) if count]
    return tuple(bins[filled[0] : filled[-1] + 1]) if filled else ()
