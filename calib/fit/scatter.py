"""How far the readings of a creep scatter about the fit, and what they have in common.

Half sum and half difference of both directions at one place scatter each in its own way: what the model lacks of
gravity is alike in both directions and touches no friction; what it lacks of friction has opposite signs and touches no
gravity. Both scatters are measured. What is left of either is alike over neighbouring bins, too; a bin then counts for
less than one reading: its variance is multiplied by 1 + 2 Σ ρ_k, with the correlations ρ_k of residuals k bins apart,
summed up to the first that chance could make.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.fit.sweep_readings import SweepReadings
from gcomp.arrays import Array

LEAST_STD_SHARE = 1e-4
"""Least standard deviation of a row, as a share of rated torque: rounding of the sums that the readings are."""
NOISE_ROUNDS = 4
"""Fits, each with the noise that the residuals of the one before show."""
USUAL_BINS = 5
"""Bins that the usual scatter of a joint's sweeps counts for, beside those of a sweep itself."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Covariance of the rows, sweep by sweep."""

    sigma: Array
    """Standard deviation of each row (R,) [N·m]."""
    blocks: tuple[tuple[NDArray[Any], Array], ...]
    """Rows (K,) of each sweep, and the inverse of the triangular root of their covariance (K, K)."""

    @classmethod
    def even(cls, rows: SweepReadings, sigma: Array) -> "Scatter":
        """Rows that have nothing in common."""
        blocks = [np.flatnonzero(rows.readings.series == sweep) for sweep in np.unique(rows.readings.series)]
        return cls(sigma, tuple((each, np.asarray(np.diag(1 / sigma[each]))) for each in blocks))

    def whitened(self, columns: Array) -> Array:
        """Columns (R, …) of which the rows have unit variance and nothing in common."""
        white = np.empty_like(columns)
        for rows, whitening in self.blocks:
            white[rows] = whitening @ columns[rows]
        return white


def scatter(
    rows: SweepReadings, residual: Array, rated: Array, freedom: float, by_degree: Array, apart: bool = True
) -> Scatter:
    """Scatter of the rows as their residuals (R,) [N·m] have it.

    A sweep in which the arm swung scatters more than others of its joint: its own scatter counts, drawn towards the
    joint's as by `USUAL_BINS` further bins. `freedom` is rows less unknowns, as a share of the rows; `by_degree` (R,)
    [N·m] is what the temperature's uncertainty makes of each reading, alike in all rows of a sweep. Without
    `apart` both directions have one variance, and nothing in common: a contact would pass for scatter of the half sums.
    """
    sigma, blocks = np.zeros(len(rows)), []
    residual = residual / np.sqrt(max(freedom, 0.2))
    for joint in range(len(rated)):
        pairs = [_row_pairs(rows, joint, sweep) for sweep in np.unique(rows.readings.series[rows.swept == joint])]
        floor = (LEAST_STD_SHARE * float(rated[joint])) ** 2 / 2
        alike = _spread([(residual[up] + residual[down]) / 2 for up, down, _ in pairs], floor)
        opposite = _spread([(residual[up] - residual[down]) / 2 for up, down, _ in pairs], floor)
        if not apart:
            alike = opposite = [(a + b) / 2 for a, b in zip(alike, opposite, strict=True)]
        for (up, down, single), a, b in zip(pairs, alike, opposite, strict=True):
            each = np.concatenate([up, down, single])
            covariance = np.diag(np.full(each.size, a + b))
            for k in range(up.size):
                covariance[k, up.size + k] = covariance[up.size + k, k] = a - b
            covariance += np.outer(by_degree[each], by_degree[each])
            sigma[each] = np.sqrt(np.diag(covariance))
            blocks.append((each, np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), float)))
    return Scatter(sigma, tuple(blocks))


def _row_pairs(
    rows: SweepReadings, joint: int, sweep: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """(Rows upwards, rows downwards at the same places, rows of places that only one direction has), by position."""
    own = np.flatnonzero(rows.readings.series == sweep)
    own = own[np.argsort(rows.readings.position[own, joint])]
    up, down = own[rows.side[own] > 0], own[rows.side[own] <= 0]
    if up.size < 2 or not down.size:
        return own[:0], own[:0], own
    there, back = rows.readings.position[up, joint], rows.readings.position[down, joint]
    nearest = np.abs(there[:, None] - back[None, :]).argmin(axis=1)
    same = np.abs(there - back[nearest]) < float(np.median(np.diff(there))) / 2
    _, first = np.unique(nearest[same], return_index=True)
    up, down = up[same][first], down[nearest[same][first]]
    return up, down, own[~np.isin(own, np.concatenate([up, down]))]


def _spread(series: list[Array], floor: float) -> list[float]:
    """Variance of each of a joint's sweeps, with what neighbouring bins have in common."""
    means = [float(np.mean(one**2)) for one in series if one.size]
    usual = max(float(np.median(means)) if means else 0.0, floor)
    variances = [max((float(one @ one) + USUAL_BINS * usual) / (one.size + USUAL_BINS), floor) for one in series]
    common = inflation([one / np.sqrt(each) for one, each in zip(series, variances, strict=True) if one.size >= 4])
    return [common * each for each in variances]


def inflation(series: Sequence[Array], least: float = 0.0) -> float:
    """1 + 2 Σ ρ_k of series of neighbouring residuals, up to the first correlation below `least`, by default that
    chance makes of independent ones."""
    if not series:
        return 1.0
    power = sum(float(one @ one) for one in series) / sum(one.size for one in series)
    total = 1.0
    for lag in range(1, max(one.size for one in series) // 2):
        pairs = [(one[lag:], one[:-lag]) for one in series if one.size > lag]
        count = sum(a.size for a, _ in pairs)
        alike = sum(float(a @ b) for a, b in pairs) / count / max(power, 1e-30)
        if alike <= (least or 1 / np.sqrt(count)):
            break
        total += 2 * alike
    return total
