"""Pushes on a creeping arm beside gravity and friction: contacts, springs, ripple.

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

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lombscargle

from calib.dataset import StallLine, SweepData
from calib.fit.calibration import SIGNIFICANCE
from calib.fit.findings import OUTLIER, FitFinding
from calib.fit.sweep_readings import SweepReadings
from gcomp.arrays import Array

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
LEAST_BINS = 8
"""Bins of a joint, over all its sweeps, in which a ripple is searched for."""
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
                f"{name}: {rows.sweeps[sweep]}: something pushed by {push:+.2f} N·m at"
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
                f"{name}: something pulls by {value:+.2f} N·m/rad of its position in all its sweeps: a cable under"
                " tension or a spring; free it and sweep again"
            )
            named.append(FitFinding(name, "spring", value, "N·m/rad", text))
    return tuple(named)


def ripple_cycles(rows: SweepReadings, residual: Array) -> Array:
    """Periods in a turn of the clearest ripple of each joint (n,); 0 where none is clear."""
    cycles = np.zeros(rows.readings.position.shape[1])
    for joint in range(len(cycles)):
        own = np.flatnonzero(rows.swept == joint)
        if own.size >= 2 * LEAST_BINS:
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
