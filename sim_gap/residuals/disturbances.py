"""Disturbances: moments at which several joints at once are far from what they do all the rest of the time.

Something touches the arm, or a burst of torques is misread. A property of the arm would show whenever it moves like
that, so that such a moment says nothing of it. Its samples are left out of the comparison, and it is reported.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, label, maximum_filter1d

from gcomp.arrays import Array, Mask

FAR = 8.0
"""A residual is far off from this many standard deviations of what usually remains (by its median)."""
JOINTS, SHARE = 3, 0.5
"""Least number of joints that are far off at once, and least share of those that are judged then."""
AT_ONCE_S = 0.12
"""Time within which joints are far off at once [s]."""
AROUND_S = 0.2
"""Time before and after that is left out, too: the length of the comparison's low pass [s]."""
LONGEST_S = 0.6
"""Longest disturbance, without the time around it [s]: what lasts is a property of the arm, or a body it took up."""
RARE = 0.02
"""Largest share of a recording's time that is disturbed: what happens more often is a property of the arm."""


@dataclass(frozen=True)
class Disturbance:
    """One disturbance: its time since the start of the recording [s], the largest residual [N·m] and its joint."""

    start: float
    end: float
    joint: int
    torque: float


def are_far_off(left: Array, valid: Mask, noise: float, margin: float) -> Mask:
    """Samples of one row at which what remains (K,) is far from usual and more than noise and margin [N·m], (K,)."""
    if not valid.any():
        return np.zeros(len(left), bool)
    usual = max(1.4826 * float(np.median(np.abs(left[valid]))), noise)
    return np.asarray(valid & (np.abs(left) > max(FAR * usual, margin)))


def disturbances(time: Array, far: Mask, judged: Mask, left: Array) -> tuple[Disturbance, ...]:
    """Disturbances of one recording from the samples (K, n) of each joint that are far off and those that are judged.

    `time` (K,) is even [s]; `left` (K, n) is what remains at each joint [N·m].
    """
    if not far.any():
        return ()
    half = max(1, round(AT_ONCE_S / float(time[1] - time[0])))
    together, able = (maximum_filter1d(mask.astype(np.uint8), 2 * half + 1, axis=0).sum(1) for mask in (far, judged))
    disturbed = far.any(1) & (together >= np.maximum(JOINTS, SHARE * able))
    if not 0.0 < disturbed.mean() <= RARE:
        return ()
    runs, count = label(binary_dilation(disturbed, iterations=half))
    out = []
    for number in range(1, count + 1):
        own = np.flatnonzero((runs == number) & disturbed)
        largest = np.abs(left[own]).max(0)
        joint = int(np.argmax(largest))
        out.append(Disturbance(float(time[own[0]]), float(time[own[-1]]), joint, float(largest[joint])))
    return tuple(one for one in out if one.end - one.start <= LONGEST_S)


def calm_weight(time: Array, found: tuple[Disturbance, ...]) -> Array:
    """1 away from disturbances, 0 in them and around, (K,)."""
    out = np.ones(len(time))
    for one in found:
        out[(time >= one.start - AROUND_S) & (time <= one.end + AROUND_S)] = 0.0
    return out
