"""Integral term of position control, for drives that have none: it takes over what gravity asks for.

With r = INTEGRAL_RATE the feed-forward τ grows by r · (kp (q* − q) + kd (v* − v)): what the drive's gains must still
add becomes feed-forward within 1 / r. Without the velocity's share a joint of inertia J would be stable for r < kd / J,
which the first joints of an arm come close to, since MIT frames carry little damping. With it the limit is
r · J < kd (1 + r · kd / kp), which a joint with a load on its lever passes: the term would then feed its swing.
So it follows only errors that keep their sign; a swing about the target is left to the drive's damping.
"""

import math

from armlink.link.gate import POSITION_MODES, TORQUE_LIMIT_SHARE, JointLimits, Seen

INTEGRAL_RATE = 5.0
"""[1/s]."""
SWING_TIME = 0.5
"""Time over which errors are averaged, to tell a swing from what is to be taken over [s]."""
DEADBAND = 5e-4
"""Errors below this are not integrated, against hunting under stiction [rad]."""


def slowest_time(kp: float, kd: float) -> float:
    """Time constant in which a joint held with these gains and this term comes to rest, at the longest [s]; 0 without.

    What is left of a disturbance fades with kd / kp, and with the term itself.
    """
    return max(1.0 / INTEGRAL_RATE, kd / kp) if kp > 0 else 0.0


class Integral:
    def __init__(self) -> None:
        self.torque = 0.0
        """[N·m]."""
        self._active = False
        self._mean = self._size = 0.0
        """Of the newest errors: mean, and mean of their sizes [rad]."""

    def update(self, limits: JointLimits, mode: int, target: float, rate: float, seen: Seen) -> float:
        """The feed-forward for this cycle [N·m]; `target` [rad] and `rate` [rad/s] are what passed in the last one.

        Under another mode it follows the torque that is produced, so that position control takes over without a jump.
        """
        if mode not in POSITION_MODES or not math.isfinite(seen.position):
            self._active = False
            return self.torque
        error = target - seen.position
        if not self._active:
            self._active = True
            produced = seen.torque if math.isfinite(seen.torque) else 0.0
            self.torque, self._mean, self._size = produced, error, abs(error)
        share = self._steady_share(error, limits.period / SWING_TIME)
        if abs(error) > DEADBAND:
            most = limits.max_torque * TORQUE_LIMIT_SHARE
            short = rate - seen.velocity if math.isfinite(seen.velocity) else 0.0
            grown = self.torque + share * INTEGRAL_RATE * limits.period * (limits.kp * error + limits.kd * short)
            self.torque = max(-most, min(most, grown))
        return self.torque

    def _steady_share(self, error: float, step: float) -> float:
        """1 where the newest errors have one sign, towards 0 where they swing about nothing."""
        self._mean += step * (error - self._mean)
        self._size += step * (abs(error) - self._size)
        return (self._mean / self._size) ** 2 if self._size > 0.0 else 0.0

    def reset(self) -> None:
        """The joint has no power: the next position control starts from the torque that is produced then."""
        self.torque, self._active = 0.0, False
