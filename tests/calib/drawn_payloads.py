"""Drawn payloads on realistic arms, weighed: an arm's records come from its own sweeps, then it carries a body."""

from dataclasses import dataclass

import numpy as np
from drawn_arms import drawn_arm
from realistic_sweeps import RestingArm, both_passes, plans

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from calib.arm.kinematics import DriveLimits
from calib.arm.sweep_section import sweep_section
from calib.fit.field_fit import Payload, raw_readings, weigh_payload
from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import fit_sensors
from calib.plan.sweep_plan import weighing_poses
from calib.records.records import CalibrationRecord, GravityRecord
from calib.sweep.verify import FEWEST_WEIGHED
from sim_bus.sim_section import with_realism

Array = np.ndarray
SENSOR_RANGE = 1.95
"""Readings of these arms end at 2 rated torques, which the drives cannot hold for long: such a pose is not reached."""


@dataclass(frozen=True, eq=False)
class Weighing:
    """A payload as it is and as it was weighed."""

    mass: float
    centre: Array
    found: Payload

    @property
    def errors(self) -> Array:
        """Mass and centre, error over standard deviation (4,); NaN for what is not told."""
        of_centre = (self.found.centre - self.centre) / self.found.centre_std
        return np.append((self.found.mass - self.mass) / self.found.mass_std, of_centre)


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A realistic arm with the records of its sweeps."""

    arm: ArmFile
    resting: RestingArm
    calibration: CalibrationRecord
    gravity: GravityRecord

    def weigh(self, mass: float, centre: Array, poses: int, seed: int) -> Weighing:
        """Attach a body, read poses as the command would drive to them, take it off."""
        limits, free = DriveLimits.of(self.arm), np.full(len(self.arm.joint_names), np.nan)
        middle = (limits.lower + limits.upper) / 2
        simulated = self.resting.simulated
        simulated.attach_mass(mass, centre)
        try:
            at = weighing_poses(self.arm, poses, seed, middle)
            torque = simulated.gravity_torque(at)
            reading = np.abs(simulated.truth.gain * torque + simulated.truth.offset)
            held = (np.abs(torque) < limits.max_torque) & (reading < SENSOR_RANGE * limits.rated)
            got = [self.resting.read(pose, free)[:2] for pose in at[held.all(axis=1)]]
        finally:
            simulated.detach_mass()
        if len(got) < FEWEST_WEIGHED:
            raise Refused(f"{len(got)} of {poses} poses were reached")
        shown, torque = (np.array(each) for each in zip(*got, strict=True))
        record = self.calibration
        sigma = sweep_section(self.arm).standard_error * limits.rated
        rows = raw_readings(record.angle(shown), record.torque_calibration().invert(torque), sigma, record)
        return Weighing(mass, centre, weigh_payload(self.arm, rows, self.gravity, record))


def calibrated_arm(seed: int, level: float) -> Calibrated:
    """A drawn arm at a level of realism, after both passes of sweeps."""
    arm, truth = drawn_arm(seed)
    arm = with_realism(arm, level, seed)
    _, data, resting = both_passes(arm, truth, plans(arm, truth), seed)
    fit = fit_sensors(arm, data)
    record = fit.record(arm)
    return Calibrated(arm, resting, record, identify_gravity(arm, data, fit).record(arm, record))


def draw_payload(random: np.random.Generator) -> tuple[float, Array]:
    """0.1 to 5 kg, within some 15 cm of the last joint."""
    return float(np.exp(random.uniform(np.log(0.1), np.log(5.0)))), random.normal(0.0, 0.08, 3)
