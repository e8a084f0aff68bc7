"""Integral term of position control, for drives that have none: it takes over what gravity asks for."""

import math

from armlink.link.gate import LEASH, POSITION_MODES, JointLimits, Seen

RATE = 4.0
"""Integral gain over proportional gain [1/s]."""
DEADBAND = 5e-4
"""Errors below this are not integrated, against hunting under stiction [rad]."""


class Integral:
    """Feed-forward torque of one joint."""

    def __init__(self) -> None:
        """Starts from nothing."""
        self.torque = 0.0
        """[N·m]."""
        self._active = False

    def update(self, limits: JointLimits, mode: int, target: float, seen: Seen) -> float:
        """The feed-forward for this cycle [N·m]; `target` is the position that passed in the last one [rad].

        Under another mode it follows the torque that is produced, so that position control takes over without a jump.
        """
        if mode not in POSITION_MODES or not math.isfinite(seen.position):
            self._active = False
            return self.torque
        error = target - seen.position
        if not self._active:
            self._active = True
            produced = seen.torque if math.isfinite(seen.torque) else 0.0
            self.torque = produced
        if abs(error) > DEADBAND:
            most = limits.max_torque * LEASH
            self.torque = max(-most, min(most, self.torque + RATE * limits.kp * limits.period * error))
        return self.torque

    def reset(self) -> None:
        """The joint has no power: the next position control starts from the torque that is produced then."""
        self.torque, self._active = 0.0, False
