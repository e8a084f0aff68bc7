"""Bits of a position reading that never change, found whatever zero the counts are taken from."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
FEWEST = 8
"""Distinct positions from which a bit can be judged."""
CHANCE = 1e-4
"""Probability that a sound bit looks stuck by chance, above which nothing is said."""
SPAN = 1.5
"""How many times a bit's own step the joint must have moved for it to be judged."""


def stuck_bits(position: Array, resolution: Array, target: Array) -> Iterator[tuple[int, int, float]]:
    """(joint, bit, its step [rad]) of each stuck bit in readings (K, n) of given resolution (n,).

    A bit of weight w that is stuck keeps the reading, taken round a circle of 2w, within one half of it. `target`
    (K, n) [rad] says where the joint should have been, NaN where not known: a circle half that even the targets leave
    empty tells nothing.
    """
    for joint in np.flatnonzero(resolution > 0):
        step = resolution[joint]
        distinct = np.unique(np.rint(position[:, joint] / step))
        asked = target[:, joint]
        asked = np.unique(np.rint(asked[np.isfinite(asked)] / step))
        if len(distinct) < FEWEST or len(asked) < FEWEST:
            continue
        bit = 1
        while 2**bit * SPAN < np.ptp(distinct):
            weight = 2.0**bit
            gap, points = _largest_gap(distinct, 2 * weight)
            expected, _ = _largest_gap(asked, 2 * weight)
            chance = points * 0.5 ** (points - 1)
            if gap >= weight + 0.5 and expected < 0.8 * weight and chance < CHANCE:
                yield int(joint), bit, float(weight * step)
                break
            bit += 1


def _largest_gap(counts: Array, circle: float) -> tuple[float, int]:
    """(Largest gap between neighbours round a circle of counts, distinct places on it)."""
    places = np.unique(np.mod(counts, circle))
    gaps = np.diff(np.concatenate([places, places[:1] + circle]))
    return float(gaps.max()), len(places)
