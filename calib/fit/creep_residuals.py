"""Residuals of creeps: how far they scatter, and what pushes beside gravity and friction: contacts, springs, ripple.

Scatter: half sum and half difference of both directions at one place scatter each in its own way: what the model lacks
of gravity is alike in both directions and touches no friction; what it lacks of friction has opposite signs and touches
no gravity. Both scatters are measured. What is left of either is alike over neighbouring bins, too; a bin then counts
for less than one reading: its variance is multiplied by 1 + 2 Σ ρ_k, with the correlations ρ_k of residuals k bins
apart, summed up to the first that chance could make.

Contact: a push that depends on position shows as a residual that is alike in both directions, large over neighbouring
bins, and that other sweeps of the same joint do not have. Each sweep's residuals, averaged over these, are compared
with the middle of those of all sweeps of that joint; a sweep that stands out is left out of the fit and named with its
worst place.

Spring: a cable under tension pulls in every sweep of its joint, so that no sweep stands out, and mass moments, zeros
and gains take it up. Every arm is therefore fitted once more with a spring at each joint, free within wide bounds.

Ripple, as of a gear's teeth or the motor's poles, is the same in both directions and in every sweep of its joint. One
whose period is longer than a bin is not averaged out: as a residual it would widen the intervals of friction, which it
does not touch, and those of gravity, whose course is much slower. Its strongest line is therefore searched for in the
residuals, and the fit has its cosine and sine as unknowns.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lombscargle

from calib.dataset import StallLine, SweepData
from calib.fit.calibration import OUTLIER, SIGNIFICANCE, USUAL_ROWS, FitFinding
from calib.fit.sweep_readings import FEWEST, SweepReadings
from gcomp.arrays import Array

LEAST_STD_SHARE = 1e-4
"""Least standard deviation of a row, as a share of rated torque: rounding of the sums that the readings are."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Covariance of the rows, sweep by sweep."""

    blocks: tuple[tuple[NDArray[Any], Array], ...]
    """Rows (K,) of each sweep, and the inverse of the triangular root of their covariance (K, K)."""

    @classmethod
    def even(cls, rows: SweepReadings, sigma: Array) -> "Scatter":
        """Rows that have nothing in common, of standard deviations sigma (R,) [N·m]."""
        blocks = [np.flatnonzero(rows.readings.series == sweep) for sweep in np.unique(rows.readings.series)]
        return cls(tuple((each, np.asarray(np.diag(1 / sigma[each]))) for each in blocks))

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
    joint's as by `USUAL_ROWS` further bins. `freedom` is rows less unknowns, as a share of the rows; `by_degree` (R,)
    [N·m] is what the temperature's uncertainty makes of each reading, alike in all rows of a sweep. Without
    `apart` both directions have one variance, and nothing in common: a contact would pass for scatter of the half sums.
    """
    blocks = []
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
            blocks.append((each, np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), float)))
    return Scatter(tuple(blocks))


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
    variances = [max((float(one @ one) + USUAL_ROWS * usual) / (one.size + USUAL_ROWS), floor) for one in series]
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


SMOOTH = 3
"""Neighbouring bins that are averaged, those of both directions."""
LEAST_PUSH = 0.02
"""Least torque that counts as a disturbance, as a share of rated torque."""
SPRING_SHARE = 0.1
"""Standard deviation beforehand of a spring that is looked for, of rated torque per rad."""
LEAST_PULL = 0.03
"""Least pull over the range of the sweeps, as a share of rated torque."""
LEAST_PERIODS = 2.0
"""Periods over the way of a sweep that a ripple has at least: slower ones could be gravity's."""
OVERSAMPLING = 16
"""Tried frequencies per reciprocal of the joint's way."""
RIPPLE_POWER = 12.0
"""Least power of a line, in twice the variance that is left without it: chance gives it once in 160,000 frequencies."""


def contact_finding(data: SweepData, stall: StallLine) -> FitFinding:
    """Of a creep that ended because its joint met something."""
    joints = {} if data.plan is None else {sweep.name: data.manifest.names[sweep.joint] for sweep in data.plan.sweeps}
    return FitFinding(joints.get(stall.reading, ""), "contact", float("nan"), "", stall.reason)


def disturbed_sweep(
    names: Sequence[str], rows: SweepReadings, residual: Array, rated: Array
) -> tuple[int, FitFinding] | None:
    """The most disturbed sweep and its finding, if there is one; those next to it may follow from its residuals."""
    worst, most = None, 0.0
    for joint, name in enumerate(names):
        own = np.flatnonzero(rows.swept == joint)
        series = rows.readings.series[own]
        largest = [(sweep, *_largest(rows, residual, own[series == sweep])) for sweep in np.unique(series).tolist()]
        if len(largest) < 3:
            continue
        sweep, row, size = max(largest, key=lambda each: each[2])
        usual = float(np.median([each[2] for each in largest]))
        push = float(residual[row])
        if size > max(OUTLIER * usual, LEAST_PUSH * rated[joint]) and abs(push) / rated[joint] > most:
            most = abs(push) / rated[joint]
            text = (
                f"{name}: {rows.sweeps[sweep]}: something pushed the joint with {push:+.2f} N·m at"
                f" {rows.readings.position[row, joint]:.2f} rad: contact with the surroundings or the arm itself, or a"
                " cable under tension; the sweep is left out"
            )
            worst = sweep, FitFinding(name, "contact", push, "N·m", text)
    return worst


def _largest(rows: SweepReadings, residual: Array, own: NDArray[np.intp]) -> tuple[int, float]:
    """(Row, size) of the largest residual of one sweep, averaged over neighbouring bins and both directions."""
    each = own[np.argsort(rows.swept_value(rows.readings.position)[own])]
    if each.size < 2 * SMOOTH:
        return int(own[0]), 0.0
    mean = np.convolve(residual[each], np.full(2 * SMOOTH, 0.5 / SMOOTH), mode="valid")
    place = int(np.argmax(np.abs(mean)))
    return int(each[place + SMOOTH]), float(abs(mean[place]))


def springs(
    names: Sequence[str], rows: SweepReadings, stiffness: Array, std: Array, rated: Array
) -> tuple[FitFinding, ...]:
    """Springs of a fit in which they were free, with their standard deviations (n,) [N·m/rad]."""
    named = []
    for joint, name in enumerate(names):
        own, value = rows.readings.position[rows.swept == joint, joint], float(stiffness[joint])
        pull = abs(value) * float(np.ptp(own)) if own.size else 0.0
        if pull > LEAST_PULL * rated[joint] and abs(value) > SIGNIFICANCE * std[joint]:
            text = (
                f"{name}: a spring of {value:+.2f} N·m/rad acts in all its sweeps: free the cable or spring, and "
                "sweep again"
            )
            named.append(FitFinding(name, "spring", value, "N·m/rad", text))
    return tuple(named)


def ripple_cycles(rows: SweepReadings, residual: Array) -> Array:
    """Periods in a turn of the clearest ripple of each joint (n,); 0 where none is clear."""
    cycles = np.zeros(rows.readings.position.shape[1])
    for joint in range(len(cycles)):
        own = np.flatnonzero(rows.swept == joint)
        if own.size >= 2 * FEWEST:
            cycles[joint] = _clearest_cycles(rows, residual, joint, own)
    return cycles


def _clearest_cycles(rows: SweepReadings, residual: Array, joint: int, own: NDArray[np.intp]) -> float:
    position, series, spacing, way = rows.readings.position[own, joint], rows.readings.series[own], [], []
    for sweep in np.unique(series):
        one = np.sort(position[(series == sweep) & (rows.side[own] > 0)])
        if one.size > 2:
            spacing.append(float(np.median(np.diff(one))))
            way.append(float(np.ptp(one)))
    if not way:
        return 0.0
    lowest, highest = 2 * np.pi * LEAST_PERIODS / max(way), np.pi / float(np.median(spacing))
    tried = np.arange(lowest, highest, 2 * np.pi / float(np.ptp(position)) / OVERSAMPLING)
    if not tried.size:
        return 0.0
    left = residual[own] - residual[own].mean()
    power = lombscargle(position, left, tried)  # half of the sum of squares that a line explains
    rest = (float(left @ left) - 2 * float(power.max())) / (own.size - 3)
    return float(tried[np.argmax(power)]) if power.max() > RIPPLE_POWER * max(rest, 1e-30) else 0.0
