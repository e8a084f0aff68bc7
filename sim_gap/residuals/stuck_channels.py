"""Stuck channels: a reading that repeats to the last bit while the arm moves carries no information."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armlink.recording.recording import Recording
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import CHANNELS, Signals

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


def without_stuck(s: Signals, recording: Recording) -> tuple[Signals, tuple[Stuck, ...]]:
    """The signals with stuck readings marked as not known, and the list of them."""
    known, found = dict(s.known), []
    for channel in s.channels:
        values = getattr(recording, CHANNELS[channel])
        for joint in range(s.n):
            there = np.isfinite(values[:, joint])
            held = s.moving[:, joint] == 0.0 if channel != "tau" else np.zeros(len(s.t), bool)
            still = _still(s, joint, held, recording.t[there] - recording.t[0], values[there, joint])
            if still:
                marked = known[channel].copy()
                for start, end in still:
                    marked[(s.t >= start) & (s.t <= end), joint] = 0.0
                known[channel] = marked
                found.append(Stuck(channel, joint, sum(end - start for start, end in still)))
    return replace(s, known=known), tuple(found)


def _still(s: Signals, joint: int, held: NDArray[np.bool_], t: Array, x: Array) -> list[tuple[float, float]]:
    """Intervals of time in which the reading repeats although the torque changes.

    At zero and at the largest reading it may repeat, as with a dead band and a clipped sensor. So may the motor of a
    joint that is `held` at rest, (K,): friction takes up the change.
    """
    changes = np.flatnonzero(np.diff(x) != 0.0)
    starts, ends = np.r_[0, changes + 1], np.r_[changes, len(x) - 1]
    out = []
    model = s.model[:, joint]
    least = max(MOVED * float(np.ptp(model)), MOVED_NM)
    for a, b in zip(starts.tolist(), ends.tolist(), strict=True):
        if t[b] - t[a] < LONGEST_S:
            continue
        natural = len(changes) > 0 and (x[a] == 0.0 or abs(x[a]) >= np.abs(x).max())
        meanwhile = (s.t >= t[a]) & (s.t <= t[b]) & ~held
        if not natural and meanwhile.any() and np.ptp(model[meanwhile]) > least:
            out.append((float(t[a]), float(t[b])))
    return out
