"""Gravity compensation: the identified torque is fed forward, so that the arm stays where a hand leaves it.

Pure: positions in, torques out (Ma & Hollerbach, Figure 1). Three terms are added to gravity: damping, steep near the
speed limit; soft ends near the stops; and at rest a small detent, which holds the arm against the model's error.
"""

from dataclasses import dataclass

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.gravity.batch import GravityModel


@dataclass(frozen=True)
class FloatConfig:
    """Feel and safety of a floating arm; tests/calib/floating/test_float.py holds the arm to them."""

    speed_time: float = 0.01
    """Time constant of the speed filter [s]: 2.5 cycles at 250 Hz, against the steps of the encoder."""
    damping_share: float = 0.02
    """Damping torque at the largest speed, as a share of rated torque."""
    fast_share: float = 0.7
    """Above this share of the largest speed damping grows steeply, so that the speed gate does not have to stop the
    arm."""
    fast_damping: float = 0.5
    """Further damping torque at the largest speed, as a share of rated torque."""
    soft_end: float = 0.12
    """Distance from a stop at which the soft end begins [rad]."""
    soft_share: float = 0.3
    """Torque of the soft end at the stop, as a share of rated torque."""
    detent_share: float = 0.01
    """Largest torque of the detent, as a share of rated torque: a hand overcomes it without noticing."""
    detent_width: float = 0.01
    """Deflection at which the detent reaches its largest torque and begins to follow [rad]."""


class FloatControl:
    """`torque(position)` once per cycle. Positions are readings of the joints' own sensors."""

    def __init__(
        self,
        arm: Arm,
        beta: Array,
        rated: Array,
        max_velocity: Array,
        period: float,
        config: FloatConfig | None = None,
        position_gain: Array | None = None,
        position_offset: Array | None = None,
    ) -> None:
        """beta (2n,) [kg·m]; rated torque (n,) [N·m]; max_velocity (n,) [rad/s]; period of a cycle [s].

        position_gain and position_offset (n,) of the calibration record convert readings to true angles.
        """
        self.config = config or FloatConfig()
        self._model, self._arm = GravityModel(arm, beta), arm
        self._rated, self._top, self._period = rated, max_velocity, period
        self._gain = np.ones(arm.n) if position_gain is None else position_gain
        self._offset = np.zeros(arm.n) if position_offset is None else position_offset
        self._last: Array | None = None
        self._speed: Array = np.zeros(arm.n)
        self._detent: Array = np.zeros(arm.n)

    def torque(self, position: Array, elapsed: float | None = None) -> Array:
        """Target torque (n,) [N·m] at position readings (n,) [rad], `elapsed` seconds after those before.

        The last reading replaces a missing one (NaN); without a time a period has passed.
        """
        angle = self._gain * position + self._offset
        if self._last is None:
            if np.isnan(angle).any():
                return np.full(angle.size, np.nan)
            self._last, self._detent = angle.copy(), angle.copy()
        angle = np.where(np.isnan(angle), self._last, angle)
        period = self._period if elapsed is None else max(elapsed, self._period / 2)
        share = min(period / self.config.speed_time, 1.0)
        self._speed += share * ((angle - self._last) / period - self._speed)
        self._last = angle
        gravity: Array = np.asarray(self._model.one(angle))
        return gravity + self._damping() + self._soft_ends(angle) + self._hold(angle)

    def gravity(self, position: Array) -> Array:
        """The model's torque alone (n,) [N·m] at position readings (n,) [rad]."""
        return np.asarray(self._model.one(self._gain * position + self._offset))

    @property
    def speed(self) -> Array:
        return self._speed

    def _damping(self) -> Array:
        config, relative = self.config, self._speed / self._top
        beyond = np.maximum(np.abs(relative) - config.fast_share, 0.0) / (1.0 - config.fast_share)
        return -self._rated * (config.damping_share * relative + config.fast_damping * beyond * np.sign(relative))

    def _soft_ends(self, angle: Array) -> Array:
        """A spring near each stop, damped towards the stop only."""
        config, arm = self.config, self._arm
        width = np.minimum(config.soft_end, (arm.upper - arm.lower) / 6)
        into_lower = np.clip((arm.lower + width - angle) / width, 0.0, 1.0)
        into_upper = np.clip((angle - arm.upper + width) / width, 0.0, 1.0)
        spring = config.soft_share * (into_lower - into_upper)
        inwards = np.where(into_lower > 0, np.minimum(self._speed, 0.0), np.maximum(self._speed, 0.0)) / self._top
        damped = -config.soft_share * np.maximum(into_lower, into_upper) * inwards
        finite = np.isfinite(arm.upper - arm.lower)
        return np.where(finite, self._rated * (spring + damped), 0.0)

    def _hold(self, angle: Array) -> Array:
        """A spring to the rest position, which beyond its largest torque follows the joint, as dry friction does."""
        width = self.config.detent_width
        self._detent = np.clip(self._detent, angle - width, angle + width)
        return self.config.detent_share * self._rated * (self._detent - angle) / width
