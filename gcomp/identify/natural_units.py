"""Natural units: the size of a change that matters, for each parameter (docs/theory.md, section 7.3)."""

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.identify.parameters import Parameters
from gcomp.identify.readings import StaticReadings


def natural_units(arm: Arm, readings: StaticReadings, start: Parameters) -> Array:
    """Natural units of the parameter vector (6n + 3,).

    The gain of the start, 1 rad and 1 m; the RMS reading of the most loaded joint for offsets, that over g for mass
    moments.
    """
    with np.errstate(invalid="ignore"):
        per_joint = np.sqrt(np.nansum(readings.torque**2, axis=0) / np.maximum(readings.counted.sum(axis=0), 1))
    torque = float(per_joint.max()) or 1.0
    n, ones = arm.n, np.ones(arm.n)
    moment = torque / (float(np.linalg.norm(arm.gravity)) or 1.0)
    return Parameters(np.abs(start.gain), torque * ones, ones, ones, moment * np.ones(2 * n), np.ones(3)).vector
