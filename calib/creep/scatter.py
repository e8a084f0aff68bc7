"""How far the readings of a creep scatter about the fit, and for how many independent readings they count.

What the model lacks (friction over position, cogging) leaves residuals that are alike over neighbouring bins. A bin
then counts for less than one reading: its standard deviation is multiplied by the root of 1 + 2 Σ ρ_k, with the
correlations ρ_k of residuals k bins apart, summed up to the first that is not positive.
"""

import numpy as np
from numpy.typing import NDArray

from calib.creep.rows import CreepRows
from gcomp.arrays import Array

LEAST_SHARE = 1e-4
"""Least standard deviation of a row, as a share of rated torque: rounding of the sums that the readings are."""
USUAL_ROWS = 10
"""Rows that the usual scatter of a joint's sweeps counts for, beside those of a sweep itself."""
MOST = 16.0
"""Most that a variance is multiplied by; a choice, for sweeps of a dozen bins."""


def scatter(rows: CreepRows, residual: Array, rated: Array, freedom: float) -> tuple[Array, Array]:
    """(Standard deviation of each row (R,) [N·m], factor for what neighbours have in common, by joint (n,)).

    A sweep in which the arm swung scatters more than others of its joint: its own scatter counts, drawn towards the
    joint's as by `USUAL_ROWS` further rows. `freedom` is rows less unknowns, as a share of the rows.
    """
    n = len(rated)
    sigma, factor = np.zeros(len(rows)), np.ones(n)
    for joint in range(n):
        own = np.flatnonzero(rows.joint == joint)
        if not own.size:
            continue
        square = residual**2 / max(freedom, 0.2)
        sweeps = [own[rows.sweep[own] == sweep] for sweep in np.unique(rows.sweep[own])]
        usual = float(np.median([square[each].mean() for each in sweeps]))
        for each in sweeps:
            variance = (square[each].sum() + USUAL_ROWS * usual) / (each.size + USUAL_ROWS)
            sigma[each] = max(float(np.sqrt(variance)), LEAST_SHARE * float(rated[joint]))
        factor[joint] = np.sqrt(_inflation(rows, residual / sigma.clip(1e-12), own))
    return sigma, factor


def _inflation(rows: CreepRows, residual: Array, own: NDArray[np.intp]) -> float:
    """1 + 2 Σ ρ_k over the sweeps of one joint."""
    series = []
    for sweep in np.unique(rows.sweep[own]):
        for side in (-1.0, 1.0):
            each = own[(rows.sweep[own] == sweep) & (rows.side[own] == side)]
            if each.size >= 4:
                joint = rows.joint[each[0]]
                series.append(residual[each[np.argsort(rows.position[each, joint])]])
    if not series:
        return 1.0
    power = sum(float((one**2).sum()) for one in series) / sum(one.size for one in series)
    total = 1.0
    for lag in range(1, max(one.size for one in series) // 2):
        pairs = [(one[lag:], one[:-lag]) for one in series if one.size > lag]
        count = sum(a.size for a, _ in pairs)
        alike = sum(float((a * b).sum()) for a, b in pairs) / count / max(power, 1e-30)
        if alike <= 0.0:
            break
        total += 2 * alike
    return min(total, MOST)
