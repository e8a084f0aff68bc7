"""Bits of a position reading that never change, found whatever zero the counts are taken from."""

import math
from collections.abc import Iterator

import numpy as np

from gcomp.arrays import Array

FEWEST = 8
"""Distinct positions from which a bit can be judged."""
CHANCE = 1e-4
"""Probability that a sound bit looks stuck by chance, above which nothing is said."""
AWAY, OFTEN = 6.0, 0.15
"""Counts by which a reading may lie off where the joint was sent; share of readings that must lie a bit's step off."""
DENSE, TURNS, MOTION = 0.45, 3, 24
"""Of a motion that tells all: the most that targets leave empty, as a share of the bit's weight; times round the
circle; distinct readings."""


def stuck_bits(position: Array, resolution: Array, target: Array) -> Iterator[tuple[int, int, float]]:
    """(joint, bit, its step [rad]) of each stuck bit in readings (K, n) of given resolution (n,).

    `target` (K, n) [rad] says where the joint should have been, NaN where not known. Raises nothing: where too little
    is known it yields nothing.
    """
    for joint in np.flatnonzero(resolution > 0):
        counts = np.rint(position[:, joint] / resolution[joint])
        asked = target[:, joint] / resolution[joint]
        bit = _by_target(counts, asked)
        if bit is None:
            bit = missing_bit(counts, asked)
        if bit is not None:
            yield int(joint), bit, float(2.0**bit * resolution[joint])


def bit_of(counts: float) -> int | None:
    """The bit whose weight a jump of this many counts is; None: of no bit. The joint may have turned a little."""
    bit = max(round(math.log2(max(counts, 1.0))), 1)
    return bit if abs(counts / 2.0**bit - 1) < 0.2 else None  # of the bit's weight


def _by_target(counts: Array, asked: Array) -> int | None:
    """The bit by whose weight many readings lie off their targets, and the others not at all."""
    off = np.abs(counts - asked)[np.isfinite(asked)]
    strange = off[off > AWAY]
    if len(off) < FEWEST or len(strange) < max(3, OFTEN * len(off)):
        return None
    bit = round(float(np.log2(np.median(strange))))
    if 2.0**bit < 4 * AWAY:
        return None
    return bit if np.mean(np.abs(strange - 2.0**bit) <= AWAY) > 0.8 else None


def missing_bit(counts: Array, asked: Array) -> int | None:
    """The bit that keeps the readings, taken round a circle of twice its weight, within one half of it; None: no such.

    Readings (K,) and the places that were asked for (any length), both in increments from whatever zero. A half that
    even the places asked for leave empty tells nothing.
    """
    distinct, wanted = np.unique(counts), np.unique(np.rint(asked[np.isfinite(asked)]))
    if len(distinct) < FEWEST or len(wanted) < FEWEST:
        return None
    bit = 1
    while 2**bit * 1.5 < np.ptp(distinct):  # the joint must have moved by more than the bit's step
        weight = 2.0**bit
        gap, points = _largest_gap(distinct, 2 * weight)
        expected, _ = _largest_gap(wanted, 2 * weight)
        by_chance = points * 0.5 ** (points - 1)
        if expected < DENSE * weight and np.ptp(distinct) > TURNS * 2 * weight and len(distinct) >= MOTION:
            by_chance = 0.0  # a motion through everything
        if gap >= weight + 0.5 and expected < 0.8 * weight and by_chance < CHANCE:
            return bit
        bit += 1
    return None


def _largest_gap(counts: Array, circle: float) -> tuple[float, int]:
    """(Largest gap between neighbours round a circle of counts, distinct places on it)."""
    places = np.unique(np.mod(counts, circle))
    gaps = np.diff(np.concatenate([places, places[:1] + circle]))
    return float(gaps.max()), len(places)
