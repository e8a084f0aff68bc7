"""Effects of the catalogue that the sensor model does not have: which of them the residuals of a fit show, in words."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import fdtrc

from calib.fit.calibration import FitFinding
from calib.fit.refinement import Refined
from calib.fit.small_troubles import play
from calib.fit.sweep_readings import FEWEST, SweepReadings
from calib.motion.encoder_check import stuck_bits
from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict, predict_and_jacobian

CHANCE = 1e-7
"""Probability of the F ratio by chance below which an effect is accepted; some fifty are tried on each fit
(docs/theory.md, section 5.4)."""
MATERIAL = 0.0005
"""RMS of an effect, as a share of rated torque, below which it is not material (docs/theory.md, section 5.4)."""
KNEE_SHARES = (0.6, 0.7, 0.8, 0.9, 0.95)
"""Shares of the largest torque tried as the onset of saturation."""
LEAST_ECCENTRIC_RANGE = 2.0
"""Range of a joint from which an error once a turn can be separated from a gain [rad] (docs/theory.md, section 5.2)."""
OWN_DOUBT, HELD_DOUBT = 0.1, 0.75
"""Standard deviation of a sensor's lag, as a share of its size: along the joint's own sweep; while it holds, with the
lag anywhere between both ends (0.58 if uniform). Held by the hysteresis case of tests/campaigns/hard_cases.py."""
PATH = 12
"""Points between two readings at which the torque is computed for hysteresis: 0.1 rad apart over 1.2 rad."""


@dataclass(frozen=True, eq=False)
class UnmodelledEffect:
    """An effect found: its columns, in the effect's own units."""

    joint: int
    id: str
    """In `armlink.effect_catalogue`."""
    columns: tuple[Array, ...]
    """Change of the torque readings per unit of each of its parameters (K, n)."""
    knee: float = np.nan
    """Torque at which a sensor begins to saturate [N·m]."""
    doubt: Array | None = None
    """Standard deviation that the columns leave at each reading of the joint (K,), as a share of the effect's size."""
    each_sweep: bool = False
    """Whether a hysteresis has its own size in each sweep (side of approach) instead of one width."""


def size_of(coefficients: Array) -> float:
    """Root mean square of an effect's coefficients (m,), in their unit."""
    return float(np.sqrt(np.mean(coefficients**2)))


def strongest_effect(
    kinematics: Arm, rows: SweepReadings, kept: Mask, refined: Refined, rated: Array
) -> UnmodelledEffect | None:
    """The effect that explains most of the residuals of `refined` beyond chance; None if none is material.

    rated (n,) [N·m]; kept (K, n) are the readings that `refined` used, without outliers.
    """
    counted = rows.readings.counted & kept
    linear, best, most = refined.linear, None, 0.0
    total = float(linear.residual @ np.linalg.solve(linear.precision, linear.residual))  # rᵀr of the whitened residual
    freedom = float(np.trace(np.linalg.solve(linear.precision, linear.annihilator)))
    for effect in _candidates(kinematics, rows, refined):
        columns = np.column_stack([column[counted] for column in effect.columns]) / linear.sigma[:, None]
        if not np.abs(columns).max(initial=0.0) > 0:
            continue
        told = columns.T @ linear.annihilator @ columns
        if np.any(np.diag(told) < 1e-6 * (columns**2).sum(axis=0)):
            continue  # the parameters can do nearly the same
        along = columns.T @ linear.residual
        coefficient = np.linalg.lstsq(told, along, rcond=1e-10)[0]
        gain, m = float(along @ coefficient), len(effect.columns)
        free = freedom - m
        if free < 4:
            continue
        left = max(total - gain, 1e-6 * total + 1e-9)
        ratio = (gain / m) / (left / free)
        p_value = float(fdtrc(m, free, ratio))
        own = linear.joint == effect.joint
        shape = (columns * linear.sigma[:, None] @ coefficient)[own]
        size = float(np.std(shape)) if len(shape) else 0.0
        if p_value < CHANCE and size > MATERIAL * rated[effect.joint] and gain > most:
            best, most = effect, gain
    return best


def _candidates(kinematics: Arm, rows: SweepReadings, refined: Refined) -> Iterator[UnmodelledEffect]:
    """Every effect that is tried, a joint at a time."""
    complete, readings = refined.fit.complete, rows.readings
    counted = readings.counted
    _, _, flat = predict_and_jacobian(kinematics, complete, readings)
    slope = np.zeros((*counted.shape, kinematics.n))
    slope[counted] = flat
    torque = predict(kinematics, complete, readings) - complete.offset
    for joint in range(kinematics.n):
        here = counted[:, joint]
        if here.sum() < FEWEST:
            continue
        angle, own, one = readings.position[:, joint], torque[:, joint], partial(_one, kinematics.n, joint)
        yield one("transmission.spring", here * angle)
        doubt = _lag_doubt(rows, joint)
        sides = [here * side for side in _sides(rows, joint)]
        if sides:
            columns = tuple(one("torque.hysteresis", side).columns[0] for side in sides)
            yield UnmodelledEffect(joint, "torque.hysteresis", columns, doubt=doubt, each_sweep=True)
        yield replace(one("torque.hysteresis", here * lag(kinematics, rows, refined, joint)), doubt=doubt)
        largest = float(np.abs(own[here]).max())
        yield one("torque.nonlinearity", here * own * np.abs(own) / max(largest, 1e-9))
        for share in KNEE_SHARES:
            bent = np.where(here, np.sign(own) * np.maximum(np.abs(own) - share * largest, 0.0), 0.0)
            if np.count_nonzero(bent) >= FEWEST // 2:
                yield one("torque.saturation", bent, share * largest / max(abs(complete.gain[joint]), 1e-9))
        yield one("torque.drift", here * (rows.time - rows.time.mean()))
        if float(np.ptp(angle[here])) > LEAST_ECCENTRIC_RANGE:
            turn = (slope[..., joint] * np.sin(angle)[:, None], slope[..., joint] * np.cos(angle)[:, None])
            yield UnmodelledEffect(joint, "position.eccentricity", turn)


def _one(n: int, joint: int, effect_id: str, values: Array, knee: float = np.nan) -> UnmodelledEffect:
    """An effect that shows in one joint's sensor alone, `values` (K,)."""
    column = np.zeros((len(values), n))
    column[:, joint] = values
    return UnmodelledEffect(joint, effect_id, (column,), knee)


def _sides(rows: SweepReadings, joint: int) -> Iterator[Array]:
    """Side of approach (K,) in each sweep of a joint that has both sides, 0 in other readings.

    A sensor's lag depends on the swing of torque on the way, braking included, so that each sweep has its own.
    """
    series, swept = rows.readings.series, rows.swept == joint
    for sweep in dict.fromkeys(series[swept].tolist()):
        side = np.where((series == sweep) & swept, rows.readings.direction[:, joint], 0.0)
        if {-1.0, 1.0} <= set(side.tolist()):
            yield side


def _lag_doubt(rows: SweepReadings, joint: int) -> Array:
    """Standard deviation of a lag (K,), as a share of its size.

    Along the joint's own sweep the lag hardly varies. While the joint holds, it may be anywhere between both ends and
    stays there as another joint is swept, so that those readings together count as one.
    """
    together = np.bincount(rows.readings.series)[rows.readings.series]
    held: Array = HELD_DOUBT * np.sqrt(np.where(rows.swept < 0, 1, together))
    return np.where(rows.swept == joint, OWN_DOUBT, held)


def lag(kinematics: Arm, rows: SweepReadings, refined: Refined, joint: int) -> Array:
    """Position of a joint's torque sensor in its play (K,), -1 to 1, at each reading, on straight ways between them.

    The width of the play comes from the residuals (1.5 times their median size), so that smaller changes of torque
    leave the sensor in place.
    """
    position, load = rows.readings.position, rows.readings.load
    shares = np.linspace(0, 1, PATH + 1)[1:]
    way = position[:-1, None] + shares[:, None] * (position[1:] - position[:-1])[:, None]
    way = np.concatenate([np.repeat(position[:1, None], PATH, axis=1), way])
    flat = StaticReadings.of(
        way.reshape(-1, kinematics.n), np.zeros((len(position) * PATH, kinematics.n)), 1.0, np.repeat(load, PATH)
    )
    torque = predict(kinematics, refined.fit.complete, flat)[:, joint]
    residual = refined.fit.residual[:, joint]
    width = max(float(np.nanmedian(np.abs(residual))) * 1.5, 1e-9)
    return -play(torque.reshape(-1, 1), np.array([width]))[PATH - 1 :: PATH, 0]


SCATTER, MATERIAL_SCATTER = 3.0, 0.002
"""Scatter that counts as a finding: this factor to the samples' noise, and this share of rated torque. Held by
tests/campaigns/random_arms.py (none) and hard_cases.py (named)."""


def effect_finding(
    names: tuple[str, ...], effect: UnmodelledEffect, coefficient: Array, refined: Refined, rated: Array
) -> FitFinding:
    name, gain = names[effect.joint], float(refined.fit.complete.gain[effect.joint]) or 1.0
    value = float(coefficient[0])
    if effect.id == "transmission.spring":
        text = (
            f"{name}: part of the torque is linear in position, {value / gain:+.3g} N·m/rad, and gravity "
            "does not explain it: does a cable or a spring cross the joint? The fit removes this part, "
            "but its value at 0 rad counts as offset"
        )
        return FitFinding(name, "spring", value / gain, "N·m/rad", text)
    if effect.each_sweep:
        size = size_of(coefficient)
        text = f"{name}: readings differ by {2 * size:.3g} N·m between the directions of approach; the fit removes this"
        return FitFinding(name, "direction", size, "N·m", text)
    if effect.id == "torque.hysteresis":
        text = (
            f"{name}: the torque sensor lags by {abs(value):.3g} N·m behind changes of torque (hysteresis); "
            "the fit removes this lag"
        )
        return FitFinding(name, "hysteresis", abs(value), "N·m", text)
    if effect.id == "torque.saturation":
        text = f"{name}: the torque sensor flattens beyond {effect.knee:.3g} N·m: does it saturate?"
        return FitFinding(name, "saturation", effect.knee, "N·m", text)
    if effect.id == "torque.drift":
        text = f"{name}: the torque reading drifts by {value * 3600:+.3g} N·m an hour: warm up, then sweep again"
        return FitFinding(name, "drift", value * 3600, "N·m/h", text)
    if effect.id == "position.eccentricity":
        size = float(np.hypot(*coefficient))
        text = f"{name}: the position reading is wrong by {size:.3g} rad once a turn: an eccentric encoder disc?"
        return FitFinding(name, "eccentricity", size, "rad", text)
    text = f"{name}: the torque sensor's gain changes with the load (by {2 * value / gain:+.2%} at the largest load)"
    return FitFinding(name, "nonlinear", value / gain, "1", text)


def encoder_findings(names: tuple[str, ...], rows: SweepReadings) -> list[FitFinding]:
    found = []
    for joint, bit, step in stuck_bits(rows.readings.position, rows.resolution, rows.target):
        text = (
            f"{names[joint]}: bit {bit} of the position reading ({step:.3g} rad) never changes: the encoder or its"
            " transmission is faulty; no result that uses this joint's position is valid"
        )
        found.append(FitFinding(names[joint], "encoder", step, "rad", text))
    return found


def outlier_findings(names: tuple[str, ...], rows: SweepReadings, outliers: Mask) -> list[FitFinding]:
    """Findings of outliers, by joint, with a likely cause."""
    found = []
    for joint in np.flatnonzero(outliers.any(axis=0)):
        at = np.flatnonzero(outliers[:, joint])
        series, angle = rows.readings.series[at], rows.readings.position[at, joint]
        places = ", ".join(f"{rows.sweeps[series[k]]} at {angle[k]:.3f} rad" for k in range(min(len(at), 4)))
        more = f" and {len(at) - 4} more" if len(at) > 4 else ""
        run = len(at) >= 2 and len(set(series.tolist())) == 1
        cause = (
            "did the joint touch something there, or did a joint at rest slip"
            if run
            else "was there a knock or a bad contact"
        )
        text = f"{names[joint]}: {len(at)} readings left out, {places}{more}: {cause}?"
        found.append(FitFinding(names[joint], "outliers", float(len(at)), "readings", text))
    return found


def scatter_findings(names: tuple[str, ...], refined: Refined, rated: Array, named: set[str]) -> list[FitFinding]:
    """Findings of joints whose readings scatter far more than their samples' noise, without a known cause."""
    linear, found = refined.linear, []
    rest = linear.residual * linear.sigma
    for joint, name in enumerate(names):
        here = linear.joint == joint
        if name in named or not here.any():
            continue
        rms = float(np.sqrt(np.mean(rest[here] ** 2)))
        if refined.factor[joint] > SCATTER and rms > MATERIAL_SCATTER * rated[joint]:
            text = (
                f"{name}: readings scatter by {rms:.3g} N·m, which is {refined.factor[joint]:.0f} times what their "
                "noise explains, and no known effect explains the rest: the model does not hold for this joint"
            )
            found.append(FitFinding(name, "scatter", rms, "N·m", text))
    return found
