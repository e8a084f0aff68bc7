"""Stuck channels: a reading that repeats to the last bit while the arm moves carries no information."""

from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array, Mask

LONGEST_S = 2.0
"""Longest time for which a reading may repeat [s]."""
MOVED, MOVED_NM = 0.1, 0.2
"""Least change of the model torque meanwhile: as a share of its range, and [N·m]."""


@dataclass(frozen=True)
class Stuck:
    """One joint's stuck channel, and for how long in total."""

    channel: str
    joint: int
    seconds: float


def stuck_intervals(time: Array, model: Array, held: Mask, t: Array, reading: Array) -> list[tuple[float, float]]:
    """Intervals of time [s] in which a joint's reading repeats although its torque changes.

    `model` is the nominal torque [N·m] at `time`, (K,); `reading` holds the finite values at `t`, (k,). At zero and at
    the largest reading it may repeat, as with a dead band and a clipped sensor. So may the motor of a joint that is
    `held` at rest, (K,): friction takes up the change.
    """
    changes = np.flatnonzero(np.diff(reading) != 0.0)
    starts, ends = np.r_[0, changes + 1], np.r_[changes, len(reading) - 1]
    out = []
    least = max(MOVED * float(np.ptp(model)), MOVED_NM)
    long = t[ends] - t[starts] >= LONGEST_S
    for a, b in zip(starts[long].tolist(), ends[long].tolist(), strict=True):
        natural = len(changes) > 0 and (reading[a] == 0.0 or abs(reading[a]) >= np.abs(reading).max())
        meanwhile = (time >= t[a]) & (time <= t[b]) & ~held
        if not natural and meanwhile.any() and np.ptp(model[meanwhile]) > least:
            out.append((float(t[a]), float(t[b])))
    return out
