"""Calibration in the field, without a mass: gains and offsets from slow motion and the identified gravity parameters.

v_i = K_i τ_i(q; β) + O_i + s_i f_i, with s_i the side of approach and f_i hysteresis or friction that the sensor sees;
β ~ N(β̂, Cov β̂) from the gravity record and position offsets with their standard deviations, all joints in one problem
(docs/theory.md, section 4.3). The intervals include the gravity record's own error, which does not average out.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from armlink.arm_file import ArmFile
from armlink.errors import BadInput, Refused
from calib.field.linear_model import UNKNOWN_MOMENT, Belief, Solution, belief_of, field_columns, solve
from calib.fit.heldout import FEWEST
from calib.records.records import CalibrationRecord, GravityRecord, Parameter
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, Mask
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.readings import StaticReadings

GAIN_STD = 0.02
"""Relative standard deviation above which a gain counts as not separable from the offset."""
OFFSET_STD = 0.005
"""Likewise of an offset, as a share of rated torque."""
DRIFT = 0.05
"""Standard deviation allowed for the drift of a gain that these rows do not show, as a ratio."""
GAUSS_NEWTON_STEPS = 4
"""Each takes the noise scaled to the residuals' scatter."""
PAYLOAD_EVIDENCE = 10.0
"""BIC difference up to which a payload that explains the rows worse than new gains and offsets is not excluded."""
BLOCK = 24
"""Rows that are held out together, since neighbours are correlated: six seconds of a recording."""


@dataclass(frozen=True, eq=False)
class FieldFit:
    """Present gains and offsets of the sensors (n,); NaN with a reason if these rows do not separate them."""

    names: tuple[str, ...]
    gain: Array
    offset: Array
    """[N·m]"""
    covariance: Array
    """Of (gain, offset) of each joint (n, 2, 2); NaN without a value."""
    hysteresis: Array
    """Half the difference between both directions (n,) [N·m]; NaN if only one was seen."""
    reasons: dict[tuple[str, Parameter], str]
    common_scale_std: float
    """Standard deviation of a factor common to all gains; it comes from the gravity record alone."""
    residual: Array
    """Readings minus fit (K, n) [N·m]; NaN for readings that do not count."""
    torque: Array
    """Model torque (K, n) [N·m]."""
    rows: Array
    """Number of rows that count (n,)."""

    def std(self, parameter: Parameter) -> Array:
        """Standard deviations of "gain" or "offset" (n,); NaN without a value."""
        place = 0 if parameter == "gain" else 1
        std: Array = np.sqrt(self.covariance[:, place, place])
        return std

    def ci95(self, parameter: Parameter) -> Array:
        """95 % intervals (n, 2)."""
        value, half = getattr(self, parameter), 1.96 * self.std(parameter)
        return np.stack([value - half, value + half], axis=1)


def fit_field(
    arm: ArmFile, rows: StaticReadings, gravity: GravityRecord, calibration: CalibrationRecord | None
) -> FieldFit:
    """Gains and offsets from slow rows; `calibration` has the position sensors and the torque calibration in use.

    Raises Refused if a payload explains the rows as well, or the records are of another arm; BadInput.
    """
    belief = belief_of(arm, gravity, calibration)
    n, q = belief.arm.n, rows.position * belief.position_gain + belief.position_offset
    if not np.isfinite(rows.torque).any():
        raise BadInput("no torque reading can be used")
    belief = belief.over(rows, q)
    gain, sigma = belief.installed.gain, rows.sigma
    noise, prior = sigma, belief.prior(np.ones(n))
    for _ in range(GAUSS_NEWTON_STEPS):
        columns = field_columns(belief, rows, q, gain)
        solved = solve(columns, rows.torque, noise, prior)
        residual: Array = rows.torque - columns @ solved.value
        factor = _scatter(residual / sigma) * _correlation(residual, rows.series)
        gain, noise = solved.value[:n], sigma * np.maximum(factor, 1.0)
    unseen = np.sqrt(np.diag(solved.covariance)[:n]) > GAIN_STD * np.abs(gain)
    if unseen.any():
        columns = field_columns(belief, rows, q, np.where(unseen, belief.installed.gain, gain))
        solved = solve(columns, rows.torque, noise, belief.prior(np.where(unseen, DRIFT, 1.0)))
    if calibration is not None:
        _refuse_payload(belief, rows, q, noise, solved.chi2)
    return _report(belief, rows, columns, solved, unseen)


def _scatter(score: Array) -> Array:
    """RMS of residuals over their standard deviation (n,)."""
    counted = np.isfinite(score)
    total = np.where(counted, score**2, 0.0).sum(axis=0)
    scatter: Array = np.sqrt(total / np.maximum(counted.sum(axis=0) - 3, 1))
    return scatter


def _correlation(residual: Array, series: npt.NDArray[np.int64]) -> Array:
    """Factor (n,) on the standard deviation of a row for correlated neighbours: √(1 + 2 Σ ρ_k)."""
    factor = np.ones(residual.shape[1])
    for joint in range(residual.shape[1]):
        parts = [residual[series == each, joint] for each in np.unique(series)]
        parts = [part[np.isfinite(part)] for part in parts]
        power = sum(float(part @ part) for part in parts)
        total = 1.0
        for lag in range(1, max((len(part) for part in parts), default=0) // 4):
            rho = sum(float(part[lag:] @ part[:-lag]) for part in parts if len(part) > lag) / max(power, 1e-300)
            if rho < 0.05:
                break
            total += 2 * rho
        factor[joint] = np.sqrt(total)
    return factor


def _refuse_payload(belief: Belief, rows: StaticReadings, q: Array, noise: Array, chi2: float) -> None:
    """Raise Refused if the installed calibration does not fit, but fits as well as a new one with a payload added."""
    n = belief.arm.n
    base = field_columns(belief, rows, q, belief.installed.gain)
    held = belief.prior_installed()
    fixed, by_point = payload_columns(belief.arm)
    load = gravity_regressor(belief.arm, q) @ np.column_stack([fixed, by_point]) * belief.installed.gain[:, None]
    with_load = solve(
        np.concatenate([base, load], axis=2),
        rows.torque,
        noise,
        (np.concatenate([held[0], np.zeros(4)]), np.concatenate([held[1], np.full(4, UNKNOWN_MOMENT)])),
    )
    log_rows = np.log(np.isfinite(rows.torque).sum())
    as_load, mass = with_load.chi2 + 4 * log_rows, float(with_load.value[-4])
    as_installed = solve(base, rows.torque, noise, held).chi2
    if as_installed > as_load + PAYLOAD_EVIDENCE and mass > 0 and as_load < chi2 + 2 * n * log_rows + PAYLOAD_EVIDENCE:
        raise Refused(
            f"a payload of {mass:.2f} kg explains these readings as well as other gains do: if there is a "
            "payload, take it off and record again; if there is none, sweep with a reference mass"
        )


def _report(belief: Belief, rows: StaticReadings, columns: Array, solved: Solution, unseen: Mask) -> FieldFit:
    n, names = belief.arm.n, belief.arm.names
    counted = np.isfinite(rows.torque)
    model = columns[:, np.arange(n), np.arange(n)]
    gain, offset, hysteresis = (solved.value[k * n : (k + 1) * n].copy() for k in range(3))
    pairs = np.array([solved.covariance[np.ix_([j, n + j], [j, n + j])] for j in range(n)])
    reasons: dict[tuple[str, Parameter], str] = {}
    for j, name in enumerate(names):
        here = model[counted[:, j], j]
        sides = set(np.sign(rows.direction[counted[:, j], j])) - {0.0}
        if len(here) == 0:
            reasons[name, "gain"] = reasons[name, "offset"] = "its sensor has no usable reading in these rows"
        elif unseen[j]:
            reasons[name, "gain"] = _no_gain(here)
        if len(here) and len(sides) < 2:
            hysteresis[j] = np.nan
            reasons[name, "offset"] = (
                "the joint was approached from one side only, so its offset looks like friction or "
                "hysteresis: move it in both directions"
            )
        elif len(here) and np.sqrt(pairs[j, 1, 1]) > OFFSET_STD * belief.rated[j]:
            reasons[name, "offset"] = (
                f"it cannot be separated from the gain: it is known only to ± {2 * np.sqrt(pairs[j, 1, 1]):.2g} N·m, "
                f"since the torque stays between {here.min():.2f} and {here.max():.2f} N·m"
            )
    for place, (parameter, value) in enumerate((("gain", gain), ("offset", offset))):
        for j, name in enumerate(names):
            if (name, parameter) in reasons:
                value[j] = pairs[j, place, :] = pairs[j, :, place] = np.nan
    known = np.flatnonzero(np.isfinite(gain))
    of_gains = solved.covariance[np.ix_(known, known)] / np.outer(gain[known], gain[known])
    common = float(np.sqrt(of_gains.mean())) if len(known) else np.nan
    residual = rows.torque - columns @ solved.value
    return FieldFit(
        names,
        gain,
        offset,
        pairs,
        hysteresis,
        reasons,
        common,
        residual,
        np.where(counted, model, np.nan),
        counted.sum(axis=0),
    )


def _no_gain(torque: Array) -> str:
    spread = float(np.std(torque))
    if np.abs(torque).max() < 1e-3:
        return "gravity does not load this joint, since its axis is vertical in all these poses"
    return (
        f"it cannot be separated from the offset, since gravity torque varies only by {spread:.2g} N·m "
        "(standard deviation) in these poses: move this joint, or the joints beyond it, further"
    )


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
