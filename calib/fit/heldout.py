"""Held-out data: how well a calibration predicts the steps of sweeps that were left out of its fit."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from armlink.arm_file import ArmFile
from calib.arm.kinematics import gcomp_arm
from calib.dataset import SweepData
from calib.fit.gravity_fit import sensor_parameters
from calib.fit.sweep_readings import FEWEST, SweepReadings, sweep_readings
from calib.records.records import CalibrationRecord, GravityRecord, HeldOut, HeldOutJoint
from gcomp.arrays import Array
from gcomp.errors import GcompError
from gcomp.identify.global_fit import identify_global
from gcomp.identify.parameters import Prior
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict

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
