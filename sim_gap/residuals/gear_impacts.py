"""Gear impacts: when a gear with play changes sides, the residual jumps as no smooth effect does, in several joints.

No inverse form follows an impact. Its samples are left out of the comparison, and the impacts are reported.
"""

import numpy as np

from gcomp.arrays import Array, Mask
from sim_gap.residuals.preprocess import Signals

BEFORE_S, AFTER_S = 0.4, 0.6
"""Time left out before and after a change of sign of the torque [s]."""
SHARP = 25.0
"""Least ratio of the residual's second difference (RMS) near these changes to that elsewhere."""
LEAST_LEFT = 0.2
"""Share of a recording that must remain."""


def near_impacts(s: Signals, channel: str, residual: Array) -> dict[int, Mask]:
    """Joints whose gear hits at their torque reversals, and the samples near those, (k,) each.

    `residual` is that of the link-side sensor `channel`, (k, n), at the rate of the comparison.
    """
    torque = s.filtered(s.reading[channel])
    before, after = (round(seconds * s.rate / s.step) for seconds in (BEFORE_S, AFTER_S))
    out = {}
    for joint in range(s.n):
        near = np.zeros(len(torque), bool)
        for k in np.flatnonzero(np.diff(np.sign(torque[:, joint])) != 0).tolist():
            near[max(0, k - before) : k + after + 1] = True
        bend = np.zeros(len(torque))
        bend[1:-1] = np.diff(residual[:, joint], 2) ** 2
        if near.any() and (~near).mean() > LEAST_LEFT and bend[near].mean() > SHARP**2 * bend[~near].mean():
            out[joint] = near
    return out
