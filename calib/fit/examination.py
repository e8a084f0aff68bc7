"""Whether the sensor model holds and, if not, at which joint and why: effects, outliers, leave-one-out residuals.

And the doubt of the fit about the torque at a new pose, beyond the covariance of its parameters, joint by joint.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from calib.fit.calibration import OUTLIER, FitFinding
from calib.fit.refinement import Refined, refine
from calib.fit.small_troubles import FAMILIES, HELD, UNITS, Lags, PositionField, Setting, troubles
from calib.fit.sweep_readings import FEWEST, SweepReadings
from calib.fit.unmodelled_effects import (
    UnmodelledEffect,
    effect_finding,
    encoder_findings,
    outlier_findings,
    scatter_findings,
    size_of,
    strongest_effect,
)
from calib.records.records import Discrepancy
from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask
from gcomp.identify.global_fit import GlobalFit
from gcomp.identify.parameters import Prior, parameter_names
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict, predict_and_jacobian

POSES, APART = 80, 0.5
"""Random poses, and the distance between the two of each pair that tells the length [rad]."""
LIKE = (0.02, 0.995)
"""Range of the correlation over APART from which a length follows: 0.18 to 5 rad."""


def remaining_doubt(setting: Setting, rows: SweepReadings, refined: Refined) -> tuple[Discrepancy, ...]:
    """The discrepancy of every joint: what its calibrated torque and the gravity model still disagree by.

    The second moment, over random poses of the joints' range, of all small troubles as the readings leave them:
    their estimates, which gain, offset and mass moments cannot express, and their uncertainty, in so far as it is not
    in that of the parameters (docs/theory.md, 4.6).
    """
    arm, n = setting.arm, setting.arm.n
    random = np.random.default_rng(7)
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    poses = random.uniform(low, high, (POSES, n))
    away = random.normal(size=(POSES, n))
    near = poses + APART * away / np.linalg.norm(away, axis=1, keepdims=True)
    level, level_near, together = _moments(setting, rows, refined, poses, near)
    gain = np.abs(refined.fit.complete.gain)
    lag = HELD * refined.linear.levels.level[FAMILIES.index("direction")] * UNITS["direction"][0] * setting.rated
    told = max(float(np.maximum(refined.linear.levels.freedom, 0.0).sum()) / n, 1.0)
    found = []
    for joint in range(n):
        size = float(np.sqrt(level[joint] + lag[joint] ** 2) / gain[joint])
        alike = together[joint] / max(float(np.sqrt(level[joint] * level_near[joint])), 1e-300)
        length = APART / np.sqrt(-2 * np.log(np.clip(alike, *LIKE)))
        found.append(Discrepancy(level=size, level_std=size / np.sqrt(2 * told), length=float(length)))
    return tuple(found)


def _moments(
    setting: Setting, rows: SweepReadings, refined: Refined, poses: Array, near: Array
) -> tuple[Array, Array, Array]:
    """Mean squares (n,) of the discrepancy at poses and at their neighbours, and mean products (n,) [N²·m²]."""
    linear, n, count = refined.linear, setting.arm.n, len(poses)
    complete = refined.fit.complete
    readings = StaticReadings.of(np.vstack([poses, near]), np.zeros((2 * count, n)), 1.0)
    here = replace(
        rows,
        readings=readings,
        swept=np.full(2 * count, -1),
        time=np.full(2 * count, setting.span[1]),
        felt=np.full((2 * count, n), np.nan),
    )
    setting = replace(setting, lags=Lags.unknown(2 * count, n))
    effects = troubles(setting, here, complete, refined.linear.troubles.kept)
    columns = effects.columns * refined.linear.levels.level[effects.family]
    free = np.isin(parameter_names(setting.arm), refined.fit.names)
    slopes = predict_and_jacobian(setting.arm, complete, readings)[1][:, free]
    covariance = np.nan_to_num(refined.fit.covariance)
    value = linear.effects.T @ linear.residual
    spread = np.eye(len(value)) - linear.effects.T @ linear.annihilator @ linear.effects
    across = -covariance @ linear.design.T @ linear.precision @ linear.effects
    known = columns @ value
    doubt = columns @ spread + 2 * slopes @ across
    level = (known**2 + np.maximum(np.einsum("pm,pm->p", doubt, columns), 0.0)).reshape(2, count, n)
    first, second = columns[: count * n], columns[count * n :]
    product = known[: count * n] * known[count * n :] + np.einsum("pm,pm->p", first @ spread, second)
    plain = (known**2 + np.einsum("pm,pm->p", columns @ spread, columns)).reshape(2, count, n).mean(axis=1)
    share = level[0].mean(axis=0) / np.maximum(plain[0], 1e-300)
    together = product.reshape(count, n).mean(axis=0) * share
    return level[0].mean(axis=0), plain[1] * share, together


MOST_EFFECTS = 6
"""Largest number of effects added one after the other; a choice."""
MOST_OUTLIERS = 0.15
"""Largest share of a joint's readings that are left out as outliers; beyond it the model is at fault; a choice."""
PLATEAU, PLATEAU_POSES = 4.0, 4
"""Standard deviations within which readings count as equal; different poses at an extreme from which it is a limit."""
SWING, BULK = 800.0, (10.0, 90.0)
"""Range of a joint's torque, in standard deviations, below which a sinusoid's peak is as flat as a limit; taken between
these percentiles, so that a knock does not widen it. Chosen on the saturated sensors of test_examination.py."""
BLURRED = 3.0
"""Factor to the median standard deviation beyond which a reading, as of a swinging arm, cannot show a limit."""


@dataclass(frozen=True, eq=False)
class LeftOutSweep:
    """Cross-validation of one sweep: its readings against a fit of all others."""

    sweep: str
    joint: int
    """The swept joint."""
    rms: float
    """Of its readings minus their prediction [N·m]."""
    ratio: float
    """Size over its expected value."""


@dataclass(frozen=True, eq=False)
class Goodness:
    """The final fit, and whether the sensor model holds."""

    refined: Refined
    findings: tuple[FitFinding, ...]
    left_out: tuple[LeftOutSweep, ...]
    discrepancy: tuple[Discrepancy, ...]
    """Remaining doubt at a new pose, joint by joint."""


def examine(
    kinematics: Arm, rows: SweepReadings, fit: GlobalFit, priors: Mapping[str, Prior], rated: Array
) -> Goodness:
    """Refine a global fit: add the effects that its residuals show, one by one, and leave outliers out.

    rated (n,) [N·m] scales what is material.
    """
    rows, findings = _without_plateaus(kinematics.names, rows)
    encoders = encoder_findings(kinematics.names, rows)
    counted, poses = rows.readings.counted, rows.readings.position
    fields = tuple(PositionField.over(poses[counted[:, joint]], 1.0) for joint in range(kinematics.n))
    lags = Lags.of(kinematics, rows, fit.complete, rated)
    setting = Setting(kinematics, rated, fields, (float(rows.time.min()), float(rows.time.max())), lags)
    effects, sound = list[UnmodelledEffect](), rows.readings.sigma
    outliers = np.zeros(sound.shape, dtype=bool)

    def fitted() -> Refined:
        extras = [column for effect in effects for column in effect.columns]
        kept = replace(rows.readings, torque=np.where(outliers, np.nan, rows.readings.torque))
        return refine(replace(rows, readings=kept), setting, fit, priors, extras)

    refined = fitted()
    for _ in range(MOST_EFFECTS):
        strange = _outliers(kinematics, refined, rows, [column for effect in effects for column in effect.columns])
        if (strange != outliers).any():
            outliers = strange
            refined = fitted()
        found = strongest_effect(kinematics, rows, ~outliers, refined, rated)
        if found is None:
            break
        effects.append(found)
        refined = fitted()
        if found.doubt is not None:
            rows = replace(rows, readings=replace(rows.readings, sigma=_doubted(sound, effects, refined)))
            refined = fitted()
    for effect, coefficient in _sized(effects, refined):
        findings.append(effect_finding(kinematics.names, effect, coefficient, refined, rated))
    findings += outlier_findings(kinematics.names, rows, outliers)
    findings += scatter_findings(kinematics.names, refined, rated, {finding.joint for finding in findings})
    final = encoders or findings  # a wrong position causes the others
    doubt = remaining_doubt(setting, rows, refined)
    return Goodness(refined, tuple(final), leave_out(refined, rows), doubt)


def _sized(effects: list[UnmodelledEffect], refined: Refined) -> Iterator[tuple[UnmodelledEffect, Array]]:
    place = 0
    for effect in effects:
        yield effect, refined.coefficients[place : place + len(effect.columns)]
        place += len(effect.columns)


def _doubted(sigma: Array, effects: list[UnmodelledEffect], refined: Refined) -> Array:
    """Standard deviations (K, n) [N·m] that include the uncertainty of the effects at each reading."""
    square = sigma**2
    for effect, coefficient in _sized(effects, refined):
        if effect.doubt is not None:
            square[:, effect.joint] += (effect.doubt * size_of(coefficient)) ** 2
    return np.sqrt(square)


def _without_plateaus(names: tuple[str, ...], rows: SweepReadings) -> tuple[SweepReadings, list[FitFinding]]:
    """(Rows without readings at a sensor's limit, findings of sensors that saturate)."""
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
                text = f"{name}: {len(near)} readings at different poses are at {limit:.4g} N·m: the sensor saturates"
                found.append(FitFinding(name, "saturation", limit, "N·m", text))
    readings = replace(rows.readings, torque=np.where(flat, np.nan, torque))
    return (replace(rows, readings=readings) if found else rows), found


def _sharp(rows: SweepReadings, joint: int) -> npt.NDArray[np.intp]:
    """Rows in which a joint's reading counts and is precise enough to show a limit."""
    counted = np.flatnonzero(rows.readings.counted[:, joint])
    sigma = rows.readings.sigma[counted, joint]
    return counted[sigma <= BLURRED * np.median(sigma)] if len(counted) else counted


def leave_out(refined: Refined, rows: SweepReadings) -> tuple[LeftOutSweep, ...]:
    """Cross-validation of each sweep, by the block form of the leave-one-out residual (docs/theory.md, section 5.4)."""
    linear, found = refined.linear, []
    series = rows.readings.series[linear.row]
    own = rows.swept[linear.row] == linear.joint
    for sweep, name in enumerate(rows.sweeps):
        here = np.flatnonzero((series == sweep) & own)
        if not len(here):
            continue
        rest = linear.annihilator[np.ix_(here, here)]
        size, turn = np.linalg.eigh(rest)
        kept = size > 1e-8
        residual = linear.residual[here]
        outside = turn[:, kept] @ ((turn[:, kept].T @ residual) / size[kept])
        expected = float(residual @ outside) / max(int(kept.sum()), 1)
        rms = float(np.sqrt(np.mean((outside * linear.sigma[here]) ** 2)))
        found.append(LeftOutSweep(name, int(linear.joint[here[0]]), rms, float(np.sqrt(max(expected, 0.0)))))
    return tuple(found)


def _outliers(kinematics: Arm, refined: Refined, rows: SweepReadings, extras: list[Array]) -> Mask:
    """Outliers (K, n) by deleted residuals, in robust standard deviations of their joint.

    Readings left out before are judged again, since an effect added meanwhile may explain them.
    """
    linear, counted = refined.linear, rows.readings.counted
    error = rows.readings.torque - predict(kinematics, refined.fit.complete, rows.readings)
    error -= sum((value * column for value, column in zip(refined.coefficients, extras, strict=True)), 0.0 * error)
    deleted = error / (rows.readings.sigma * refined.factor)
    inside = np.zeros(counted.shape, dtype=bool)
    inside[linear.row, linear.joint] = True
    deleted[linear.row, linear.joint] = linear.residual / np.sqrt(np.maximum(1 - linear.leverage, 1e-3))
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
