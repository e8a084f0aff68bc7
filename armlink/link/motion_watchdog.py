"""What the readings of n joints prove about their motion: no reading is believed alone.

Two readings tell how a joint moves: the velocity that its drive reports, and the differences of its positions. Each is
taken for what it can prove. A sample was taken no earlier than it was asked for and no later than it was here; two
samples with the way between them therefore prove a least and a greatest mean speed, whatever a late host, a late reply
or a lost frame did to the time between them. The encoder's resolution widens both.

- `proven` is a speed that a joint has at the least, by its positions; `ahead` the one that it has by then at which an
  order that is made now can act, if it goes on as it does.
- `contradicted` joints have positions and velocities that cannot both be right: the way by the one and the way by the
  other differ by more than resolution, lateness and the drive's own filter explain, or the drive tells of a speed above
  the joint's limit of which its positions show nothing.
"""

import math
import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armlink.arrays import Array
from armlink.link.bus_watchdog import SLOW_CYCLES

LAGS = 2 ** np.arange(6)
"""Mean speeds are taken over so many cycles: the short ones are quick, the long ones exact."""
ROWS = int(LAGS[-1]) + 1
"""Cycles whose readings are kept."""
PRESENT = 4
"""The first so many lags tell of the present: a mean over up to eight cycles."""
REACTION_CYCLES = 3
"""What is not stopped by this reading is stopped by the next: the reading is a cycle old, the next comes a cycle later,
and an order acts within a third."""
MEMORY = 0.5
"""Ways by positions and by velocities are compared over this time [s]: long against a drive's filter, and so short that
a velocity reading's zero error (half a step of 12 bits, 0.02 rad/s) comes to no more than WAY."""
WAY = 0.01
"""Difference of the ways that compliance, backlash and a velocity's zero error explain [rad]."""
SHARE = 0.3
"""Difference of the ways, or speeds, as a share of the greater: scales that are off by 10 to 40 % are for
`armlink check --scales`, which must be able to move the arm that it examines."""
FILTER_TIME = 0.01
"""A drive's own filter delays its velocity by so much [s]; that of the simulated nodes by 0.008."""
IDLE_SHARE = 0.25
"""Slower than this share of max_velocity a joint proves no speed that any limit asks for."""


class MotionWatch:
    """Bounds of the speeds of n joints by the readings of the newest cycles."""

    def __init__(self, n: int, period: float) -> None:
        """`period` of a cycle [s]."""
        self.n, self._period = n, period
        self._delay = FILTER_TIME + (SLOW_CYCLES + 1) * period
        """Age of the motion that a velocity tells of, where none was lost or late [s]."""
        self._step, self._most = np.zeros(n), np.full(n, math.inf)
        self.restart()

    def use(self, step: Array, max_velocity: Array) -> None:
        """Resolution of the positions (n,) [rad] and speed limits (n,) [rad/s] from now on."""
        self._step, self._most = np.array(step, float), np.array(max_velocity, float)
        self.restart()

    def restart(self) -> None:
        """After an interruption: what was before proves nothing of what comes."""
        n = self.n
        self.proven: Array = np.zeros(n)
        """(n,) [rad/s]; 0 where the positions prove nothing."""
        self.ahead: Array = np.zeros(n)
        """(n,) [rad/s]; likewise."""
        self.contradicted: NDArray[np.bool_] = np.zeros(n, bool)
        """(n,)."""
        self._at = self._cycles = 0
        self._positions, self._earliest, self._latest = (np.full((ROWS, n), math.nan) for _ in range(3))
        self._fastest = np.full((math.ceil(self._delay / self._period), n), math.nan)
        """Greatest speeds that the positions allowed, in the newest cycles [rad/s]."""
        self._newest = np.full(n, -math.inf)
        self._before, self._time = np.full(n, math.nan), np.full(n, math.nan)
        """Newest position, and the middle of the time in which it was taken."""
        self._apart, self._way, self._peak, self._width, self._age = (np.zeros(n) for _ in range(5))
        """Way by positions less that by velocities, way of the two together [rad]; greatest speed [rad/s]; longest time
        in which a sample was taken, greatest age of a velocity [s]. All fade with MEMORY."""

    def update(
        self,
        position: Sequence[float],
        earliest: Sequence[float],
        latest: Sequence[float],
        velocity: Sequence[float],
        came: Sequence[float],
    ) -> None:
        """The newest readings (n,) of a cycle: positions [rad] that were taken between `earliest` and `latest` [s], and
        velocities [rad/s] that came at `came` [s], NaN where none came of late."""
        here, since, until, told = (np.array(each, float) for each in (position, earliest, latest, velocity))
        known = np.isfinite(told)
        age = np.where(known, FILTER_TIME + until - np.where(known, np.array(came, float), 0.0), 0.0)
        new = until > self._newest
        self._newest = np.where(new, until, self._newest)
        self._cycles += 1
        row = self._at = self._cycles % ROWS
        self._positions[row] = here = np.where(new, here, math.nan)
        self._earliest[row], self._latest[row] = since, until
        speed = np.where(np.isfinite(told), np.abs(told), 0.0)
        with np.errstate(invalid="ignore", divide="ignore"), warnings.catch_warnings():
            least, greatest = self._means(here, since, until)
            self._compare(here, since, until, told, np.fmax(speed, least), age)
            busy = np.fmax(speed, least) > IDLE_SHARE * self._most
            self.proven = least
            self.ahead = np.fmax(least, self._extrapolated(here, since, until)) if busy.any() else least
            self._fastest[self._cycles % len(self._fastest)] = greatest
            unseen = (age <= self._delay) & (speed > self._most) & ((1 - SHARE) * speed > self._fastest.max(axis=0))
        self.contradicted = unseen | (self._apart_too_far())

    def _means(self, here: Array, since: Array, until: Array) -> tuple[Array, Array]:
        """Least present speed (n,) and greatest speed of late (n,) that the positions allow [rad/s]."""
        rows = (self._at - LAGS) % ROWS
        ways = np.abs(here - self._positions[rows])
        longest, shortest = until - self._earliest[rows], since - self._latest[rows]
        least = np.fmax.reduce((ways[:PRESENT] - self._step) / longest[:PRESENT], axis=0)
        most = np.where(shortest > 0, (ways + self._step) / shortest, math.inf)
        most[np.isnan(ways)] = math.nan
        greatest = np.where(np.isnan(most[0]), math.inf, np.fmax.reduce(most, axis=0))
        return np.fmax(least, 0.0), greatest

    def _extrapolated(self, here: Array, since: Array, until: Array) -> Array:
        """Least speed (n,) when an order acts, from the means over the newest cycles and those before [rad/s]."""
        rows = (self._at - LAGS) % ROWS
        positions, middles = self._positions[rows], (self._earliest[rows] + self._latest[rows]) / 2
        middle = (since + until) / 2
        interval, before = middle - middles[:-1], middles[:-1] - middles[1:]
        mean, mean_before = (here - positions[:-1]) / interval, (positions[:-1] - positions[1:]) / before
        lead = interval / 2 + REACTION_CYCLES * self._period
        ahead = np.abs(mean + (mean - mean_before) / ((interval + before) / 2) * lead)
        exact = self._step / 2 + self._peak * self._width / 2
        least: Array = np.fmax.reduce(ahead - exact * (2 / interval + 4 * lead / interval**2), axis=0)
        return least

    def _compare(self, here: Array, since: Array, until: Array, told: Array, speed: Array, age: Array) -> None:
        """Bring the ways by positions and by velocities up to date; `speed` (n,) is the present one, `age` (n,) how
        old the motion is that the velocities tell of [s]."""
        new = np.isfinite(here)
        middle = (since + until) / 2
        elapsed = np.where(new, middle - self._time, math.nan)
        moved, turned = here - self._before, told * elapsed
        gap = elapsed > self._delay + self._period  # in which the velocity may have been anything
        known = np.isfinite(moved) & np.isfinite(turned) & ~gap
        keep = np.where(gap, 0.0, np.where(known, np.maximum(1.0 - elapsed / MEMORY, 0.0), 1.0))
        self._apart = keep * self._apart + np.where(known, moved - turned, 0.0)
        self._way = keep * self._way + np.where(known, np.fmax(np.abs(moved), np.abs(turned)), 0.0)
        self._peak = np.fmax(keep * self._peak, speed)
        self._age = np.fmax(keep * self._age, age)
        self._width = np.where(new, np.fmax(keep * self._width, until - since), self._width)
        self._before, self._time = np.where(new, here, self._before), np.where(new, middle, self._time)

    def _apart_too_far(self) -> NDArray[np.bool_]:
        explained = (
            WAY + 2 * self._step + SHARE * self._way + (np.maximum(self._delay, self._age) + self._width) * self._peak
        )
        return np.abs(self._apart) > explained
