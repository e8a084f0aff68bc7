"""Ripple of a joint's torque over its angle, as of a gear's teeth or the motor's poles: its periods in a turn.

Ripple is the same in both directions and in every sweep of its joint. One whose period is longer than a bin is not
averaged out: as a residual it would widen the intervals of friction, which it does not touch, and those of gravity,
whose course is much slower. Its strongest line is therefore searched for in the half sums of both directions, and the
fit has its cosine and sine as unknowns.
"""

import numpy as np
from numpy.typing import NDArray

from calib.creep.rows import CreepRows
from gcomp.arrays import Array

LEAST_PERIODS = 2.0
"""Periods over the way of a sweep that a ripple has at least: slower ones could be gravity's."""
OVERSAMPLING = 16
"""Tried frequencies per reciprocal of the joint's way."""
LEAST_BINS = 8
"""Bins of a joint, over all its sweeps, in which a ripple is searched for."""
CLEAR = 12.0
"""Least power of a line, in twice the variance that is left without it: chance gives it once in 160,000 frequencies."""


def ripple_cycles(rows: CreepRows, residual: Array, n: int) -> Array:
    """Periods in a turn of the clearest ripple of each of n joints (n,); 0 where none is clear."""
    cycles = np.zeros(n)
    for joint in range(n):
        own = np.flatnonzero(rows.joint == joint)
        if own.size >= 2 * LEAST_BINS:
            cycles[joint] = _clearest_cycles(rows, residual, joint, own)
    return cycles


def _clearest_cycles(rows: CreepRows, residual: Array, joint: int, own: NDArray[np.intp]) -> float:
    position, spacing, way = rows.position[own, joint], [], []
    for sweep in np.unique(rows.sweep[own]):
        one = np.sort(position[(rows.sweep[own] == sweep) & (rows.side[own] > 0)])
        if one.size > 2:
            spacing.append(float(np.median(np.diff(one))))
            way.append(float(np.ptp(one)))
    if not way:
        return 0.0
    lowest, highest = 2 * np.pi * LEAST_PERIODS / max(way), np.pi / float(np.median(spacing))
    tried = np.arange(lowest, highest, 2 * np.pi / float(np.ptp(position)) / OVERSAMPLING)
    left = residual[own] - residual[own].mean()
    powers = np.array([_explained_power(left, position, each) for each in tried])
    best = int(np.argmax(powers)) if powers.size else 0
    rest = (float(left @ left) - float(powers.max(initial=0.0))) / (own.size - 3)
    return float(tried[best]) if powers.max(initial=0.0) > 2 * CLEAR * max(rest, 1e-30) else 0.0


def _explained_power(left: Array, position: Array, cycles: float) -> float:
    """Part of the sum of squares of `left` that cosine and sine of so many periods a turn explain."""
    waves = np.stack([np.cos(cycles * position), np.sin(cycles * position)], axis=1)
    return float(left @ waves @ np.linalg.lstsq(waves, left, rcond=None)[0])
