"""From values of drives to values of joints and back: direction, zero, gear, and calibration in the host."""

import math
from dataclasses import replace

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.drives.orders import Gains, Limits, Order, Power
from armlink.link.gate_limits import arm_limits, joint_ranges
from armlink.link.joints.groups import Group, make_groups, traits_of
from armlink.torque_calibration import TorqueCalibration


class JointValues:
    """Conversions of n joints. Drive: what the drive reads and is told; joint: what the arm does.

    A drive is built in by direction, zero and gear: q = direction (p − zero) / gear, τ = direction · gear · τ_drive.
    With v the drive's torque at the joint (direction and gear applied), the host's calibration v = gain · τ + offset
    corrects the reading and, where the torque is from current, also the command.
    """

    def __init__(self, arm: ArmFile, from_current: Array) -> None:
        """`from_current` (n,) bool: joints whose torque reading is the motor's."""
        self._current = from_current.astype(bool)
        self._all_sensors = not self._current.any()
        n = from_current.size
        settings = [joint.settings for joint in arm.require_link().joints]
        self._signs, self._zeros, self._gears = (
            [float(getattr(each, key)) for each in settings] for key in ("direction", "zero", "gear")
        )
        self.direction, self.gear = np.array(self._signs), np.array(self._gears)
        """1 or −1; turns of the drive's output for one of the joint (n,)."""
        self._place_zeros()
        self.calibration = TorqueCalibration(np.ones(n), np.zeros(n))
        """In force in the host; 1 and 0 for joints without."""
        self._calibrated = False
        self._corrections = [(1.0, 0.0)] * n
        """Gain and offset of each joint's command; 1 and 0 where the torque is not from current."""

    def _place_zeros(self) -> None:
        self._zero = np.array(self._zeros)
        """Reading of each drive at joint position 0 (n,) [rad]."""
        self._direct = bool((self.direction == 1).all() and (self._zero == 0).all() and (self.gear == 1).all())
        """Whether every drive's output is the joint."""

    @property
    def plain(self) -> bool:
        return self._direct and (self._all_sensors or not self._calibrated)

    def calibrate(self, calibration: TorqueCalibration[Array]) -> None:
        self.calibration = calibration
        self._calibrated = bool((calibration.gain != 1).any() or (calibration.offset != 0).any())
        pairs = zip(self._current, calibration.gain.tolist(), calibration.offset.tolist(), strict=True)
        self._corrections = [(gain, offset) if current else (1.0, 0.0) for current, gain, offset in pairs]

    def position(self, values: Array) -> Array:
        """Joint positions [rad] of drive positions (n,)."""
        return values if self._direct else self.direction * (values - self._zero) / self.gear

    def position_of(self, joint: int, value: float) -> float:
        if self._direct:
            return value
        return float(self._signs[joint] * (value - self._zeros[joint]) / self._gears[joint])

    def velocity(self, values: Array) -> Array:
        """Joint velocities [rad/s] of drive velocities (n,)."""
        return values if self._direct else self.direction * values / self.gear

    def motor(self, values: Array) -> Array:
        """Motor torques at the joint [N·m] (n,); of joints whose torque is from current as the calibration has them."""
        if not self._direct:
            values = self.direction * self.gear * values
        if self._calibrated and not self._all_sensors:
            values = np.where(self._current, self.calibration.invert(values), values)
        return values

    def uncalibrated(self, motor: Array) -> Array:
        """Motor torques (n,) of `motor` as the drives report them, at the joint [N·m]."""
        if not self._calibrated or self._all_sensors:
            return motor
        return np.where(self._current, self.calibration.apply(motor), motor)

    def torque(self, sensor: Array, motor: Array) -> Array:
        """Joint torques [N·m] (n,): of the sensor, or the motor's (as `motor` gives it) where there is none."""
        if not self._direct:
            sensor = self.direction * sensor
        if self._calibrated:
            sensor = self.calibration.invert(sensor)
        return sensor if self._all_sensors else np.where(self._current, motor, sensor)

    def limits(self, joint: int, limits: Limits) -> Limits:
        """Limits of a joint, at the output of its drive."""
        gear = self._gears[joint]
        ends = sorted(self._drive_position(joint, end) for end in (limits.lower, limits.upper))
        return replace(
            limits,
            max_torque=limits.max_torque / gear,
            torque_rate=limits.torque_rate / gear,
            max_velocity=limits.max_velocity * gear,
            lower=ends[0],
            upper=ends[1],
        )

    def zero_of(self, joint: int) -> float:
        """Reading of one joint's drive at joint position 0 [rad], as it is in force."""
        return self._zeros[joint]

    def turn_zero(self, joint: int, turns: int) -> None:
        self._zeros[joint] += math.tau * turns
        self._place_zeros()

    def gains(self, joint: int, gains: Gains | None) -> Gains | None:
        square = self._gears[joint] ** 2
        return gains and Gains(*(square * value for value in (gains.kp, gains.kd, gains.max_kp, gains.max_kd)))

    def torque_of(self, joint: int, motor: float) -> float:
        """Torque of one joint [N·m] from the motor's, NaN if that is not known."""
        values = np.full(self.gear.size, motor)
        return float(self.motor(values)[joint])

    def reach(self, joint: int, max_torque: float) -> float:
        """Greatest torque of a joint for which neither it nor what its drive is told exceeds `max_torque` [N·m]."""
        if not self._current[joint]:
            return max_torque
        gain, offset = abs(float(self.calibration.gain[joint])), abs(float(self.calibration.offset[joint]))
        return max(0.0, (max_torque - offset) / max(1.0, gain))

    def order(self, joint: int, order: Order) -> Order:
        """The order for a drive from that for its joint; the calibration corrects torque and gains of a motor."""
        gear, sign = self._gears[joint], self._signs[joint]
        gain, offset = self._corrections[joint] if order.power is Power.ON else (1.0, 0.0)
        return order._replace(
            position=sign * gear * order.position + self._zeros[joint],
            velocity=sign * gear * order.velocity,
            torque=sign * (gain * order.torque + offset) / gear,
            kp=gain * order.kp / gear**2,
            kd=gain * order.kd / gear**2,
        )

    def ordered(self, joint: int, sent: Order) -> Order:
        """A drive's order at the joint; torque as the drive makes it, not corrected."""
        if self._direct:
            return sent
        gear, sign = self._gears[joint], self._signs[joint]
        return sent._replace(
            position=sign * (sent.position - self._zeros[joint]) / gear,
            velocity=sign * sent.velocity / gear,
            torque=sign * sent.torque * gear,
            kp=sent.kp * gear**2,
            kd=sent.kd * gear**2,
        )

    def _drive_position(self, joint: int, position: float) -> float:
        return float(self._signs[joint] * self._gears[joint] * position + self._zeros[joint])


def values_of(arm: ArmFile, groups: tuple[Group, ...]) -> JointValues:
    traits = traits_of(groups)
    return JointValues(arm, np.array([each.torque == "current" for each in traits]))


def try_limits(arm: ArmFile) -> None:
    """Raise BadInput where an arm file fits no drives; asks none."""
    groups = make_groups(arm)
    limits = arm_limits(arm.require_link(), joint_ranges(arm))
    values = values_of(arm, groups)
    for group in groups:
        group.drives.fits([values.limits(place, limits[place]) for place in group.places])
