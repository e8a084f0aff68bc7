"""Motion and one torque channel of a recording on common rows, as the checks of its columns look at it."""

from dataclasses import dataclass, replace

import numpy as np

from gcomp.arrays import Array, Mask
from sim_gap.residuals.preprocess import PreparedSignals

ROWS = 1500
"""Rows that are looked at."""
TURNING = 0.02
"""Speed from which friction has its full sign [rad/s]."""


@dataclass(frozen=True, eq=False)
class ChannelMotion:
    """Positions, velocities, accelerations and one torque channel, (K, n) each."""

    q: Array
    v: Array
    a: Array
    reading: Array
    """NaN where there is none."""
    channel: str
    duration: float
    """Time from the first row to the last [s]."""
    size: Array
    """Standard deviation of what is recorded, in the unit of the reading, (n,): of a torque in another unit, say."""
    idle: Mask
    """Whether each reading may have nothing of the model's torque, (n,): of a motor that is idle, a dead sensor."""
    rubs: bool = True
    """Whether the friction of gears may be in the readings, as in a motor's."""

    @property
    def direction(self) -> Array:
        """Sign of the velocity, rounded off around zero (K, n)."""
        return np.clip(self.v / TURNING, -1.0, 1.0)

    @property
    def telling(self) -> Mask:
        """Rows that tell something of each joint, (K, n): friction at rest, which a motor holds, takes any value."""
        return np.asarray(((np.abs(self.v) > TURNING) | (self.channel == "tau")) & np.isfinite(self.reading))

    def rows(self, rows: slice) -> "ChannelMotion":
        q, v, a, reading = (x[rows] for x in (self.q, self.v, self.a, self.reading))
        return replace(self, q=q, v=v, a=a, reading=reading)


def motion_of(s: PreparedSignals, channel: str) -> ChannelMotion:
    """The compared rows of a recording, thinned to about `ROWS`. A sensor on the link feels no gear; where the motor's
    torque is recorded too, what it feels is behind it."""
    t = s.filtered(s.t)
    thin = slice(None, None, max(1, len(t) // ROWS))
    q, v, a, reading = (s.filtered(x)[thin] for x in (s.q, s.v, s.a, s.reading[channel]))
    size, idle = reading.std(0), np.ones(reading.shape[1], bool)
    rubs = channel != "tau" or "tau_motor" in s.channels
    return ChannelMotion(q, v, a, reading, channel, float(t[-1] - t[0]), size, idle, rubs)
