"""Held-out rows in the field, predicted by a fit without them and by the record before."""

import numpy as np

from calib.field.field_fit import FieldFit
from calib.field.thresholds import BLOCK
from calib.fit.heldout import FEWEST
from calib.records.records import CalibrationRecord
from gcomp.arrays import Array
from gcomp.identify.readings import StaticReadings


def heldout_errors(rows: StaticReadings, fit: FieldFit, before: CalibrationRecord) -> tuple[Array, Array]:
    """Errors (K, n) [N·m] of held-out rows with a new calibration and with the one before; NaN if they do not count.

    For every joint a line of readings over model torque is fitted to every second block of rows and predicts the
    others.
    """
    block = np.arange(len(rows.torque)) // min(BLOCK, max(len(rows.torque) // 6, 1)) % 2
    old = rows.torque - before.torque_calibration().apply(fit.torque)
    new = np.full_like(old, np.nan)
    counted = np.isfinite(old) & np.isfinite(fit.gain)
    for j in range(old.shape[1]):
        for held in (0, 1):
            train, test = counted[:, j] & (block != held), counted[:, j] & (block == held)
            if train.sum() < FEWEST:
                continue
            line = np.polyfit(fit.torque[train, j], rows.torque[train, j], 1)
            new[test, j] = rows.torque[test, j] - np.polyval(line, fit.torque[test, j])
    return new, old
