"""Calibration in the field, without a mass: gains and offsets from slow motion and the identified gravity parameters.

v_i = K_i τ_i(q; β) + O_i + s_i f_i, with s_i the side of approach and f_i hysteresis or friction that the sensor sees;
β ~ N(β̂, Cov β̂) from the gravity record and position offsets with their standard deviations, all joints in one problem
(docs/theory.md, section 4.3). The intervals include the gravity record's own error, which does not average out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput, Refused
from armlink.torque_calibration import UNCALIBRATED, TorqueCalibration, per_joint
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.fit.calibration import (
    LOOSEST_GAIN,
    NOISE_ROUNDS,
    VERY_STRONG_EVIDENCE,
    FittedCalibration,
    common_scale_std,
    rms,
)
from calib.fit.creep_fit import SEEN
from calib.fit.creep_residuals import inflation
from calib.fit.gravity_fit import held_out
from calib.fit.recorded_rows import directions
from calib.fit.small_troubles import PositionField
from calib.fit.sweep_readings import FEWEST
from calib.records.records import CalibrationRecord, GravityRecord, HeldOut, Parameter
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array, Mask
from gcomp.estimate.posterior import PosteriorFit, linear_posterior
from gcomp.gravity.torque import gravity_regressor
from gcomp.identify.parameters import Parameters, family_slices
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import joint_positions, predict, predict_and_jacobian

HYSTERESIS = 0.01
"""Prior standard deviation of f_i, as a share of rated torque (docs/theory.md, section 4.3)."""
UNKNOWN_MOMENT = 10.0
"""Prior standard deviation of a mass moment that is not identifiable in the gravity record [kg·m]."""
OFFSET_STD = 0.005
"""Likewise of an offset, as a share of rated torque."""
DRIFT = 0.05
"""Standard deviation allowed for the drift of a gain that these rows do not show, as a ratio."""
LEAST_CORRELATION = 0.05
"""Of neighbouring rows' residuals, up to which they are summed (docs/theory.md, section 4.3)."""
BLOCK = 24
"""Rows that are held out together, since neighbours are correlated: six seconds of a recording."""


class FieldProblem:
    """Rows as a linear function of gains, offsets, hysteresis, and what the records leave open, in standard deviations:
    mass moments, position offsets, discrepancy."""

    def __init__(
        self, arm_file: ArmFile, rows: StaticReadings, gravity: GravityRecord, calibration: CalibrationRecord | None
    ) -> None:
        """Raises Refused if a record is of another arm, BadInput if no reading counts."""
        self.arm, self.rated, self.rows = gcomp_arm(arm_file), arm_file.require_link().rated_torques, rows
        n, blank = self.arm.n, per_joint([UNCALIBRATED] * self.arm.n)
        if not rows.counted.any():
            raise BadInput("no torque reading can be used")
        gravity = gravity.carrying(arm_file)
        values, vectors = np.linalg.eigh(np.array(gravity.covariance))
        unknown = UNKNOWN_MOMENT * np.eye(2 * n)[:, ~np.array(gravity.identifiable)]
        self._root = np.hstack([vectors * np.sqrt(np.maximum(values, 0.0)), unknown])
        self.sensors = Parameters.nominal(n, beta=np.array(gravity.beta))
        self.installed: TorqueCalibration[Array] = blank
        zero_std = np.full(n, sweep_section(arm_file).position_offset_std)
        held_std = (np.zeros(n), np.zeros(n))
        if calibration is not None:
            self.installed = calibration.require(arm_file).torque_calibration(blank)
            self.sensors = replace(
                self.sensors,
                position_gain=calibration.values("position_gain", 1.0),
                position_offset=calibration.values("position_offset", 0.0),
            )
            known = calibration.std("position_offset")
            zero_std = np.where(np.isnan(known), zero_std, known)
            held_std = calibration.std("gain"), calibration.std("offset")
        self._zero_std = np.maximum(zero_std, 1e-6)
        self._held_std = (
            np.fmax(held_std[0], 1e-3 * np.abs(self.installed.gain)),
            np.fmax(held_std[1], 1e-3 * self.rated),
        )
        self.joint = np.nonzero(rows.counted)[1]
        self._side = (np.arange(n) == self.joint[:, None]) * rows.direction[rows.counted][:, None]
        self._local = self._discrepancy(calibration)

    def _discrepancy(self, calibration: CalibrationRecord | None) -> Array:
        """Columns (P, F) of the disagreement of calibrated torque with the gravity model, of unit variance."""
        q, counted = joint_positions(self.sensors, self.rows), self.rows.counted
        parts = [np.zeros((len(self.joint), 0))]
        for joint, each in enumerate([] if calibration is None else calibration.joints):
            told = each.discrepancy
            if told is None or told.level == 0 or not counted[:, joint].any():
                continue
            poses = q[counted[:, joint]]
            columns = told.level * PositionField.over(poses, told.length).columns(poses)
            whole = np.zeros((len(self.joint), columns.shape[1]))
            whole[self.joint == joint] = columns
            parts.append(whole)
        return np.hstack(parts)

    def columns(self, gain: Array) -> Array:
        """Change of each counted reading per parameter (P, p), at given gains (n,)."""
        _, jacobian, _ = predict_and_jacobian(self.arm, replace(self.sensors, gain=gain), self.rows)
        at = family_slices(self.arm.n)
        own = jacobian[:, at["gain"]], jacobian[:, at["offset"]], self._side
        moments, zeros = jacobian[:, at["beta"]] @ self._root, jacobian[:, at["position_offset"]] * self._zero_std
        return np.hstack([*own, moments, zeros, gain[self.joint, None] * self._local])

    def load_columns(self) -> Array:
        """Change of each counted reading per unit of a payload's mass and of mass times place (P, 4)."""
        regressor = gravity_regressor(self.arm, joint_positions(self.sensors, self.rows))[self.rows.counted]
        return np.asarray(
            regressor @ np.column_stack(payload_columns(self.arm)) * self.installed.gain[self.joint, None]
        )

    def solve(
        self, columns: Array, noise: Array, gain_share: Array | None = None, more: Sequence[float] = ()
    ) -> PosteriorFit:
        """With gains free within a share of the installed ones, or as installed; `more` are the standard deviations
        of parameters beyond those of the problem."""
        installed = self.installed
        loose = None if gain_share is None else (gain_share * np.abs(installed.gain), 10 * self.rated)
        pair = self._held_std if loose is None else loose
        rest = columns.shape[1] - len(more) - 3 * len(self.rated)
        std = np.concatenate([*pair, HYSTERESIS * self.rated, np.ones(rest), more])
        mean = np.concatenate([installed.gain, installed.offset, np.zeros(len(std) - 2 * len(self.rated))])
        weight = 1 / noise[self.rows.counted]
        target = self.rows.torque[self.rows.counted] * weight
        return linear_posterior(columns * weight[:, None], target, mean, std)

    def residual(self, columns: Array, x: Array) -> Array:
        """Readings minus those of parameters x (K, n) [N·m]; NaN for readings that do not count."""
        return self.rows.table(self.rows.torque[self.rows.counted] - columns @ x)


@dataclass(frozen=True, eq=False)
class FieldFit(FittedCalibration):
    """Present gains and offsets of the sensors; without a value if these rows do not separate them."""

    names: tuple[str, ...]
    solution: PosteriorFit
    hysteresis: Array
    """Half the difference between both directions (n,) [N·m]; NaN if only one was seen."""
    reasons: dict[tuple[str, Parameter], str]
    residual: Array
    """Readings minus fit (K, n) [N·m]; NaN for readings that do not count."""
    torque: Array
    """Model torque (K, n) [N·m]."""
    sources: dict[str, str]

    def estimate(self, parameter: str) -> tuple[Array, Array]:
        n = len(self.names)
        if parameter not in ("gain", "offset"):
            return np.full(n, np.nan), np.full(n, np.nan)
        place = slice(0, n) if parameter == "gain" else slice(n, 2 * n)
        return self.solution.x[place], np.sqrt(np.diag(self.solution.covariance)[place])

    def covariance_of(self, wanted: Sequence[tuple[int, Parameter]]) -> Array:
        places = [joint + len(self.names) * (parameter == "offset") for joint, parameter in wanted]
        return self.solution.covariance[np.ix_(places, places)]

    @property
    def residual_rms(self) -> Array:
        return rms(self.residual)

    @property
    def common_scale_std(self) -> float:
        """Standard deviation of a factor common to all gains; it comes from the gravity record alone."""
        gain = self.value("gain")
        known = np.flatnonzero(np.isfinite(gain))
        own = self.solution.covariance[np.ix_(known, known)]
        return common_scale_std(own, gain[known]) if len(known) else float("nan")

    def record(self, arm_file: ArmFile, before: CalibrationRecord | None = None) -> CalibrationRecord:
        """With what was not found as in `before`, the current one. Raises Refused if no value was identified."""
        if np.isnan([self.value("gain"), self.value("offset")]).all():
            (joint, parameter), why = next(iter(self.reasons.items()))
            raise Refused(f"no gain and no offset is identifiable; {joint} {parameter}: {why}")
        carried = ", ".join(f"{name} {parameter}" for name, parameter in self.reasons)
        note = "field calibration without a mass"
        known = {"note": note} if before is None else {"drives": before.drives, "parent": before.id, "note": note}
        if carried and before is not None:
            known["note"] = f"{note}; carried over from {before.id}: {carried}"
        return super().record(arm_file, before).model_copy(update=known)


def fit_field(
    arm: ArmFile,
    rows: StaticReadings,
    gravity: GravityRecord,
    calibration: CalibrationRecord | None,
    sources: dict[str, str] | None = None,
) -> FieldFit:
    """Gains and offsets from slow rows; `calibration` has the position sensors and the torque calibration in use.

    Raises Refused if a payload explains the rows as well, or the records are of another arm; BadInput.
    """
    problem = FieldProblem(arm, rows, gravity, calibration)
    gain, noise, n = problem.installed.gain, rows.sigma, problem.arm.n
    for _ in range(NOISE_ROUNDS):
        columns = problem.columns(gain)
        solved = problem.solve(columns, noise, np.ones(n))
        residual = problem.residual(columns, solved.x)
        gain, noise = solved.x[:n], rows.sigma * np.maximum(scatter_factor(residual, rows), 1.0)
    unseen = np.sqrt(np.diag(solved.covariance)[:n]) > LOOSEST_GAIN * np.abs(gain)
    if unseen.any():
        columns = problem.columns(np.where(unseen, problem.installed.gain, gain))
        solved = problem.solve(columns, noise, np.where(unseen, DRIFT, 1.0))
    if calibration is not None:
        _refuse_payload(problem, noise, solved.chi2)
    return _report(problem, columns, solved, unseen, sources or {})


def scatter_factor(residual: Array, rows: StaticReadings) -> Array:
    """Factor (n,) on the standard deviation of a row: of the residuals, and for neighbours that are alike."""
    factor = np.ones(residual.shape[1])
    for joint, counted in enumerate(rows.counted.T):
        score = residual[counted, joint] / rows.sigma[counted, joint]
        parts = [residual[counted & (rows.series == each), joint] for each in np.unique(rows.series[counted])]
        factor[joint] = np.sqrt(score @ score / max(len(score) - 3, 1) * inflation(parts, LEAST_CORRELATION))
    return factor


def _refuse_payload(problem: FieldProblem, noise: Array, chi2: float) -> None:
    """Raise Refused if the installed calibration does not fit, but fits as well as a new one with a payload added."""
    base = problem.columns(problem.installed.gain)
    loaded = problem.solve(np.hstack([base, problem.load_columns()]), noise, more=[UNKNOWN_MOMENT] * 4)
    log_rows = np.log(len(problem.joint))
    as_load, mass = loaded.chi2 + 4 * log_rows, float(loaded.x[-4])
    as_new = chi2 + 2 * problem.arm.n * log_rows
    as_installed = problem.solve(base, noise).chi2
    if as_installed > as_load + VERY_STRONG_EVIDENCE and mass > 0 and as_load < as_new + VERY_STRONG_EVIDENCE:
        raise Refused(
            f"two causes would explain these readings equally well: a payload of {mass:.2f} kg, or changed gains. If "
            "there is a payload, take it off and record again; if there is none, sweep with a reference mass"
        )


def _report(
    problem: FieldProblem, columns: Array, solved: PosteriorFit, unseen: Mask, sources: dict[str, str]
) -> FieldFit:
    n, names, rows = problem.arm.n, problem.arm.names, problem.rows
    model = np.where(rows.counted, predict(problem.arm, problem.sensors, rows), np.nan)
    hysteresis, offset_std = solved.x[2 * n : 3 * n].copy(), np.sqrt(np.diag(solved.covariance)[n : 2 * n])
    reasons: dict[tuple[str, Parameter], str] = {}
    for j, name in enumerate(names):
        counted = rows.counted[:, j]
        here, sides = model[counted, j], set(np.sign(rows.direction[counted, j])) - {0.0}
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
        elif len(here) and offset_std[j] > OFFSET_STD * problem.rated[j]:
            reasons[name, "offset"] = (
                f"the offset cannot be separated from the gain and is known only to ± {2 * offset_std[j]:.2g} N·m,"
                f" since torque stays between {here.min():.2f} and {here.max():.2f} N·m"
            )
    return FieldFit(names, solved, hysteresis, reasons, problem.residual(columns, solved.x), model, sources)


def _no_gain(torque: Array) -> str:
    spread = float(np.std(torque))
    if np.abs(torque).max() < 1e-3:
        return "gravity does not load this joint, since its axis is vertical in all these poses"
    return (
        f"the gain cannot be separated from the offset, since gravity torque varies only by {spread:.2g} N·m "
        "(standard deviation) in these poses: move this joint, or the joints beyond it, further"
    )


def held_out_rows(record: CalibrationRecord, rows: StaticReadings, fit: FieldFit, before: CalibrationRecord) -> HeldOut:
    """The proof of a record from slow rows against the one before, which is not judged by what it was fitted to."""
    if before.is_fitted_to(record.data):
        return HeldOut(against=before.id)
    return held_out(before, *heldout_errors(rows, fit, before))


def heldout_errors(rows: StaticReadings, fit: FieldFit, before: CalibrationRecord) -> tuple[Array, Array]:
    """Errors (K, n) [N·m] of held-out rows with a new calibration and with the one before; NaN if they do not count.

    For every joint a line of readings over model torque is fitted to every second block of rows and predicts the
    others.
    """
    block = np.arange(len(rows.torque)) // min(BLOCK, max(len(rows.torque) // 6, 1)) % 2
    old = rows.torque - before.torque_calibration().apply(fit.torque)
    new = np.full_like(old, np.nan)
    counted = np.isfinite(old) & np.isfinite(fit.value("gain"))
    for j in range(old.shape[1]):
        for held in (0, 1):
            train, test = counted[:, j] & (block != held), counted[:, j] & (block == held)
            if train.sum() < FEWEST:
                continue
            line = np.polyfit(fit.torque[train, j], rows.torque[train, j], 1)
            new[test, j] = rows.torque[test, j] - np.polyval(line, fit.torque[test, j])
    return new, old


@dataclass(frozen=True, eq=False)
class Payload:
    """Mass and first moment, in the frame that turns with the last joint."""

    value: Array
    """(4,): mass [kg], mass times centre [kg·m]."""
    covariance: Array
    """(4, 4)."""
    residual_rms: Array
    """RMS of calibrated torque minus model, payload included (n,) [N·m]."""

    @property
    def mass(self) -> float:
        return float(self.value[0])

    @property
    def mass_std(self) -> float:
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def found(self) -> Mask:
        """Which of mass and moments the readings tell (4,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)) < SEEN * UNKNOWN_MOMENT)

    @property
    def centre(self) -> Array:
        """[m]; NaN where the readings do not tell it, or no mass."""
        known = self.found[1:] & (self.mass > 2 * self.mass_std)
        return np.where(known, self.value[1:] / self.mass, np.nan)

    @property
    def centre_std(self) -> Array:
        """[m]."""
        slope = np.hstack([-self.value[1:, None] / self.mass, np.eye(3)]) / self.mass
        std: Array = np.sqrt(np.einsum("ij,jk,ik->i", slope, self.covariance, slope))
        return np.where(np.isfinite(self.centre), std, np.nan)


def weigh_payload(
    arm_file: ArmFile, readings: StaticReadings, gravity: GravityRecord, calibration: CalibrationRecord
) -> Payload:
    """The payload that raw readings of the sensors show, beyond the gravity record; the arm file's tool is none of it.

    Gains and offsets are as doubtful as their record says, and mass and first moment are four more unknowns (docs/
    theory.md, equation (P)). What the calibration does not explain (cables, gear errors, an eccentric encoder) has
    periods of a quarter turn and more in each joint; poses that are drawn all over the range are further apart, so it
    counts as an error of its own in each. Raises Refused where a record is of another arm.
    """
    plain = tuple(joint.model_copy(update={"discrepancy": None}) for joint in calibration.joints)
    problem = FieldProblem(arm_file, readings, gravity, calibration.model_copy(update={"joints": plain}))
    level = np.hypot(calibration.discrepancy("level"), calibration.discrepancy("level_std"))
    own = np.hypot(readings.sigma, level * np.abs(problem.installed.gain))
    readings = replace(readings, sigma=own)
    columns = np.hstack([problem.columns(problem.installed.gain), problem.load_columns()])
    noise = readings.sigma
    for _ in range(NOISE_ROUNDS):
        solved = problem.solve(columns, noise, more=[UNKNOWN_MOMENT] * 4)
        left = problem.residual(columns, solved.x)
        noise = readings.sigma * np.maximum(scatter_factor(left, readings), 1.0)
    value = solved.x[-4:]
    of_scale = _gain_scale_std(calibration) * value
    return Payload(
        value, solved.covariance[-4:, -4:] + np.outer(of_scale, of_scale), rms(left) / np.abs(problem.installed.gain)
    )


def _gain_scale_std(calibration: CalibrationRecord) -> float:
    """Standard deviation of a factor common to all gains, as a share: their errors stem from one reference mass."""
    gain = {f"{joint.name}.gain": joint.gain for joint in calibration.joints if joint.gain is not None}
    places = [place for place, name in enumerate(calibration.covariance_of) if name in gain]
    if not places:
        return 0.0
    known = np.array([gain[calibration.covariance_of[place]] for place in places])
    return common_scale_std(np.array(calibration.covariance)[np.ix_(places, places)], known)


def raw_readings(position: Array, torque: Array, sigma: Array, calibration: CalibrationRecord) -> StaticReadings:
    """The sensors' own readings of true angles (K, n) [rad] and calibrated torques (K, n) [N·m], pose after pose."""
    zeros, gains = calibration.values("position_offset", 0.0), calibration.values("position_gain", 1.0)
    gain, offset = calibration.values("gain", 1.0), calibration.values("offset", 0.0)
    raw = (position - zeros) / gains
    return StaticReadings(raw, gain * torque + offset, sigma, direction=directions(raw))
