"""Mass and centre of mass, with intervals, of the body that an arm carries beyond its gravity record.

The problem is that of a field calibration, with gains and offsets as doubtful as their record says and four more
unknowns: the mass and its first moment (docs/theory.md, equation (P)). What the calibration does not explain (cables,
gear errors, an eccentric encoder) has periods of a quarter turn and more in each joint; poses that are drawn all over
the range are further apart, so it counts as an error of its own in each.
"""

from dataclasses import dataclass, replace

import numpy as np

from armlink.arm_file import ArmFile
from calib.fit.calibration import NOISE_ROUNDS, common_scale_std, rms
from calib.fit.creep_fit import SEEN
from calib.fit.field_fit import UNKNOWN_MOMENT, FieldProblem, scatter_factor
from calib.fit.slow_windows import directions
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arrays import Array, Mask
from gcomp.identify.readings import StaticReadings


@dataclass(frozen=True, eq=False)
class Payload:
    """Mass and first moment, in the frame that turns with the last joint."""

    value: Array
    """(4,): mass [kg], mass times centre [kg·m]."""
    covariance: Array
    """(4, 4)."""
    residual_rms: Array
    """RMS of calibrated torque minus model, payload included (n,) [N·m]."""

    @property
    def mass(self) -> float:
        return float(self.value[0])

    @property
    def mass_std(self) -> float:
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def found(self) -> Mask:
        """Which of mass and moments the readings tell (4,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)) < SEEN * UNKNOWN_MOMENT)

    @property
    def centre(self) -> Array:
        """[m]; NaN where the readings do not tell it, or no mass."""
        known = self.found[1:] & (self.mass > 2 * self.mass_std)
        return np.where(known, self.value[1:] / self.mass, np.nan)

    @property
    def centre_std(self) -> Array:
        """[m]."""
        slope = np.hstack([-self.value[1:, None] / self.mass, np.eye(3)]) / self.mass
        std: Array = np.sqrt(np.einsum("ij,jk,ik->i", slope, self.covariance, slope))
        return np.where(np.isfinite(self.centre), std, np.nan)


def weigh_payload(
    arm_file: ArmFile, readings: StaticReadings, gravity: GravityRecord, calibration: CalibrationRecord
) -> Payload:
    """The payload that raw readings of the sensors show; the arm file's tool is none of it.

    Raises Refused where a record is of another arm.
    """
    plain = tuple(joint.model_copy(update={"discrepancy": None}) for joint in calibration.joints)
    problem = FieldProblem(arm_file, readings, gravity, calibration.model_copy(update={"joints": plain}))
    level = np.hypot(calibration.discrepancy("level"), calibration.discrepancy("level_std"))
    own = np.hypot(readings.sigma, level * np.abs(problem.installed.gain))
    readings = replace(readings, sigma=own)
    columns = np.hstack([problem.columns(problem.installed.gain), problem.load_columns()])
    noise = readings.sigma
    for _ in range(NOISE_ROUNDS):
        solved = problem.solve(columns, noise, more=[UNKNOWN_MOMENT] * 4)
        left = problem.residual(columns, solved.x)
        noise = readings.sigma * np.maximum(scatter_factor(left, readings), 1.0)
    value = solved.x[-4:]
    of_scale = _gain_scale_std(calibration) * value
    return Payload(
        value, solved.covariance[-4:, -4:] + np.outer(of_scale, of_scale), rms(left) / np.abs(problem.installed.gain)
    )


def _gain_scale_std(calibration: CalibrationRecord) -> float:
    """Standard deviation of a factor common to all gains, as a share: their errors stem from one reference mass."""
    gain = {f"{joint.name}.gain": joint.gain for joint in calibration.joints if joint.gain is not None}
    places = [place for place, name in enumerate(calibration.covariance_of) if name in gain]
    if not places:
        return 0.0
    known = np.array([gain[calibration.covariance_of[place]] for place in places])
    return common_scale_std(np.array(calibration.covariance)[np.ix_(places, places)], known)


def raw_readings(position: Array, torque: Array, sigma: Array, calibration: CalibrationRecord) -> StaticReadings:
    """The sensors' own readings of true angles (K, n) [rad] and calibrated torques (K, n) [N·m], pose after pose."""
    zeros, gains = calibration.values("position_offset", 0.0), calibration.values("position_gain", 1.0)
    gain, offset = calibration.values("gain", 1.0), calibration.values("offset", 0.0)
    raw = (position - zeros) / gains
    return StaticReadings(raw, gain * torque + offset, sigma, direction=directions(raw))
