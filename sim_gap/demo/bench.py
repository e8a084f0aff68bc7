"""The demo's bench: a simulated arm with a hidden truth, the link to it, and the operator's hands."""

from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from armlink.link.link import Link
from armlink.torque_calibration import TorqueCalibration
from calib.records.records import CalibrationRecord
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_torque
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth
from sim_gap.demo.script import GRAVITY_POSES


@dataclass(frozen=True, eq=False)
class Bench:
    """The bench: arm, link and truth. Estimates may use `link` alone; the rest is for checking afterwards."""

    arm: ArmFile
    described: Arm
    truth: Truth
    """The sensors as they are after the sweeps, effects of the arm file included."""
    simulated: SimulatedArm
    link: Link

    @classmethod
    def build(cls, arm: ArmFile, described: Arm, seed: int) -> "Bench":
        """A simulated arm with the truth of `seed` on an in-process bus; raises BadInput."""
        simulated = SimulatedArm(arm, Truth.draw(arm, seed), seed)
        return cls(arm, described, simulated.true_sensors, simulated, Link(arm, LockStepBus(arm=simulated)))

    def random_poses(self, count: int, seed: int) -> Array:
        """True joint angles (count, n) within the stops [rad]."""
        low, high = self.described.lower, self.described.upper
        return np.random.default_rng(seed).uniform(low, high, (count, self.described.n))

    def sensor_error(self, joint: int) -> tuple[float, float]:
        """(Gain error, offset error [N·m]) of what a joint's controller sends now, against the truth."""
        true = self.simulated.true_sensors
        sensor = TorqueCalibration(float(true.gain[joint]), float(true.offset[joint]))
        error = sensor.relative_to(self.link.read_calibration(joint))
        return error.gain - 1.0, error.offset


@dataclass(frozen=True, eq=False)
class GravityCheck:
    """The identified model against the plant's own gravity torque at random poses, (n,) [N·m]."""

    poses: int
    max_torque: Array
    rms_error: Array
    max_abs_error: Array


def check_gravity(bench: Bench, beta: Array, record: CalibrationRecord, seed: int) -> GravityCheck:
    """Compare at random true poses; the model is asked at the angles that the calibrated position sensors report."""
    angles = bench.random_poses(GRAVITY_POSES, seed)
    truth = bench.truth
    reading = (angles - truth.position_offset) / truth.position_gain
    reported = record.angle(reading)
    true = bench.simulated.gravity_torque(angles)
    error = gravity_torque(bench.described, beta, reported) - true
    return GravityCheck(
        len(angles), np.abs(true).max(axis=0), np.sqrt((error**2).mean(axis=0)), np.abs(error).max(axis=0)
    )
