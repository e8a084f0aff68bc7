"""Held-out data: how well a calibration predicts the steps of sweeps that were left out of its fit."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from armlink.arm_file import ArmFile
from calib.arm.kinematics import gcomp_arm
from calib.fit.gravity_fit import sensor_parameters
from calib.fit.sweep_readings import FEWEST, SweepReadings
from calib.records.records import CalibrationRecord
from gcomp.arrays import Array
from gcomp.errors import GcompError
from gcomp.identify.global_fit import identify_global
from gcomp.identify.parameters import Prior
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict

NOT_BY_CHANCE = 3.0
"""Standard errors by which the held-out error must be larger to be called worse: by chance once in 740."""
WORSE = 1.05
"""Ratio of held-out RMS, new over old, below which it is not worse."""
REFIT_GAIN_STD = 0.2
"""Prior standard deviation of gains in the refit: without a mass it fixes the scale, which no prediction depends on."""


def worse_joint(new: Array, old: Array) -> tuple[int, float] | None:
    """First joint whose errors (K, n) are worse than the old ones beyond chance, and their RMS ratio; None if none."""
    ratios = ((j, worse_by(new[:, j], old[:, j])) for j in range(new.shape[1]))
    return next(((j, ratio) for j, ratio in ratios if ratio is not None), None)


def worse_by(new: Array, old: Array) -> float | None:
    """RMS of new errors (K,) over that of old ones if they are worse beyond chance, else None; NaN is left out."""
    counted = np.isfinite(new) & np.isfinite(old)
    if counted.sum() < FEWEST:
        return None
    difference = new[counted] ** 2 - old[counted] ** 2
    ratio = float(np.sqrt(np.mean(new[counted] ** 2) / max(float(np.mean(old[counted] ** 2)), 1e-300)))
    chance = NOT_BY_CHANCE * float(difference.std(ddof=1)) / np.sqrt(len(difference))
    return ratio if ratio > WORSE and float(difference.mean()) > chance else None


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
