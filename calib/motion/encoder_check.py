"""Are a joint's position readings those of a sound encoder? Judged while it moves, before anything relies on them."""

import math
from collections.abc import Iterator

import numpy as np

from armlink.errors import Refused
from armlink.link.types import Sample
from gcomp.arrays import Array, Mask

FEWEST = 8
"""Distinct positions from which a bit can be judged."""
CHANCE = 1e-4
"""Probability that a sound bit looks stuck by chance, above which nothing is said."""
LEAST_SPAN = 1.5
"""How many times a bit's own step the joint must have moved for it to be judged."""
AWAY, OFTEN = 6.0, 0.15
"""Counts by which a reading may lie off where the joint was sent; share of readings that must lie a bit's step off."""
DENSE, TURNS, MOTION = 0.45, 3, 24
"""Of a motion that tells all: the most that targets leave empty, as a share of the bit's weight; times round the
circle; distinct readings."""
JUMP_TOLERANCE = 0.2
"""Share of a bit's weight that a jump may differ from it."""
MOST_MISSING_SHARE = 0.02
"""Share of a motion's cycles without timely readings above which nothing is said of its encoders."""


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
    return bit if abs(counts / 2.0**bit - 1) < JUMP_TOLERANCE else None


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
    while 2**bit * LEAST_SPAN < np.ptp(distinct):
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


JUMP, JUMP_STEPS = 3.0, 4.0
"""A change of a position reading beyond this many times the speed limit, plus this many increments, is no motion."""


class EncoderFault(Refused):
    """A joint's position readings are none of a sound encoder."""

    def __init__(self, name: str, seen: str, bit: int | None) -> None:
        """Joint's name, what its readings did, and the bit that would do it."""
        cause = "the encoder or its cable" if bit is None else f"the encoder, since its bit {bit} is stuck or lost"
        super().__init__(f"{name}: {seen}: repair {cause}; until then no calibration of this joint is valid")


class EncoderCheck:
    """Sees every sample, and at the end of each motion what was read on the way."""

    def __init__(self, names: tuple[str, ...], step: Array, speed: Array, now: float, own_clock: Mask) -> None:
        """Of n joints whose readings change by at least `step` [rad], and that turn at most at `speed` [rad/s].

        `own_clock` (n,): whose drives send without being asked. What such a drive sent may have waited on its way for
        as long as nothing came before it.
        """
        self._names, self._step = names, step
        self._fastest, self._slack = JUMP * speed, JUMP_STEPS * step
        self._own_clock = own_clock
        self._read_at = np.full(len(names), now)
        self._read_before = self._read_at.copy()
        """Times of the last reading of each joint and of the one before it [s]."""
        self._delay = 0.0
        self._unsure = np.zeros(len(names), dtype=bool)
        """Whether the last reading of each joint was not timely: nothing is said of the way from there."""

    def forget(self) -> None:
        """Restart after an interruption: nothing is said of what happened meanwhile."""
        self._unsure[:] = True

    def see(self, sample: Sample, before: Array) -> None:
        """Raise EncoderFault if a position reading differs from the last one `before` it (n,) [rad] by more than its
        joint can have turned meanwhile. Only timely readings count, and of those the time between their SYNCs and what
        it took them to come."""
        if sample.timely is not None:
            self._unsure |= ~sample.timely
        moved = sample.position - before
        taken = np.where(self._own_clock, self._read_before, self._read_at)
        elapsed = sample.t - taken + max(sample.delay, self._delay)
        jumped = (np.abs(moved) > self._fastest * elapsed + self._slack) & ~self._unsure
        self._delay = sample.delay
        if np.count_nonzero(jumped):  # never of a reading that did not come: NaN
            joint = int(np.argmax(jumped))
            what = (
                f"its position reading jumped by {moved[joint]:+.3g} rad between two cycles, which no real "
                "motion can do"
            )
            raise EncoderFault(self._names[joint], what, bit_of(float(abs(moved[joint]) / self._step[joint])))
        came = np.isfinite(sample.position)
        np.copyto(self._read_before, self._read_at, where=came)
        np.copyto(self._read_at, sample.t, where=came)
        self._unsure &= ~(came if sample.timely is None else came & sample.timely)

    def judge(self, seen: Array, path: Array, movable: Mask, resolution: Array) -> None:
        """Raise EncoderFault where what a joint read on its way leaves out what one bit would have shown.

        seen (K, n) is what was read and path (K, n) where the `movable` joints were sent [rad]; `resolution` (n,) is
        the smallest change that was ever read, inf where none was: bits below it are never used.
        """
        if np.isnan(seen).any(axis=1).mean() > MOST_MISSING_SHARE:
            return
        step = np.where(np.isfinite(resolution), resolution, self._step)
        for joint in np.flatnonzero(movable):
            counts = np.rint(seen[:, joint] / step[joint])
            bit = missing_bit(counts[np.isfinite(counts)], path[:, joint] / step[joint])
            if bit is not None:
                what = (
                    f"every second step of its position reading is missing (steps of {2.0**bit * step[joint]:.3g} rad)"
                )
                unused = round(float(np.log2(step[joint] / self._step[joint])))
                raise EncoderFault(self._names[joint], what, bit + unused)
