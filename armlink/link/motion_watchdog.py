"""Bounds of n joints' speeds, and contradictions, by their readings: no reading is believed alone.

Two readings tell how a joint moves: the velocity that its drive reports, and the differences of its positions. Each is
taken for what it can prove. A sample was taken no earlier than it was asked for and no later than it was here; two
samples with the way between them therefore prove a least and a greatest mean speed, whatever a late host, a late reply
or a lost frame did to the time between them. The encoder's resolution widens both.

- `proven` is a speed that a joint has at the least, by all means over its newest positions and by those of the cycle
  before: one false position is no speed. `ahead` is the one that it has by then at which an order that is made now can
  act, if it goes on as it does, by any of the means.
- `unexplained` is the way by the positions of which the velocities say nothing: a joint that turned has none, a
  position that jumped has its jump.
- `contradicted` joints have positions and velocities that cannot both be right: the way by the one and the way by the
  other differ by more than resolution, lateness and the drive's own filter explain, or the drive tells of a speed above
  the joint's limit of which its positions show nothing.
"""

import math
from collections.abc import Sequence

from armlink.arrays import Array
from armlink.link.bus_watchdog import SLOW_CYCLES

LAGS = (1, 2, 4, 8, 16, 32)
"""Mean speeds are taken over so many cycles: the short ones are quick, the long ones exact."""
PRESENT_LAGS = LAGS[:4]
"""These tell of the present: a mean over up to eight cycles."""
REACTION_CYCLES = 3
"""A joint that this reading does not stop is stopped by the next: the reading is a cycle old, the next comes a cycle
later, and an order acts within a third."""
WAY_MEMORY = 0.5
"""Ways by positions and by velocities are compared over this time [s]: long against a drive's filter, and so short that
a velocity reading's zero error (half a step of 12 bits, 0.02 rad/s) comes to no more than WAY_TOLERANCE."""
WAY_TOLERANCE = 0.01
"""Difference of the ways that compliance, backlash and a velocity's zero error explain [rad]."""
WAY_SHARE = 0.3
"""Difference of the ways, or speeds, as a share of the greater: scales that are off by 10 to 40 % are for
`armlink check --scales`, which must be able to move the arm that it examines."""
FILTER_TIME = 0.01
"""A drive's own filter delays its velocity by so much [s]; that of the simulated nodes by 0.008."""
TOLD_TIME = 0.004
"""A velocity tells of so much of the motion before it [s]: a cycle at 250 Hz, within which a drive hardly changes its
speed. In a longer one, joints swing in time with the steps of their targets, and each velocity meets the same phase: of
the rest of that cycle it may have claimed too much, but a velocity of 0 has claimed nothing."""
IDLE_SHARE = 0.25
"""Slower than this share of max_velocity a joint proves no speed that any limit asks for."""


class _Joint:
    """The newest readings of one joint, and what they prove."""

    __slots__ = ("age", "apart", "at", "before", "claimed", "earliest", "latest", "most", "newest", "peak",
                 "positions", "steady", "step", "time", "told", "way", "width")  # fmt: skip

    def __init__(self, step: float, most: float, rows: int) -> None:
        """Resolution of its positions [rad], its speed limit [rad/s], and of how many cycles the readings are kept."""
        self.step, self.most, self.at = step, most, 0
        self.positions, self.earliest, self.latest = [math.nan] * rows, [math.nan] * rows, [math.nan] * rows
        """Rings whose newest row is `at`, so that row `at − lag` is the one of so many cycles ago."""
        self.newest = -math.inf
        self.steady = 0.0
        """Speed that all means over the newest positions prove [rad/s]."""
        self.told = 0.0
        """Newest speed that the drive told of, 0 where it was old [rad/s]: the positions of the cycle after it count,
        too, since a joint that strikes its stop turns round between two of them."""
        self.before = self.time = math.nan
        """Newest position, and the middle of the time in which it was taken."""
        self.apart = self.way = self.claimed = self.peak = self.width = self.age = 0.0
        """Way by positions less that by velocities, way of the two together, way that velocities claimed for the part
        of a cycle of which they do not tell [rad]; greatest speed [rad/s]; longest time in which a sample was taken,
        greatest age of a velocity [s]. All fade with WAY_MEMORY."""


class MotionWatch:
    """Bounds of the speeds of n joints by the readings of the newest cycles.

    Plain numbers, a joint at a time: of arrays this short a cycle would cost five times as much.
    """

    def __init__(self, n: int, period: float) -> None:
        """`period` of a cycle [s]."""
        self.n, self._period = n, period
        self._delay = FILTER_TIME + (SLOW_CYCLES + 1) * period
        """Age of the motion that a velocity tells of, where none was lost or late [s]."""
        self._step, self._most = [0.0] * n, [math.inf] * n
        self.restart()

    def use(self, step: Array, max_velocity: Array) -> None:
        """Resolution of the positions (n,) [rad] and speed limits (n,) [rad/s] from now on."""
        self._step, self._most = step.tolist(), max_velocity.tolist()
        self.restart()

    def restart(self) -> None:
        """After an interruption: what was before proves nothing of what comes."""
        self.proven = [0.0] * self.n
        """(n,) [rad/s]; 0 where the positions prove nothing."""
        self.ahead = [0.0] * self.n
        """(n,) [rad/s]; likewise."""
        self.contradicted = [False] * self.n
        """(n,)."""
        self.unexplained = [0.0] * self.n
        """Way by the positions less that by the velocities, of late (n,) [rad]."""
        self._newest = range(math.ceil(self._delay / self._period))
        rows = LAGS[-1] + len(self._newest)
        self._joints = [_Joint(*each, rows) for each in zip(self._step, self._most, strict=True)]

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
        proven, ahead, contradicted, judged = self.proven, self.ahead, self.contradicted, self._judged
        rows = zip(self._joints, position, earliest, latest, velocity, came, strict=True)
        for joint, (own, here, since, until, told, heard) in enumerate(rows):
            proven[joint], ahead[joint], contradicted[joint] = judged(own, here, since, until, told, heard)
            self.unexplained[joint] = abs(own.apart)

    def _judged(
        self, own: _Joint, here: float, since: float, until: float, told: float, came: float
    ) -> tuple[float, float, bool]:
        """`proven`, `ahead` and `contradicted` of one joint by its newest readings."""
        age = speed = 0.0
        if told == told:  # not NaN
            age, speed = FILTER_TIME + until - came, abs(told)
        if until > own.newest and since > -math.inf:  # a reading that nobody asked for may be of any time
            own.newest = until
        else:
            here = math.nan
        row = own.at = (own.at + 1) % len(own.positions)
        own.positions[row], own.earliest[row], own.latest[row] = here, since, until
        least, steady = _present(own, here, until)
        proven = own.steady if own.steady < steady else steady
        own.steady = steady
        present = speed if speed > least else least
        self._compare(own, here, since, until, told, present, age)
        most, delay = own.most, self._delay
        ahead = max(least, self._extrapolated(own, here, since, until)) if present > IDLE_SHARE * most else least
        told_before, own.told = own.told, speed if age <= delay else 0.0
        unseen = told_before > most and (1 - WAY_SHARE) * told_before > max(_fastest(own, ago) for ago in self._newest)
        oldest = own.age if own.age > delay else delay
        explained = WAY_TOLERANCE + 2 * own.step + WAY_SHARE * own.way + own.claimed + (oldest + own.width) * own.peak
        return proven, ahead, unseen or abs(own.apart) > explained

    def _extrapolated(self, own: _Joint, here: float, since: float, until: float) -> float:
        """Least speed when an order acts, from the means over the newest cycles and those before [rad/s]."""
        middle, lead, found = (since + until) / 2, REACTION_CYCLES * self._period, 0.0
        exact = own.step / 2 + own.peak * own.width / 2
        at, positions, began, ended = own.at, own.positions, own.earliest, own.latest
        row = at - LAGS[0]
        there, then = positions[row], (began[row] + ended[row]) / 2
        for lag in LAGS[1:]:
            row = at - lag
            before, earlier = positions[row], (began[row] + ended[row]) / 2
            interval, interval_before = middle - then, then - earlier
            if interval > 0.0 and interval_before > 0.0:
                mean = (here - there) / interval
                mean_before = (there - before) / interval_before
                reach = (interval / 2 + lead) / ((interval + interval_before) / 2)
                speed = abs(mean + (mean - mean_before) * reach)
                least = speed - 2 * exact * ((1 + reach) / interval + reach / interval_before)
                if least > found:  # not NaN
                    found = least
            there, then = before, earlier
        return found

    def _compare(
        self, own: _Joint, here: float, since: float, until: float, told: float, speed: float, age: float
    ) -> None:
        """Bring the ways by positions and by velocities up to date; `speed` is the present one, `age` how old the
        motion is that the velocity tells of [s]."""
        keep, new, middle = 1.0, here == here, (since + until) / 2
        elapsed = middle - own.time if new else math.nan
        if elapsed > self._delay + self._period:  # in which the velocity may have been anything
            keep, own.apart, own.way, own.claimed = 0.0, 0.0, 0.0, 0.0
        else:
            moved, turned = here - own.before, told * elapsed
            if moved - turned == moved - turned:  # neither is NaN
                keep = 1.0 - elapsed / WAY_MEMORY
                if keep < 0.0:
                    keep = 0.0
                own.apart = keep * own.apart + moved - turned
                far, wide = abs(moved), abs(turned)
                own.way = keep * own.way + (wide if wide > far else far)
                rest = elapsed - TOLD_TIME
                own.claimed = keep * own.claimed + (rest * abs(told) if rest > 0.0 else 0.0)
        peak, oldest = keep * own.peak, keep * own.age
        own.peak, own.age = speed if speed > peak else peak, age if age > oldest else oldest
        if new:
            width, taken = keep * own.width, until - since
            own.width = taken if taken > width else width
            own.before, own.time = here, middle


def _present(own: _Joint, here: float, until: float) -> tuple[float, float]:
    """Least present speed, by any of the means and by all of them [rad/s]."""
    at, positions, earliest, step = own.at, own.positions, own.earliest, own.step
    least, steady = 0.0, math.inf
    for lag in PRESENT_LAGS:
        row = at - lag
        longest = until - earliest[row]
        if longest > 0.0:
            mean = (abs(here - positions[row]) - step) / longest
            if mean < 0.0:
                mean = 0.0
            if mean > least:  # not NaN
                least = mean
            if mean < steady:
                steady = mean
    return least, steady if steady < math.inf else 0.0


def _fastest(own: _Joint, ago: int) -> float:
    """Greatest speed that the positions up to so many cycles ago allow [rad/s]."""
    row, greatest = own.at - ago, 0.0
    here, since = own.positions[row], own.earliest[row]
    for lag in LAGS:
        way = abs(here - own.positions[row - lag])
        if way != way:
            if lag == LAGS[0]:
                return math.inf
            continue
        shortest = since - own.latest[row - lag]
        greatest = max(greatest, (way + own.step) / shortest if shortest > 0.0 else math.inf)
    return greatest
