"""Verification: model against sensor torque at held-out poses, as Figure 6 of [MH97] (docs/theory.md, section 3)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.loop.driver import ArmDriver
from armlink.torque_calibration import TorqueCalibration, per_joint
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.arm.sweep_section import SweepSection, sweep_section
from calib.motion.mover import Mover, Stalled
from calib.motion.static_reading import StaticReading
from calib.plan.poses import nearest_first, sweep_range
from calib.records.records import CalibrationRecord, GravityRecord
from calib.sweep.stalls import OnStall, give_up, repeat_motion
from gcomp.arrays import Array, Mask
from gcomp.gravity.torque import gravity_torque, torque_covariance

ACCELERATION = 2.0
"""Of travel between poses [rad/s²]; a choice."""
TOLERANCE = 0.01
"""RMS that passes, as a share of the joint's largest model torque: twice the error of gravity torque that
tests/calib/drawn_arms.py allows."""
EXPECTED = 2.5
"""RMS that passes, as a multiple of what the records expect: a field that is alike over much of the range is drawn anew
only a few times by the poses, and a mean of two squares exceeds this one time in five hundred."""
NOISE_FLOOR = 0.003
"""RMS that always passes, as a share of rated torque: the error of an offset that tests/calib/drawn_arms.py allows."""


@dataclass(frozen=True, eq=False)
class Verification:
    """Model torque against sensor torque at P poses."""

    names: tuple[str, ...]
    position: Array
    """True angles by the calibration (P, n) [rad]."""
    sensor: Array
    """Calibrated sensor torque (P, n) [N·m]."""
    model: Array
    """Model torque (P, n) [N·m]."""
    model_std: Array
    """Standard deviation of the model torque by the record's covariance (P, n) [N·m]."""
    skipped: int
    """Poses that the drives did not reach."""
    tolerance: Array
    """RMS that passes (n,) [N·m]."""

    @property
    def rms(self) -> Array:
        """RMS of sensor minus model (n,) [N·m]."""
        rms: Array = np.sqrt(np.mean((self.sensor - self.model) ** 2, axis=0))
        return rms

    @property
    def max_error(self) -> Array:
        """Largest absolute difference (n,) [N·m]."""
        largest: Array = np.abs(self.sensor - self.model).max(axis=0)
        return largest

    @property
    def passed(self) -> bool:
        """Whether every joint's RMS is within its tolerance."""
        return bool(np.all(self.rms <= self.tolerance))


def run_verify(
    link: ArmDriver,
    arm_file: ArmFile,
    gravity: GravityRecord,
    calibration: CalibrationRecord | None = None,
    *,
    poses: int = 24,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    on_stall: OnStall = give_up,
) -> Verification:
    """Drive, servo-held, to random poses within the joint range and read every torque sensor there.

    The link must have been enabled. Without a calibration record the controllers' own calibration is used. A pose whose
    reading a Stall interrupts is repeated where `on_stall` accepts it. Raises Refused on records of another arm, or if
    no pose can be reached; BusFault.
    """
    n, section, limits = link.n, sweep_section(arm_file), DriveLimits.of(arm_file)
    kinematics = gcomp_arm(arm_file)
    sensors = _SensorConversion.of(link, None if calibration is None else calibration.require(arm_file))
    beta = np.array(gravity.require(arm_file).beta)
    mover = Mover(link, section, limits)
    mover.hold_all()
    everything, angles, torques, skipped = np.ones(n, dtype=bool), [], [], 0
    for number, pose in enumerate(verify_poses(limits, section, poses, seed, mover.position), start=1):
        rest = repeat_motion(mover, on_stall, partial(_rest_at, mover, pose, everything))
        if rest is None:
            skipped += 1
            continue
        angles.append(sensors.angle(rest.position))
        torques.append(sensors.torque(rest.torque))
        if progress is not None:
            progress(number, poses)
    if not angles:
        raise Refused("no pose was reached: the drives stalled at every one; is the arm free to move?")
    q = np.array(angles)
    model = gravity_torque(kinematics, beta, q)
    variance = np.diagonal(torque_covariance(kinematics, np.array(gravity.covariance), q), axis1=-2, axis2=-1)
    tolerance = _tolerance(calibration, model, variance, limits.rated)
    return Verification(link.names, q, np.array(torques), model, np.sqrt(np.maximum(variance, 0.0)), skipped, tolerance)


def _rest_at(mover: Mover, pose: Array, everything: Mask) -> StaticReading | None:
    """Travel to a pose (n,) [rad] and rest there; back again, and None, where the drives do not reach it."""
    begin = mover.position.copy()
    try:
        mover.travel(pose, ACCELERATION)
    except Stalled:
        mover.hold_all()
        mover.travel(begin, ACCELERATION)
        return None
    return mover.rest(everything)


def _tolerance(calibration: CalibrationRecord | None, model: Array, variance: Array, rated: Array) -> Array:
    """RMS that passes (n,) [N·m]: what records with a discrepancy expect of themselves, else fixed bounds."""
    floor = NOISE_FLOOR * rated
    fixed: Array = np.maximum(TOLERANCE * np.abs(model).max(axis=0), floor)
    if calibration is None:
        return fixed
    level, level_std = calibration.discrepancy("level", np.nan), calibration.discrepancy("level_std", np.nan)
    gain, offset = calibration.values("gain", 1.0), np.nan_to_num(calibration.std("offset"))
    of_gain = np.nan_to_num(calibration.std("gain")) * np.abs(model)
    square = (level + 2 * level_std) ** 2 + (variance + (of_gain**2 + offset**2) / gain**2).mean(axis=0)
    passes: Array = np.where(np.isnan(level), fixed, np.maximum(EXPECTED * np.sqrt(square), floor))
    return passes


def verify_poses(limits: DriveLimits, section: SweepSection, count: int, seed: int, begin: Array) -> Array:
    """Random poses (count, n) [rad] within the joint range, in an order with little travel from `begin` (n,)."""
    ends = np.array([sweep_range(section, limits, joint) for joint in range(len(limits.lower))])
    generator = np.random.default_rng([seed, 6])
    return nearest_first(ends[:, 0] + generator.random((count, len(ends))) * (ends[:, 1] - ends[:, 0]), begin)


@dataclass(frozen=True, eq=False)
class _SensorConversion:
    """Conversion of what the controllers send to angles and torques."""

    installed: TorqueCalibration[Array]
    calibrated: TorqueCalibration[Array]
    record: CalibrationRecord | None

    @classmethod
    def of(cls, link: ArmDriver, record: CalibrationRecord | None) -> "_SensorConversion":
        installed = per_joint(link.read_calibration(joint) for joint in range(link.n))
        return cls(installed, installed if record is None else record.torque_calibration(installed), record)

    def angle(self, reading: Array) -> Array:
        return reading if self.record is None else self.record.angle(reading)

    def torque(self, reading: Array) -> Array:
        return self.calibrated.invert(self.installed.apply(reading))
