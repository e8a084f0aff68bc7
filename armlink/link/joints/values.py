"""From values of drives to values of joints and back: direction, zero, gear, and calibration in the host."""

import math
from dataclasses import replace

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.drives.orders import Gains, Limits, Order, Power
from armlink.link.gate_limits import drive_limits, joint_ranges, target_window
from armlink.link.joints.groups import Group, Mounting, make_groups, traits_of
from armlink.torque_calibration import TorqueCalibration


class JointValues:
    """Conversions of n joints. Drive: what the drive reads and is told; joint: what the arm does.

    With v the drive's torque at the joint (direction and gear applied), the host's calibration v = gain · τ + offset
    corrects the reading and, where the torque is from current, also the command.
    """

    def __init__(self, mounting: Mounting, from_current: Array) -> None:
        """`from_current` (n,) bool: joints whose torque reading is the motor's."""
        self._mounting, self._current = mounting, from_current.astype(bool)
        self._all_sensors = not self._current.any()
        n = from_current.size
        self.calibration = TorqueCalibration(np.ones(n), np.zeros(n))
        """In force in the host; 1 and 0 for joints without."""
        self._calibrated = False
        self._signs: list[float] = mounting.direction.tolist()
        self._zeros: list[float] = mounting.zero.tolist()
        self._gears: list[float] = mounting.gear.tolist()
        self._corrections = [(1.0, 0.0)] * n
        """Gain and offset of each joint's command; 1 and 0 where the torque is not from current."""

    @property
    def plain(self) -> bool:
        """Whether orders need no conversion."""
        return self._mounting.plain and (self._all_sensors or not self._calibrated)

    def calibrate(self, calibration: TorqueCalibration[Array]) -> None:
        """Put gains and offsets (n,) into force."""
        self.calibration = calibration
        self._calibrated = bool((calibration.gain != 1).any() or (calibration.offset != 0).any())
        pairs = zip(self._current, calibration.gain.tolist(), calibration.offset.tolist(), strict=True)
        self._corrections = [(gain, offset) if current else (1.0, 0.0) for current, gain, offset in pairs]

    def position(self, values: Array) -> Array:
        """Joint positions [rad] of drive positions (n,)."""
        mount = self._mounting
        return values if mount.plain else mount.direction * (values - mount.zero) / mount.gear

    def position_of(self, joint: int, value: float) -> float:
        """Position of one joint [rad]."""
        mount = self._mounting
        if mount.plain:
            return value
        return float(self._signs[joint] * (value - self._zeros[joint]) / self._gears[joint])

    def velocity(self, values: Array) -> Array:
        """Joint velocities [rad/s] of drive velocities (n,)."""
        mount = self._mounting
        return values if mount.plain else mount.direction * values / mount.gear

    def motor(self, values: Array) -> Array:
        """Motor torques at the joint [N·m] (n,); of joints whose torque is from current as the calibration has them."""
        mount = self._mounting
        if not mount.plain:
            values = mount.direction * mount.gear * values
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
        mount = self._mounting
        if not mount.plain:
            sensor = mount.direction * sensor
        if self._calibrated:
            sensor = self.calibration.invert(sensor)
        return sensor if self._all_sensors else np.where(self._current, motor, sensor)

    def limits(self, joint: int, limits: Limits) -> Limits:
        """Limits of a joint, at the output of its drive."""
        mount = self._mounting
        gear = float(mount.gear[joint])
        ends = sorted(self._drive_position(joint, end) for end in (limits.lower, limits.upper))
        return replace(
            limits,
            max_torque=limits.max_torque / gear,
            torque_rate=limits.torque_rate / gear,
            max_velocity=limits.max_velocity * gear,
            lower=ends[0],
            upper=ends[1],
        )

    @property
    def gear(self) -> Array:
        """(n,)."""
        return self._mounting.gear

    @property
    def direction(self) -> Array:
        """1 or −1 (n,)."""
        return self._mounting.direction

    def zero_of(self, joint: int) -> float:
        """Reading of one joint's drive at joint position 0 [rad], as it is in force."""
        return self._zeros[joint]

    def turn_zero(self, joint: int, turns: int) -> None:
        """Change the zero of one joint's drive by whole turns of the drive's output."""
        self._mounting = self._mounting.with_zero(joint, self._zeros[joint] + 2 * math.pi * turns)
        self._zeros = self._mounting.zero.tolist()

    def gains(self, joint: int, gains: Gains | None) -> Gains | None:
        """Gains at the joint, of those at the output of its drive."""
        square = float(self._mounting.gear[joint]) ** 2
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
        power, walk, mode, position, velocity, torque, kp, kd, refused = order
        return Order(
            power,
            walk,
            mode,
            sign * gear * position + self._zeros[joint],
            sign * gear * velocity,
            sign * (gain * torque + offset) / gear,
            gain * kp / gear**2,
            gain * kd / gear**2,
            refused,
        )

    def ordered(self, joint: int, sent: Order) -> Order:
        """A drive's order at the joint; torque as the drive makes it, not corrected."""
        mount = self._mounting
        if mount.plain:
            return sent
        gear, sign = self._gears[joint], self._signs[joint]
        power, walk, mode, position, velocity, torque, kp, kd, refused = sent
        return Order(
            power,
            walk,
            mode,
            sign * (position - self._zeros[joint]) / gear,
            sign * velocity / gear,
            sign * torque * gear,
            kp * gear**2,
            kd * gear**2,
            refused,
        )

    def _drive_position(self, joint: int, position: float) -> float:
        return float(self._signs[joint] * self._gears[joint] * position + self._zeros[joint])


def values_of(arm: ArmFile, groups: tuple[Group, ...]) -> JointValues:
    """Conversions between the values of an arm's joints and of their drives."""
    traits = traits_of(groups)
    return JointValues(Mounting.of(arm), np.array([each.torque == "current" for each in traits]))


def try_limits(arm: ArmFile) -> None:
    """Raise BadInput where an arm file fits no drives; asks none."""
    link = arm.require_link()
    groups = make_groups(arm)
    rows = zip(link.joints, joint_ranges(arm), strict=True)
    limits = [drive_limits(row, target_window(*ends), 1.0 / link.rate, link.deadline) for row, ends in rows]
    values = values_of(arm, groups)
    for group in groups:
        group.drives.fits([values.limits(place, limits[place]) for place in group.places])
