"""Gravity from sweeps in calibrated torque, recursive from the tip to the base, then global; sensors are given.

And how well these sensors predict the steps of sweeps that were left out of their fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.torque_calibration import TorqueCalibration
from calib.arm.kinematics import gcomp_arm
from calib.dataset import SweepData, digests
from calib.fit.calibration import rms
from calib.fit.sensor_fit import SensorFit
from calib.fit.sweep_readings import FEWEST, SweepReadings, sweep_readings
from calib.records.records import CalibrationRecord, GravityRecord, HeldOut, HeldOutJoint, matrix, provenance
from gcomp.arrays import Array, Mask
from gcomp.errors import GcompError
from gcomp.identify.global_fit import identify_global
from gcomp.identify.parameters import Parameters, Prior
from gcomp.identify.readings import StaticReadings
from gcomp.identify.recursive import RecursiveFit, identify_recursive
from gcomp.identify.sensor_model import joint_positions, predict


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
        unknown = {"beta", "offset"} | ({"rho"} if any(rows.masses) else set())
        sigma = rows.position_sigma
        fit = identify_global(
            gcomp_arm(arm_file), rows.readings, unknown=unknown, start=calibration, position_sigma=sigma
        )
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


def _recursion(arm_file: ArmFile, rows: SweepReadings, calibration: Parameters) -> RecursiveFit | None:
    """Of the swept joints' own sensors without load, calibrated to true angles and torques."""
    readings, own, sensors = rows.readings, rows.own, TorqueCalibration(calibration.gain, calibration.offset)
    true = replace(
        readings,
        position=joint_positions(calibration, readings),
        torque=np.where(own, sensors.invert(readings.torque), np.nan),
        sigma=readings.sigma / np.abs(calibration.gain),
    ).rows((readings.load == 0) & own.any(axis=1))
    if len(true) == 0 or not true.counted.any(axis=0).all():
        return None
    try:
        return identify_recursive(gcomp_arm(arm_file), true)
    except GcompError:
        return None


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
            "factor: sweep with --reference-mass on an arm whose axes do not all meet, or give a calibration record"
        )


REFIT_GAIN_STD = 0.2
"""Prior standard deviation of gains in the refit: without a mass it fixes the scale, which no prediction depends on."""


def held_out(old: CalibrationRecord, new_errors: Array, old_errors: Array) -> HeldOut:
    """The proof of a record that replaces `old`, from the errors (K, n) of both; NaN is left out."""
    found, tiny = [], 1e-30
    for j, joint in enumerate(old.joints):
        counted = np.isfinite(new_errors[:, j]) & np.isfinite(old_errors[:, j])
        if counted.sum() < FEWEST:
            continue
        new, before = new_errors[counted, j] ** 2, old_errors[counted, j] ** 2
        ratio = float(np.sqrt(new.mean() / max(float(before.mean()), tiny)))
        error = max(float((new - before).std(ddof=1)) / np.sqrt(len(new)), tiny)
        deviations = float(np.clip((new - before).mean() / error, -1e6, 1e6))  # JSON has no infinity
        found.append(HeldOutJoint(joint=joint.name, ratio=ratio, deviations=deviations))
    return HeldOut(against=old.id, joints=tuple(found))


def held_out_steps(
    new: CalibrationRecord,
    old: CalibrationRecord,
    arm: ArmFile,
    data: Sequence[SweepData],
    gravity: GravityRecord | None = None,
) -> HeldOut:
    """The proof of a record from sweeps, by their held-out steps.

    New gains, offsets and mass moments are estimated from the other steps; the old record's gains and offsets are
    fixed, and so are the mass moments of `gravity`; without it those are estimated too. A record that was fitted to
    some of these readings is not judged by them.
    """
    digests = {each.digest for each in data}
    if old.is_fitted_to(digests):
        return HeldOut(against=old.id)
    rows = sweep_readings([each.require(arm) for each in data])
    independent = gravity is not None and not gravity.is_fitted_to(digests)
    beta = np.array(gravity.carrying(arm).beta) if gravity is not None and independent else None
    fresh = heldout_scores(new, arm, rows, refit=True)
    return held_out(old, fresh, heldout_scores(old, arm, rows, refit=False, beta=beta))


def heldout_scores(
    record: CalibrationRecord, arm_file: ArmFile, rows: SweepReadings, refit: bool, beta: Array | None = None
) -> Array:
    """Prediction errors (K, n) of held-out steps over their standard deviation; NaN if they do not count.

    Every second step of each sweep is held out, then the other half. With `refit` gains and offsets are estimated from
    the remaining steps, else they are the record's; likewise mass moments unless `beta` (2n,) [kg·m] is given.
    """
    kinematics, score = gcomp_arm(arm_file), np.full(rows.readings.torque.shape, np.nan)
    doubt = record.discrepancy("level") * np.abs(record.values("gain", 1.0))
    rows = replace(rows, readings=replace(rows.readings, sigma=np.hypot(rows.readings.sigma, doubt)))
    start = sensor_parameters(record, **({} if beta is None else {"beta": beta}))
    priors = {"gain": Prior(start.gain, REFIT_GAIN_STD)} if refit else {}
    fold = _folds(rows)
    unknown = {"rho"} if any(rows.masses) else set[str]()
    unknown |= ({"gain", "offset"} if refit else set()) | ({"beta"} if beta is None else set())
    for left_out in (0, 1):
        kept, complete = rows.readings.rows(fold != left_out), start
        try:
            if unknown:
                complete = identify_global(kinematics, kept, unknown=unknown, start=start, priors=priors).complete
        except GcompError:
            continue
        held: StaticReadings = rows.readings.rows(fold == left_out)
        score[fold == left_out] = (held.torque - predict(kinematics, complete, held)) / held.sigma
    return score


def _folds(rows: SweepReadings) -> npt.NDArray[np.int64]:
    """0 or 1 for every row: the steps of each sweep alternate, both directions of one step together."""
    fold = np.zeros(len(rows.readings), dtype=np.int64)
    for sweep in range(len(rows.sweeps)):
        here = rows.readings.series == sweep
        joint = int(rows.swept[here][0])
        if joint < 0:
            fold[here] = np.arange(here.sum()) % 2
            continue
        steps = rows.readings.position[here, joint]
        gap = max(np.ptp(steps) / max(here.sum(), 1) / 2, 1e-6)
        order = np.argsort(steps)
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.concatenate([[0], np.cumsum(np.diff(steps[order]) > gap)])
        fold[here] = rank % 2
    return fold
