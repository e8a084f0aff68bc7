"""Does the sensor model hold? Where it does not, at which joint, and why: goodness of fit, outliers, left-out poses."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from calib.fit.findings import Finding, effect_said, encoders_said, outliers_said, scattered
from calib.fit.refinement import Extra, Refined, refine
from calib.fit.sweep_readings import SweepReadings
from calib.fit.unmodelled_effects import Effect, size_of, strongest
from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask
from gcomp.identify.global_fit import GlobalFit
from gcomp.identify.parameters import Prior
from gcomp.identify.sensor_model import predict

MOST_EFFECTS = 6
"""Effects that are looked for one after the other."""
OUTLIER = 6.0
"""Robust standard deviations, its own pull on the fit taken out, from which a reading is an outlier."""
FEWEST = 8
"""Readings of a joint from which outliers are told from noise."""
MOST_OUTLIERS = 0.15
"""Share of a joint's readings that may be left out as outliers; where there are more, the model is at fault."""
PLATEAU, PLATEAU_POSES = 4.0, 4
"""Standard deviations within which readings count as equal; different poses at one extreme from which it is a limit."""
SWING, BULK = 800.0, (10.0, 90.0)
"""Standard deviations that a joint's torque must range over: else a sinusoid's own peak is as flat as a limit. Between
these percentiles, for a knock makes no range."""
BLURRED = 3.0
"""A reading so many times less exact than most, as of an arm that swung, is near to every limit: it shows none."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """How well one sweep is told by all others."""

    sweep: str
    joint: int
    """The swept joint."""
    rms: float
    """Of its readings minus what a fit without it says [N·m]."""
    ratio: float
    """That over what is to be expected."""


@dataclass(frozen=True, eq=False)
class Goodness:
    """The fit at its end, and what was found on the way."""

    refined: Refined
    findings: tuple[Finding, ...]
    outliers: Mask
    """Readings left out (K, n)."""
    left_out: tuple[LeftOut, ...]


def examine(
    kinematics: Arm, rows: SweepReadings, fit: GlobalFit, priors: Mapping[str, Prior], rated: Array
) -> Goodness:
    """Refine a global fit, one effect after another that its residuals ask for, without outliers. rated (n,) [N·m]."""
    rows, findings = _without_plateaus(kinematics.names, rows)
    encoders = encoders_said(kinematics.names, rows)
    effects, sound = list[Effect](), rows.readings.sigma
    outliers = np.zeros(sound.shape, dtype=bool)

    def fitted() -> Refined:
        extras = tuple(extra for effect in effects for extra in effect.extras)
        kept = replace(rows.readings, torque=np.where(outliers, np.nan, rows.readings.torque))
        return refine(kinematics, kept, fit, priors, rows.resolution, extras)

    refined = fitted()
    for _ in range(MOST_EFFECTS):
        strange = _outliers(kinematics, refined, rows, [extra for effect in effects for extra in effect.extras])
        if (strange != outliers).any():
            outliers = strange
            refined = fitted()
        found = strongest(kinematics, rows, ~outliers, refined, rated)
        if found is None:
            break
        effects.append(found)
        refined = fitted()
        if found.doubt is not None:
            rows = replace(rows, readings=replace(rows.readings, sigma=_doubted(sound, effects, refined)))
            refined = fitted()
    for effect, coefficient in _sized(effects, refined):
        findings.append(effect_said(kinematics.names, effect, coefficient, refined, rated))
    findings += outliers_said(kinematics.names, rows, outliers)
    findings += scattered(kinematics.names, refined, rated, {finding.joint for finding in findings})
    said = encoders or findings  # what a wrong position does elsewhere is no finding of its own
    return Goodness(refined, tuple(said), outliers, leave_out(refined, rows))


def _sized(effects: list[Effect], refined: Refined) -> Iterator[tuple[Effect, Array]]:
    """Each effect with its coefficients."""
    place = 0
    for effect in effects:
        yield effect, refined.coefficients[place : place + len(effect.extras)]
        place += len(effect.extras)


def _doubted(sigma: Array, effects: list[Effect], refined: Refined) -> Array:
    """Standard deviations (K, n) [N·m] with what the effects leave open of each reading."""
    square = sigma**2
    for effect, coefficient in _sized(effects, refined):
        if effect.doubt is not None:
            square[:, effect.joint] += (effect.doubt * size_of(coefficient)) ** 2
    return np.sqrt(square)


def _without_plateaus(names: tuple[str, ...], rows: SweepReadings) -> tuple[SweepReadings, list[Finding]]:
    """The rows without readings at a torque beyond which a sensor never went though the arm moved: it saturates."""
    torque, flat, found = rows.readings.torque, np.zeros(rows.readings.torque.shape, dtype=bool), []
    for joint, name in enumerate(names):
        counted = _sharp(rows, joint)
        value, sigma = torque[counted, joint], rows.readings.sigma[counted, joint]
        if len(counted) < FEWEST or np.ptp(np.percentile(value, BULK)) < SWING * np.median(sigma):
            continue
        for side in (1.0, -1.0):
            near = counted[side * value > np.max(side * value) - PLATEAU * sigma]
            poses = np.round(rows.readings.position[near], 1)
            distinct = np.unique(np.column_stack([poses, rows.readings.load[near]]), axis=0)
            if len(distinct) >= max(PLATEAU_POSES, 0.1 * len(counted)):
                flat[near, joint] = True
                limit = float(side * np.max(side * value))
                text = f"{name}: {len(near)} readings at different poses stand at {limit:.4g} N·m: the sensor saturates"
                found.append(Finding(name, "saturation", limit, "N·m", text))
    readings = replace(rows.readings, torque=np.where(flat, np.nan, torque))
    return (replace(rows, readings=readings) if found else rows), found


def _sharp(rows: SweepReadings, joint: int) -> npt.NDArray[np.intp]:
    """The rows in which a joint's reading counts and is exact enough to show a limit."""
    counted = np.flatnonzero(rows.readings.counted[:, joint])
    sigma = rows.readings.sigma[counted, joint]
    return counted[sigma <= BLURRED * np.median(sigma)] if len(counted) else counted


def leave_out(refined: Refined, rows: SweepReadings) -> tuple[LeftOut, ...]:
    """Each sweep's readings against a fit of all others, by the block form of the leave-one-out residual."""
    linear, found = refined.linear, []
    count = len(linear.row)
    series = rows.readings.series[linear.row]
    own = rows.swept[linear.row] == linear.joint
    for sweep, name in enumerate(rows.sweeps):
        here = np.flatnonzero((series == sweep) & own)
        if not len(here):
            continue
        part = linear.basis[:count][here]
        rest = np.eye(len(here)) - part @ part.T
        size, turn = np.linalg.eigh(rest)
        kept = size > 1e-8
        residual = linear.residual[here]
        outside = turn[:, kept] @ ((turn[:, kept].T @ residual) / size[kept])
        expected = float(residual @ outside) / max(int(kept.sum()), 1)
        rms = float(np.sqrt(np.mean((outside * linear.sigma[here]) ** 2)))
        found.append(LeftOut(name, int(linear.joint[here[0]]), rms, float(np.sqrt(max(expected, 0.0)))))
    return tuple(found)


def _outliers(kinematics: Arm, refined: Refined, rows: SweepReadings, extras: list[Extra]) -> Mask:
    """Readings (K, n) that no noise explains: deleted residuals, in robust standard deviations of their joint.

    Those left out before are judged again, for an effect found since may explain them.
    """
    linear, counted = refined.linear, rows.readings.counted
    error = rows.readings.torque - predict(kinematics, refined.fit.complete, rows.readings)
    error -= sum((value * extra.column for value, extra in zip(refined.coefficients, extras, strict=True)), 0.0 * error)
    deleted = error / (rows.readings.sigma * refined.factor)
    inside = np.zeros(counted.shape, dtype=bool)
    inside[linear.row, linear.joint] = True
    count = len(linear.row)
    deleted[linear.row, linear.joint] = linear.residual[:count] / np.sqrt(np.maximum(1 - linear.leverage, 1e-3))
    flags = np.zeros(counted.shape, dtype=bool)
    for joint in range(kinematics.n):
        used = np.abs(deleted[inside[:, joint], joint])
        if len(used) < FEWEST:
            continue
        size = np.where(counted[:, joint], np.abs(deleted[:, joint]), 0.0)
        noise = 1 / max(refined.factor[joint], 1.0)  # sigma has been raised by the factor, which outliers raise
        bound = OUTLIER * max(1.4826 * float(np.median(used)), noise)
        strange = (size > bound) & (~inside[:, joint] | (size > 0.5 * size[inside[:, joint]].max()))
        if strange.sum() <= MOST_OUTLIERS * counted[:, joint].sum():
            flags[:, joint] = strange
    return flags
