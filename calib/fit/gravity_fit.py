"""Gravity identification from sweeps: recursive from the tip to the base, then global, in calibrated torque."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.torque_calibration import TorqueCalibration
from calib.arm.kinematics import gcomp_arm
from calib.dataset import SweepData, digests
from calib.fit.calibration import rms
from calib.fit.sensor_fit import SensorFit
from calib.fit.sweep_readings import SweepReadings, sweep_readings
from calib.records.records import CalibrationRecord, GravityRecord, matrix, provenance
from gcomp.arrays import Array, Mask
from gcomp.errors import GcompError
from gcomp.identify.global_fit import GlobalFit, identify_global
from gcomp.identify.parameters import Parameters
from gcomp.identify.readings import StaticReadings
from gcomp.identify.recursive import RecursiveFit, identify_recursive
from gcomp.identify.sensor_model import joint_positions


@dataclass(frozen=True, eq=False)
class GravityFit:
    """Mass moments of the arm without load, with their covariance."""

    names: tuple[str, ...]
    beta: Array
    """From the global fit (2n,) [kg·m]; 0 for moments that gravity does not determine."""
    covariance: Array
    """(2n, 2n), the sensors' own uncertainty included; 0 for moments that are not determined."""
    identifiable: Mask
    """(2n,)"""
    recursive: RecursiveFit | None
    """Recursive fit from tip to base to the calibrated unloaded sweeps; None without a full unloaded pass."""
    residual_rms: Array
    """RMS of calibrated torque minus model over the unloaded readings that count (n,) [N·m]."""
    sources: dict[str, str]

    @property
    def std(self) -> Array:
        """Standard deviations of β (2n,) [kg·m]."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def record(self, arm_file: ArmFile, calibration: CalibrationRecord | None = None) -> GravityRecord:
        """The gravity record of this fit, made with the sensors of a calibration record."""
        return GravityRecord(
            **provenance(arm_file, self.sources),
            names=self.names,
            beta=tuple(self.beta.tolist()),
            covariance=matrix(self.covariance),
            identifiable=tuple(bool(found) for found in self.identifiable),
            gravity=tuple(gcomp_arm(arm_file).gravity.tolist()),
            calibration=None if calibration is None else calibration.id,
            tool=arm_file.tool,
        )


def identify_gravity(
    arm_file: ArmFile, data: Sequence[SweepData], sensors: SensorFit | CalibrationRecord
) -> GravityFit:
    """Mass moments from sweeps and either the sensor fit of the same sweeps or an earlier calibration record.

    With a sensor fit, whose estimate includes the moments, the global result is its own. With a record, its gains are
    kept and offsets are estimated again. Raises Refused if no torque scale is known, BadInput on bad data.
    """
    rows = sweep_readings([each.require(arm_file) for each in data])
    if isinstance(sensors, SensorFit):
        fit, calibration = sensors.fit, sensors.fit.complete
        _require_scale(sensors.names, np.isnan(sensors.value("gain")))
    else:
        calibration = sensor_parameters(sensors.require(arm_file))
        _require_scale(arm_file.joint_names, np.isnan(sensors.values("gain")))
        fit = _global(arm_file, rows, calibration)
    found = ~np.isnan(fit.values.beta)
    covariance = np.where(np.isnan(fit.beta_covariance), 0.0, fit.beta_covariance)
    residual = np.where(rows.readings.load[:, None] == 0, fit.residual, np.nan) / calibration.gain
    return GravityFit(
        names=arm_file.joint_names,
        beta=np.where(found, fit.values.beta, 0.0),
        covariance=covariance,
        identifiable=found,
        recursive=_recursion(arm_file, rows, calibration),
        residual_rms=np.nan_to_num(rms(residual)),
        sources=digests(data),
    )


def calibrated_readings(rows: SweepReadings, calibration: Parameters, which: Mask) -> StaticReadings:
    """Readings of the swept joints' own sensors, calibrated to true angles [rad] and torques [N·m]."""
    readings = rows.readings
    own = rows.own
    sensors = TorqueCalibration(calibration.gain, calibration.offset)
    true = replace(
        readings,
        position=joint_positions(calibration, readings),
        torque=np.where(own, sensors.invert(readings.torque), np.nan),
        sigma=readings.sigma / np.abs(calibration.gain),
    )
    return true.rows(which & own.any(axis=1))


def _recursion(arm_file: ArmFile, rows: SweepReadings, calibration: Parameters) -> RecursiveFit | None:
    readings = calibrated_readings(rows, calibration, rows.readings.load == 0)
    if len(readings) == 0 or not readings.counted.any(axis=0).all():
        return None
    try:
        return identify_recursive(gcomp_arm(arm_file), readings)
    except GcompError:
        return None


def _global(arm_file: ArmFile, rows: SweepReadings, calibration: Parameters) -> GlobalFit:
    """Mass moments, offsets and, with a load, its point; gains and position sensors are known."""
    unknown = {"beta", "offset"} | ({"rho"} if any(rows.masses) else set())
    return identify_global(
        gcomp_arm(arm_file), rows.readings, unknown=unknown, start=calibration, position_sigma=rows.position_sigma
    )


def sensor_parameters(record: CalibrationRecord, **known: Array) -> Parameters:
    """A record's sensors, nominal if it has no value, with other families as `known`."""
    return Parameters.nominal(
        len(record.joints),
        gain=record.values("gain", 1.0),
        offset=record.values("offset", 0.0),
        position_gain=record.values("position_gain", 1.0),
        position_offset=record.values("position_offset", 0.0),
        **known,
    )


def _require_scale(names: tuple[str, ...], lost: Mask) -> None:
    """Raise Refused if no joint's gain is known: mass moments are then known up to a factor only."""
    if lost.all():
        raise Refused(
            f"no torque gain of {', '.join(names)} is known, so mass moments are known only up to a common "
            "factor: sweep with --reference-mass on an arm whose axes do not all meet, or give a calibration "
            "record"
        )
