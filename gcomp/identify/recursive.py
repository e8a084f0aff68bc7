"""Recursive identification of mass moments from single-joint sweeps, tip to base (docs/theory.md, section 2.3)."""

from dataclasses import dataclass

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask
from gcomp.errors import BadArray
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.readings import StaticReadings

DEAD_COLUMN = 1e-6
"""Share of g·√K below which a column's norm counts as zero: the axis was along gravity in every row (section 2.3)."""


@dataclass(frozen=True, eq=False)
class RecursiveFit:
    """Mass moments and sensor offsets found joint by joint."""

    beta: Array
    """Mass moments (2n,) [kg·m]; NaN if the sweeps do not determine them."""
    offset: Array
    """Sensor offsets (n,) [N·m]; 0 if declared known."""
    covariance: Array
    """Covariance of (β, o) (3n, 3n); NaN rows and columns where β is NaN."""
    identifiable: Mask
    """Mass moments that were found (2n,)."""


def identify_recursive(arm: Arm, readings: StaticReadings) -> RecursiveFit:
    """Mass moments from each joint's own torque, from the last joint to the first; equations (8) to (18) of [MH97].

    All readings in which a joint's torque counts are used together, from any number of its sweeps. They must be without
    a reference mass and calibrated to true angles and torques. Raises BadArray if a joint has none.
    """
    readings.require_arm(arm)
    if np.any(readings.load != 0):
        raise BadArray("the recursion takes unloaded readings only: leave out those with a reference mass")
    n = arm.n
    beta, offset, covariance = np.zeros(2 * n), np.zeros(n), np.zeros((3 * n, 3 * n))
    found = np.ones(2 * n, dtype=bool)
    for i in reversed(range(n)):
        rows = readings.counted[:, i]
        if not rows.any():
            raise BadArray(
                f"joint {arm.names[i]}: this joint has no usable torque reading: sweep it, or leave it out of the arm"
            )
        weight = 1 / readings.sigma[rows, i]
        regressor = gravity_regressor(arm, readings.position[rows])[:, i] * weight[:, None]
        own = slice(2 * i, 2 * i + 2)
        target = readings.torque[rows, i] * weight - regressor[:, 2 * i + 2 :] @ beta[2 * i + 2 :]
        columns, places = np.column_stack([regressor[:, own], weight]), [2 * i, 2 * i + 1, 2 * n + i]
        felt = _acting_moments(arm, regressor, weight)
        if not felt[own].all():
            found[own] = False
            columns, places = columns[:, 2:], places[2:]
        solver, enough = _solver(columns)
        if not enough:
            raise BadArray(
                f"joint {arm.names[i]}: {len(weight)} steps do not determine its moment: take more steps, "
                "over a wider range"
            )
        solution = solver @ target
        beta[own], offset[i] = (solution[:2] if found[2 * i] else 0.0), solution[-1]
        lever = -solver @ regressor[:, 2 * i + 2 :]
        distal = covariance[2 * i + 2 : 2 * n]
        covariance[places] += lever @ distal
        covariance[:, places] = covariance[places].T
        covariance[np.ix_(places, places)] = solver @ solver.T + lever @ distal[:, 2 * i + 2 : 2 * n] @ lever.T
        found[own] &= bool(found[2 * i + 2 :][felt[2 * i + 2 :]].all())
    lost = np.flatnonzero(~found)
    beta[lost] = np.nan
    covariance[lost] = covariance[:, lost] = np.nan
    return RecursiveFit(beta, offset, covariance, found)


def _acting_moments(arm: Arm, weighted: Array, weight: Array) -> Mask:
    """Moments that act on this joint's torque in these rows."""
    floor = DEAD_COLUMN * float(np.linalg.norm(arm.gravity)) * float(np.linalg.norm(weight))
    felt: Mask = np.linalg.norm(weighted, axis=0) > floor
    return felt


def _solver(columns: Array) -> tuple[Array, bool]:
    """(Pseudo-inverse of the columns, whether they are independent)."""
    left, values, right = np.linalg.svd(columns, full_matrices=False)
    if len(values) < columns.shape[1] or values[-1] <= 1e-9 * values[0]:
        return np.zeros(columns.T.shape), False
    return (right.T / values) @ left.T, True
